"""A short inference benchmark per device, and its cached answers."""

from __future__ import annotations

import json
import os
import tempfile
import time
from contextlib import suppress
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np

from .device import Device, HostArray, open_device
from .encode import Encoding
from .network import NetworkDescription
from .program import build

# The network that is timed: the slides' two layers of 32 with three outputs, biases per point.
_DESCRIPTION = NetworkDescription(Encoding(("position",)), 3, (32, 32), modulated=("B1",))
_POINTS, _SAMPLES = 1024, 64
_SECONDS = 0.5


@dataclass(frozen=True)
class Probe:
    """What the benchmark found: nanoseconds an inference sample takes, and how it was fastest."""

    nanoseconds: float
    use_fma: bool


def measure(device: Device) -> Probe:
    """Time inference with and without ``fma`` (about a second in all) and keep the faster."""
    # GPUs contract by themselves; there is nothing to choose.
    choices = [True] if device.is_gpu else [True, False]
    timed = [Probe(_inference_nanoseconds(device, use_fma), use_fma) for use_fma in choices]
    return min(timed, key=lambda probe: probe.nanoseconds)


def _inference_nanoseconds(device: Device, use_fma: bool) -> float:
    device = open_device(
        device.cl_device, device.index, device.vector_width, device.lanes, use_fma=use_fma
    )
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
    return float(np.median(times[1:])) / (_POINTS * _SAMPLES) * 1e9


def cached_probe(device: Device) -> Probe:
    """The probe of this device and driver, measured once and kept under the user's cache folder."""
    path = _cache_path()
    known: dict[str, dict] = {}
    key = f"{_package_version()} | {device.identity} | VEC {device.vector_width}"
    # A cache that is missing, broken or of another version only means measuring again.
    with suppress(OSError, ValueError, TypeError):
        known = dict(json.loads(path.read_text(encoding="utf-8")))
        if key in known:
            return Probe(**known[key])
    probe = measure(device)
    known[key] = asdict(probe)
    # A read-only home only means that the next start measures again.
    with suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile("w", dir=path.parent, delete=False, encoding="utf-8") as file:
            json.dump(known, file, indent=1)
        os.replace(file.name, path)
    return probe


def _cache_path() -> Path:
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "ncv_cl" / "probe.json"


def _package_version() -> str:
    try:
        return version("ncv_cl")
    except PackageNotFoundError:
        return "unpackaged"
