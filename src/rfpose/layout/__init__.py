"""Before a site is built: sensitivity maps, line of sight, error budget, placement of transmitters."""
