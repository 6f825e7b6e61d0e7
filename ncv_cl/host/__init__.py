"""What the machine gives beside OpenCL: caches, files, signals, terminals, clocks."""
