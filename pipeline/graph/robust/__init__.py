"""Which loop edges are in force: robust losses, graduated non-convexity, verdicts."""
