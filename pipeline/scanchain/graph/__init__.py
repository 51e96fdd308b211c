"""Pose graphs: factors, optimizers, linear solvers, g2o."""
