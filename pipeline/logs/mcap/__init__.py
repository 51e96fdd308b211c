"""MCAP files: where their messages lie, damage included, and their messages in order."""
