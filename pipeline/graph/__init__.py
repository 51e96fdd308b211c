"""Pose graphs: factors, optimisers, linear solvers, g2o."""
