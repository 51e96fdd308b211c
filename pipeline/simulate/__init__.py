"""Worlds with exact ground truth, written as MCAP."""
