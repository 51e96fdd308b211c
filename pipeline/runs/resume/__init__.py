"""Checkpoints of a run, and how one goes on after it was stopped."""
