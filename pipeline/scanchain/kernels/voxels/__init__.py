"""Hash tables of voxels, and their contents; compiled."""
