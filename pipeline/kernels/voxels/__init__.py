"""Hash tables of voxels, and what they hold; compiled."""
