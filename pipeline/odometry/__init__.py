"""Predict, match against the local map, extend it."""
