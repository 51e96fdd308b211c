"""SVD-ICP and LM-PLICP against a voxel map."""
