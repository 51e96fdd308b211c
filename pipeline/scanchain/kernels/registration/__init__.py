"""Correspondences, residuals, the descent, and how well a pose is determined; compiled."""
