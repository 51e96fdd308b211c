"""Faults of a log: severity, effect, fix."""
