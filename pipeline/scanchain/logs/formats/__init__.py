"""Logs that are no MCAP: each file or folder as an index whose messages are made when they are read."""
