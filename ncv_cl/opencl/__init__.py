"""Runtimes and devices, memory, programs from kernel texts."""
