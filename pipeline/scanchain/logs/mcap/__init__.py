"""MCAP files: index of their messages, damage included, and their messages in order."""
