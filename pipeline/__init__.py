"""Lidar logs in, trajectory and map out."""
