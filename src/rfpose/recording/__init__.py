"""IQ on disk: rfpose-iq (HDF5), Digital RF, SigMF."""
