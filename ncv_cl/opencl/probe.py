"""A short inference benchmark per device, and its cached answers, on which no kernel depends."""

from __future__ import annotations

import json
import os
import tempfile
import threading
import time
from contextlib import suppress
from dataclasses import asdict, dataclass

import numpy as np

from ..host.caches import cache_folder
from ..host.version import package_version
from ..network.encode import Encoding
from ..network.network import NetworkDescription
from .device import Device, HostArray
from .program import build

# The network that is timed: the slides' two layers of 32 with three outputs, biases per point.
_DESCRIPTION = NetworkDescription(Encoding(("position",)), 3, (32, 32), modulated=("B1",))
_POINTS, _SAMPLES = 1024, 64
_SECONDS = 0.5


@dataclass(frozen=True)
class Probe:
    """What the benchmark found: nanoseconds that an inference sample takes, with `fma` or without."""

    nanoseconds: float
    use_fma: bool


# Of this process, where nothing can be kept in a file.
_measured: dict[Device, Probe] = {}
_lock = threading.Lock()


def measure(device: Device) -> Probe:
    """Time inference for about half a second."""
    evaluate = build(device, ("common", "mlp"), _DESCRIPTION.defines()).kernel("evaluate")
    generator = np.random.Generator(np.random.Philox(0))
    uv = generator.uniform(size=(2, _POINTS, _SAMPLES))
    shapes = _DESCRIPTION.group_shapes
    groups = {
        name: generator.normal(size=((_POINTS,) if name in _DESCRIPTION.modulated else ()) + shape)
        for name, shape in shapes.items()
    }
    w2 = generator.normal(size=_DESCRIPTION.hidden[::-1])
    arrays = (*uv, groups["W1"], groups["B1"], w2, groups["B2"], groups["W3"], groups["B3"])
    arguments = [HostArray.of(device, array.astype(np.float32)) for array in arrays]
    value = HostArray(device, (_DESCRIPTION.channels, _POINTS, _SAMPLES), np.float32)
    items = _POINTS * _SAMPLES // device.vector_width
    times = []
    started = time.perf_counter()
    while time.perf_counter() - started < _SECONDS or len(times) < 3:
        begun = time.perf_counter()
        evaluate(items, 0, _POINTS, _SAMPLES, *arguments, value)
        device.queue.finish()
        times.append(time.perf_counter() - begun)
    return Probe(float(np.median(times[1:])) / (_POINTS * _SAMPLES) * 1e9, device.use_fma)


def cached_probe(device: Device) -> Probe:
    """The probe of this device and driver, measured once and kept under the user's cache folder."""
    # Two threads that measure at once would measure each other.
    with _lock:
        if device not in _measured:
            _measured[device] = _kept_probe(device)
        return _measured[device]


def _kept_probe(device: Device) -> Probe:
    folder = cache_folder("ncv_cl")
    if folder is None:
        return measure(device)
    path = folder / "probe.json"
    known: dict[str, dict] = {}
    key = f"{package_version()} | {device.identity} | VEC {device.vector_width}"
    # A cache that is missing, broken or of another version only means measuring again.
    with suppress(OSError, ValueError, TypeError):
        known = dict(json.loads(path.read_text(encoding="utf-8")))
        kept = Probe(**known[key]) if key in known else None
        if kept is not None and kept.use_fma == device.use_fma and kept.nanoseconds > 0:
            return kept
    probe = measure(device)
    known[key] = asdict(probe)
    # A read-only home only means that the next start measures again.
    with suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile("w", dir=path.parent, delete=False, encoding="utf-8") as file:
            json.dump(known, file, indent=1)
        os.replace(file.name, path)
    return probe
