"""Branch and bound over poses, and place descriptors; compiled."""
