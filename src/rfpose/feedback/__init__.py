"""Sun, mount and calibration of heliostats: what steers a mirror, and how far that is wrong."""
