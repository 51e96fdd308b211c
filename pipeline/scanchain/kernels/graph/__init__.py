"""Factors of a pose graph and sparse factorization; compiled."""
