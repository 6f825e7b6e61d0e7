"""OpenCL: runtimes and devices, memory, programs from kernel texts."""
