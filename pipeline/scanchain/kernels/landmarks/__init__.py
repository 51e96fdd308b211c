"""Factors and linear algebra of landmark problems; compiled."""
