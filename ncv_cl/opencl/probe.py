"""A short benchmark of a device, for lists of devices; nothing else depends on it."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from .device import Device
from .memory import HostArray
from .program import build

ITEMS, STEPS = 1 << 16, 1024
SECONDS = 0.3


@dataclass(frozen=True)
class Probe:
    """What the benchmark found.

    Attributes
    ----------
    multiply_adds : float
        Billions a second, in the vectors that kernels use.
    """

    multiply_adds: float


def measure(device: Device) -> Probe:
    """Time multiply-adds for about a third of a second.

    Raises
    ------
    RuntimeError
        If the device computes something else than it should.
    """
    values = HostArray(device, ITEMS * device.vector_width, np.float32)
    kernel = build(device, ("common", "probe"), {"STEPS": f"{STEPS}u"}).kernel("multiply_add")
    times: list[float] = []
    begun = time.perf_counter()
    while time.perf_counter() - begun < SECONDS or len(times) < 3:
        values.fill(1.0)
        device.queue.finish()
        started = time.perf_counter()
        kernel(ITEMS, a=0.5, b=1.0, values=values)
        device.queue.finish()
        times.append(time.perf_counter() - started)
    # The fixed point of x / 2 + 1.
    if not np.allclose(values.read(), 2.0):
        raise RuntimeError("multiply-adds came out wrong")
    return Probe(1e-9 * values.shape[0] * STEPS / float(np.median(times)))
