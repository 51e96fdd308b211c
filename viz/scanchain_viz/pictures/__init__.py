"""Figures: trajectories, maps, graphs and landmarks, as PNG and SVG."""
