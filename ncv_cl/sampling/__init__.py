"""Samples of an integrand in batches, traced, and their running means and variances."""
