"""What a device is: a short benchmark for lists of devices, and a record of those that were used.

Nothing depends on either: devices and methods are chosen by rules (`choose`, `estimation.method`).
"""

from __future__ import annotations

import json
import os
import tempfile
import threading
import time
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from ..host.caches import cache_folder
from ..host.version import package_version
from .device import Device
from .memory import HostArray
from .program import build

ITEMS, STEPS = 1 << 16, 1024
SECONDS = 0.3

_recorded: set[Device] = set()
_lock = threading.Lock()


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


def record(device: Device) -> None:
    """Note in the user's cache folder what a device that is used is taken for, for reports of faults.

    Once a process and device; where the folder cannot be written, nothing is noted.
    """
    folder = cache_folder("ncv_cl")
    with _lock:
        if device in _recorded or folder is None:
            return
        _recorded.add(device)
        path = folder / "probe.json"
        known: dict[str, object] = {}
        with suppress(OSError, ValueError, TypeError):
            known = dict(json.loads(path.read_text(encoding="utf-8")))
        key = f"{package_version()} | {device.identity} | VEC {device.vector_width}"
        facts = {"use_fma": device.use_fma, "lanes": device.lanes}
        if known.get(key) == facts:
            return
        with suppress(OSError):
            path.parent.mkdir(parents=True, exist_ok=True)
            with tempfile.NamedTemporaryFile(
                "w", dir=path.parent, delete=False, encoding="utf-8"
            ) as file:
                json.dump(known | {key: facts}, file, indent=1)
            os.replace(file.name, path)
