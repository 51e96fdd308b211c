"""Poses, twists and small matrices; compiled."""
