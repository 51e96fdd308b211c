"""Landmark SLAM in the plane: problems, linear solvers of A x = b, Gauss-Newton, logs of range and bearing."""
