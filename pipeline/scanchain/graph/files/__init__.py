"""Pose graphs as text: g2o and TORO."""
