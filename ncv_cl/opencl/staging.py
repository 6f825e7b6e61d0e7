"""Pinned memory of the host, through which what streams between host and device is copied.

A device with memory of its own reads pageable memory through a copy that its driver makes. Pinned
memory it reads itself, several times as fast, and while the host does something else.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pyopencl as cl

from .device import Device, once

# One is filled while the other is being copied.
AREAS = 2


@once
def copy_queue(device: Device) -> cl.CommandQueue:
    """The device's second queue, for copies beside the kernels of the first."""
    return cl.CommandQueue(device.context)


class Staging:
    """Two areas of pinned memory that take turns.

    They grow with what is asked for, and stay mapped: the device never uses them but to copy.
    """

    def __init__(self, device: Device) -> None:
        self._device = device
        self._next = 0
        self._areas: list[np.ndarray] = [np.empty(0, np.uint8)] * AREAS
        self._copies: list[cl.Event | None] = [None] * AREAS

    def area(self, shape: tuple[int, ...], dtype: np.dtype) -> tuple[np.ndarray, int]:
        """Memory of this shape, with unknown content, that no copy reads any more; and its number."""
        number, self._next = self._next, (self._next + 1) % AREAS
        if (copy := self._copies[number]) is not None:
            copy.wait()
            self._copies[number] = None
        size = int(np.prod(shape, dtype=np.int64)) * dtype.itemsize
        if self._areas[number].size < size:
            self._areas[number] = self._pinned(size)
        return self._areas[number][:size].view(dtype).reshape(shape), number

    def copying(self, number: int, copy: cl.Event) -> None:
        """Say that a copy reads an area."""
        self._copies[number] = copy

    def _pinned(self, size: int) -> np.ndarray:
        flags = cl.mem_flags.READ_WRITE | cl.mem_flags.ALLOC_HOST_PTR
        buffer = cl.Buffer(self._device.context, flags, size=size)
        # Flags add up, which pyopencl's hints leave out.
        both: Any = cl.map_flags.READ | cl.map_flags.WRITE
        queue, kind = self._device.queue, np.dtype(np.uint8)
        view, _ = cl.enqueue_map_buffer(queue, buffer, both, 0, (size,), kind, is_blocking=True)
        return view
