"""Arrays on the device, and how the host reads and writes them.

Where host and device share memory (CPUs, integrated GPUs), the host sees an array itself, and nothing is
copied. A discrete GPU keeps arrays in memory of its own: the host then works on a copy of just what it
asks for. Arrays that it reads or writes with every batch of samples *stream*: their copies go through
pinned memory (staging.py), and can go on while kernels run.
"""

from __future__ import annotations

import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np
import pyopencl as cl

from .device import Device
from .staging import Staging, copy_queue


class Window(NamedTuple):
    """A rectangle of an array that is taken for rows of `pitch` elements, the first at `first`."""

    first: int
    pitch: int
    rows: range
    columns: range

    @property
    def shape(self) -> tuple[int, int]:
        return len(self.rows), len(self.columns)

    @property
    def start(self) -> int:
        """Its first element."""
        return self.first + self.rows.start * self.pitch + self.columns.start


class HostArray:
    """An array on the device that the host can read and write.

    Parameters
    ----------
    device : Device
    shape : tuple of int
    dtype : numpy dtype
    streams : bool
        Whether the host reads or writes it with every batch of samples. Most arrays only kernels do.

    Raises
    ------
    DeviceMemoryError
        If the device has no room for it.
    """

    def __init__(
        self,
        device: Device,
        shape: tuple[int, ...] | int,
        dtype: np.dtype | type,
        streams: bool = False,
    ) -> None:
        self.device = device
        self.shape = (shape,) if isinstance(shape, int) else tuple(shape)
        self.dtype = np.dtype(dtype)
        # OpenCL has no empty buffers; an empty array keeps one unused element.
        size = max(1, int(np.prod(self.shape, dtype=np.int64))) * self.dtype.itemsize
        memory = device.memory
        memory.take(size, self)
        weakref.finalize(self, memory.give_back, size).atexit = False
        self._shared = memory.shared
        flags = cl.mem_flags.READ_WRITE
        if self._shared:
            # Flags add up, which pyopencl's hints leave out.
            flags = cl.mem_flags.READ_WRITE | cl.mem_flags.ALLOC_HOST_PTR  # type: ignore[assignment]
        self._staging = Staging(device) if streams and not self._shared else None
        self.buffer = cl.Buffer(device.context, flags, size=size)

    def __repr__(self) -> str:
        return f"an array {self.shape} of {self.dtype}"

    @classmethod
    def of(cls, device: Device, array: np.ndarray) -> HostArray:
        """A new `HostArray` that holds a copy of `array`."""
        array = np.asarray(array)
        made = cls(device, array.shape, array.dtype)
        with made.mapped(write=True) as view:
            view[...] = array
        return made

    @contextmanager
    def mapped(
        self,
        write: bool = False,
        count: int | None = None,
        update: bool = False,
        window: Window | None = None,
        after: cl.Event | None = None,
    ) -> Iterator[np.ndarray]:
        """View the array on the host while the block lasts.

        With ``write=True`` the previous content is not kept; with ``update=True`` it may be changed.

        Parameters
        ----------
        count : int, optional
            Only the first so many rows.
        window : Window, optional
            Only a rectangle, of which the view is (rows, columns).
        after : Event, optional
            What the device's queue did last with the array: where copies are made they wait for this
            alone, on a second queue, and not for what the first was asked since.
        """
        shape = window.shape if window else self.shape if count is None else (count, *self.shape[1:])
        if 0 in shape:
            yield np.empty(shape, self.dtype)
        elif self._shared:
            yield from self._in_place(shape, write, update, window)
        else:
            yield from self._copied(shape, write, update, window, after)

    def read(self, count: int | None = None, window: Window | None = None) -> np.ndarray:
        """A copy of the content, of the first `count` rows or of a `window`, in plain numpy memory."""
        with self.mapped(count=count, window=window) as view:
            return view.copy()

    def fill(self, value: float | int) -> None:
        """Set every element, on the device."""
        pattern = np.array(value, self.dtype)
        cl.enqueue_fill_buffer(self.device.queue, self.buffer, pattern, 0, self.buffer.size)

    def _in_place(
        self, shape: tuple[int, ...], write: bool, update: bool, window: Window | None
    ) -> Iterator[np.ndarray]:
        """The array itself."""
        flags = cl.map_flags.WRITE_INVALIDATE_REGION if write else cl.map_flags.READ
        # From the first to the last element of a window; what lies between rows is kept.
        if update or (window and write):
            # Flags add up, which pyopencl's hints leave out.
            flags = cl.map_flags.READ | cl.map_flags.WRITE  # type: ignore[assignment]
        start, mapped = 0, shape
        if window:
            start, mapped = window.start, ((shape[0] - 1) * window.pitch + shape[1],)
        begin = start * self.dtype.itemsize
        queue = self.device.queue
        whole, _ = cl.enqueue_map_buffer(
            queue, self.buffer, flags, begin, mapped, self.dtype, is_blocking=True
        )
        try:
            if window:
                steps = (window.pitch * self.dtype.itemsize, self.dtype.itemsize)
                yield np.ndarray(shape, self.dtype, whole, strides=steps)
            else:
                yield whole
        finally:
            whole.base.release(queue)

    def _copied(
        self,
        shape: tuple[int, ...],
        write: bool,
        update: bool,
        window: Window | None,
        after: cl.Event | None,
    ) -> Iterator[np.ndarray]:
        """Copies of what is asked for, before the block and after it."""
        queue, staging = self.device.queue, self._staging
        waits: dict[str, Any] = {}
        if after is not None:
            queue.flush()
            queue, waits = copy_queue(self.device), {"wait_for": [after]}
        own, number = (
            (np.empty(shape, self.dtype), 0) if staging is None else staging.area(shape, self.dtype)
        )
        if not write:
            where = _copy_arguments(own, window, "src_offset")
            cl.enqueue_copy(queue, own, self.buffer, is_blocking=True, **where, **waits)
        try:
            yield own
        finally:
            if write or update:
                where = _copy_arguments(own, window, "dst_offset") | waits
                copy = cl.enqueue_copy(queue, self.buffer, own, is_blocking=staging is None, **where)
                if staging is not None:
                    staging.copying(number, copy)
                if after is not None:
                    # What the first queue is asked from now on sees what was written.
                    queue.flush()
                    cl.enqueue_barrier(self.device.queue, wait_for=[copy])


