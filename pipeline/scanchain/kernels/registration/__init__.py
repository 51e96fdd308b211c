"""Correspondences, residuals, optimization and observability of a pose; compiled."""
