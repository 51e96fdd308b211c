"""Landmark problems read from files, results written."""
