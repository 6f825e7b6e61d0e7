"""Passes that are drawn on other machines: what travels, what a worker does, how it is put together."""
