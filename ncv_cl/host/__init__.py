"""Caches, files, signals, terminals, clocks: what the machine gives beside OpenCL."""
