"""The worlds that can be simulated."""
