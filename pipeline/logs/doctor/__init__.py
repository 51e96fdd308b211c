"""Faults of a log: what they are, how much they matter, what helps."""
