"""Exact integrals of networks over the unit square, by arrangements of lines."""
