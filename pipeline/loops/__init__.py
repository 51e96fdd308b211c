"""Propose and verify revisits."""