def _copy_arguments(own: np.ndarray, window: Window | None, offset_name: str) -> dict[str, Any]:
    """Where `enqueue_copy` finds in the buffer what `own` (dense) is a copy of."""
    if window is None:
        return {offset_name: 0}
    item = own.itemsize
    start, row = window.start * item, own.shape[1] * item
    if own.shape[0] == 1 or own.shape[1] == window.pitch:
        return {offset_name: start}
    # Within the first row, as the offset of a row is.
    down, across = divmod(start, window.pitch * item)
    return {
        "buffer_origin": (across, down, 0),
        "host_origin": (0, 0, 0),
        "region": (row, own.shape[0], 1),
        "buffer_pitches": (window.pitch * item,),
        "host_pitches": (row,),
    }


def start_copy(array: HostArray, own: np.ndarray, window: Window, back: bool = False) -> cl.Event:
    """Copy a window of an array to `own` (rows, columns), or `back`; the event of a copy under way.

    Keep it until it is over: `own` is in use until then.
    """
    queue = array.device.queue
    if back:
        where = _copy_arguments(own, window, "dst_offset")
        return cl.enqueue_copy(queue, array.buffer, own, is_blocking=False, **where)
    where = _copy_arguments(own, window, "src_offset")
    return cl.enqueue_copy(queue, own, array.buffer, is_blocking=False, **where)
