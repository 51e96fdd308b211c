"""Point clouds and occupancy grids in formats others read."""
