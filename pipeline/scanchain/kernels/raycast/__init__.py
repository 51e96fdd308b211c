"""Rays through grids and simulated solids; compiled."""
