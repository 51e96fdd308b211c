"""Logs that are read over the network."""
