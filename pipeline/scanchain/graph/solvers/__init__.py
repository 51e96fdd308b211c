"""Steps to the minimum of chi-squared, and the sparse linear algebra beneath them."""
