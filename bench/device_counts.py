"""What a render asks of its device: launches, waits of the host, and bytes that cross the bus.

A wrapper around the calls by which the package talks to OpenCL. On a CPU nothing crosses a bus: what is
counted there is what would on a device with memory of its own, where a map copies what it shows.
"""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field

import numpy as np
import pyopencl as cl
import pytest

from ncv_cl.opencl.device import GROUP_SIZE
from ncv_cl.opencl.kernel import Kernel


@dataclass
class Launches:
    """All launches of one kernel.

    Attributes
    ----------
    count, items, group : int
        How many there were, their work-items in all, and those of a group.
    seconds : float
        From launch to end, where they are timed.
    """

    count: int = 0
    items: int = 0
    group: int = GROUP_SIZE
    seconds: float = 0.0


@dataclass
class Counts:
    """What was counted.

    Attributes
    ----------
    kernels : dict
        `Launches` by a kernel's name.
    waits : Counter
        Calls after which the host has waited for the device, by their names.
    to_host, to_device : int
        Bytes that are copied where host and device share no memory.
    """

    kernels: dict[str, Launches] = field(default_factory=dict)
    waits: Counter[str] = field(default_factory=Counter)
    to_host: int = 0
    to_device: int = 0

    @property
    def launches(self) -> int:
        return sum(one.count for one in self.kernels.values())

    def as_dict(self) -> dict:
        return asdict(self) | {"waits": dict(self.waits)}


@contextmanager
def counting(timed: bool = False) -> Iterator[Counts]:
    """Count from now until the block's end.

    Parameters
    ----------
    timed : bool
        Whether each launch is waited for, which tells kernels' seconds, and makes renders slower. These
        waits are not counted.
    """
    found, lock = Counts(), threading.Lock()
    plain_finish = cl.CommandQueue.finish

    def launched(kernel: Kernel, items: int, group: int, launch: Callable[[], object]) -> object:
        if timed:
            plain_finish(kernel.device.queue)
        begun = time.perf_counter()
        result = launch()
        if timed:
            plain_finish(kernel.device.queue)
        with lock:
            one = found.kernels.setdefault(kernel.name, Launches())
            one.count += 1
            one.items += items
            one.group = group
            one.seconds += time.perf_counter() - begun if timed else 0.0
        return result

    with pytest.MonkeyPatch.context() as patch:
        _patch_launches(patch, launched)
        _patch_waits(patch, found)
        _patch_copies(patch, found)
        yield found


def _patch_launches(patch: pytest.MonkeyPatch, launched: Callable[..., object]) -> None:
    plain_call, plain_repeat = Kernel.__call__, Kernel.repeat

    def call(kernel: Kernel, items: object, /, *, group: object = GROUP_SIZE, **given: object) -> object:
        sizes = int(np.prod(items)), int(np.prod(group))
        return launched(kernel, *sizes, lambda: plain_call(kernel, items, group=group, **given))

    def repeat(kernel: Kernel, number: int, items: int, group: int = GROUP_SIZE) -> None:
        launched(kernel, items, group, lambda: plain_repeat(kernel, number, items, group))

    patch.setattr(Kernel, "__call__", call)
    patch.setattr(Kernel, "repeat", repeat)


def _patch_waits(patch: pytest.MonkeyPatch, found: Counts) -> None:
    def waiting(name: str, plain: Callable[..., object]) -> Callable[..., object]:
        def call(*given: object, **named: object) -> object:
            found.waits[name] += 1
            return plain(*given, **named)

        return call

    for owner, name in (
        (cl.CommandQueue, "finish"),
        (cl, "wait_for_events"),
        (cl.Event, "wait"),
    ):
        patch.setattr(owner, name, waiting(name, getattr(owner, name)))


def _patch_copies(patch: pytest.MonkeyPatch, found: Counts) -> None:
    plain_map, plain_copy = cl.enqueue_map_buffer, cl.enqueue_copy

    def mapped(
        queue: object, buffer: object, flags: int, offset: int, shape: tuple, dtype: object, *a: object,
        is_blocking: bool = True, **named: object,
    ) -> object:  # fmt: skip
        size = int(np.prod(shape)) * np.dtype(dtype).itemsize
        if flags & cl.map_flags.READ:
            found.to_host += size
        if flags & (cl.map_flags.WRITE | cl.map_flags.WRITE_INVALIDATE_REGION):
            found.to_device += size
        found.waits["map"] += bool(is_blocking)
        return plain_map(
            queue, buffer, flags, offset, shape, dtype, *a, is_blocking=is_blocking, **named
        )

    def copied(
        queue: object, to: object, source: object, *a: object, is_blocking: bool = True, **named: object
    ) -> object:
        for array, side in ((to, "to_host"), (source, "to_device")):
            if isinstance(array, np.ndarray):
                setattr(found, side, getattr(found, side) + array.nbytes)
                found.waits["copy"] += bool(is_blocking)
        return plain_copy(queue, to, source, *a, **named | _blocking(to, source, is_blocking))

    patch.setattr(cl, "enqueue_map_buffer", mapped)
    patch.setattr(cl, "enqueue_copy", copied)


def _blocking(to: object, source: object, is_blocking: bool) -> dict[str, bool]:
    """Between two buffers there is no such argument."""
    with_host = isinstance(to, np.ndarray) or isinstance(source, np.ndarray)
    return {"is_blocking": is_blocking} if with_host else {}
