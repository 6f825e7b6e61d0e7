"""Arrays in memory that host and device share."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pyopencl as cl

from .device import Device


class HostArray:
    """An array in memory that the host can see: zero-copy on CPU devices, pinned on GPUs.

    Parameters
    ----------
    device : Device
    shape : tuple of int
    dtype : numpy dtype
    """

    def __init__(self, device: Device, shape: tuple[int, ...] | int, dtype: np.dtype | type) -> None:
        self.device = device
        self.shape = (shape,) if isinstance(shape, int) else tuple(shape)
        self.dtype = np.dtype(dtype)
        count = int(np.prod(self.shape, dtype=np.int64))
        # OpenCL has no empty buffers; an empty array keeps one unused element.
        flags = cl.mem_flags.READ_WRITE | cl.mem_flags.ALLOC_HOST_PTR
        self.buffer = cl.Buffer(device.context, flags, size=max(1, count) * self.dtype.itemsize)

    @classmethod
    def of(cls, device: Device, array: np.ndarray) -> HostArray:
        """A new `HostArray` that holds a copy of `array`."""
        array = np.asarray(array)
        shared = cls(device, array.shape, array.dtype)
        with shared.mapped(write=True) as view:
            view[...] = array
        return shared

    @contextmanager
    def mapped(
        self, write: bool = False, count: int | None = None, update: bool = False
    ) -> Iterator[np.ndarray]:
        """View the array (or its first `count` rows) on the host while the block lasts.

        With ``write=True`` the previous content is not kept; with ``update=True`` it may be changed.
        """
        shape = self.shape if count is None else (count, *self.shape[1:])
        if 0 in shape:
            yield np.empty(shape, self.dtype)
            return
        flags = cl.map_flags.WRITE_INVALIDATE_REGION if write else cl.map_flags.READ
        if update:
            # Flags add up, which pyopencl's hints leave out.
            flags = cl.map_flags.READ | cl.map_flags.WRITE  # type: ignore[assignment]
        view, _ = cl.enqueue_map_buffer(
            self.device.queue, self.buffer, flags, 0, shape, self.dtype, is_blocking=True
        )
        try:
            yield view
        finally:
            view.base.release(self.device.queue)

    def read(self, count: int | None = None) -> np.ndarray:
        """A copy of the content (or of the first `count` rows) in plain numpy memory."""
        with self.mapped(count=count) as view:
            return view.copy()

    def fill(self, value: float | int) -> None:
        """Set every element, on the device."""
        pattern = np.array(value, self.dtype)
        cl.enqueue_fill_buffer(self.device.queue, self.buffer, pattern, 0, self.buffer.size)
