"""Lights of every shape: what they are, and how scene files describe them."""
