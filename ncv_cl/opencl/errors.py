"""What goes wrong with devices."""

from __future__ import annotations


class DeviceError(RuntimeError):
    """No usable OpenCL device, or the one asked for does not exist."""


class DeviceMemoryError(DeviceError, MemoryError):
    """An array is larger than the device can hold, or than is left."""
