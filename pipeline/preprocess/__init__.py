"""Crop, deskew, downsample."""
