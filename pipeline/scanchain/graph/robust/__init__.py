"""Robust losses of loop edges, graduated non-convexity, the set of inliers."""
