"""Branch and bound over poses; compiled."""
