"""Reference images: rendered once, kept on disk, with a variance that is measured and not claimed.

A reference is the mean of two renders that share nothing: plain Monte Carlo and the control variate,
each with its own seed. A quarter of their squared difference is the variance of the mean, whatever
either says of itself; and their difference, summed over the image, tests each against the other.
"""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ncv_cl.integrands import INTEGRANDS
from ncv_cl.opencl.device import Device
from ncv_cl.opencl.program import source
from ncv_cl.output.report import package_version
from ncv_cl.rendering.render import render
from ncv_cl.scene.load import Scene

# Neither allocates: a point that was thought to be without error would keep what error it has.
HALVES = (
    {"method": "mc", "seed": 2**40},
    {"method": "ncv", "seed": 2**41, "allocation": "uniform"},
)
# A method whose image is farther than this from the reference, in deviations, is not timed.
LARGEST_Z = 4.0
# What float32 arithmetic may change of an image's mean: many-sample renders of smooth scenes are as
# exact as that, and then differ by rounding, not by noise.
ROUNDING = 3e-6


@dataclass(frozen=True)
class Reference:
    """A reference image.

    Attributes
    ----------
    pixels : (height, width, 3) float64
        Linear RGB.
    variance : (height, width, 3) float64
        A quarter of the halves' squared difference.
    spp : int
        Samples a point, both halves together.
    seconds : float
        What rendering it took.
    agreement : float
        The Z-value of the halves' difference, mean over the image.
    cached : bool
        Whether it was read from disk.
    """

    pixels: np.ndarray
    variance: np.ndarray
    spp: int
    seconds: float
    agreement: float
    cached: bool

    def errors(self, pixels: np.ndarray) -> tuple[float, float]:
        """MSE and relMSE (`ncv_cl.output.image.error_metrics`), the reference's own part subtracted."""
        weight = relative_weight(self.pixels)
        squared = (pixels.astype(np.float64) - self.pixels) ** 2 - self.variance
        return float(squared.mean()), float((squared * weight).mean())

    def own_errors(self) -> tuple[float, float]:
        """MSE and relMSE of the reference itself."""
        weight = relative_weight(self.pixels)
        return float(self.variance.mean()), float((self.variance * weight).mean())

    def agrees(self, pixels: np.ndarray) -> tuple[float, bool]:
        """Z-value of an image's mean, and whether it is that of an unbiased estimate."""
        return z_test(pixels, self.pixels)


def relative_weight(pixels: np.ndarray) -> np.ndarray:
    """What makes squared errors relative, with the floor of `ncv_cl.output.image.error_metrics`."""
    return 1 / (pixels**2 + 1e-2 * pixels.mean() ** 2)


def z_test(pixels: np.ndarray, reference: np.ndarray) -> tuple[float, bool]:
    """Z-value of two images' mean difference, and whether chance or rounding explains it.

    Errors of different points are independent, so the sum of their squares is the variance of their
    sum. Channels, which share samples, are averaged first.
    """
    difference = (pixels.astype(np.float64) - reference).mean(axis=2)
    deviation = np.sqrt((difference**2).sum())
    z = float(difference.sum() / deviation) if deviation else 0.0
    rounding = abs(difference.mean()) <= ROUNDING * reference.mean()
    return z, bool(abs(z) <= LARGEST_Z or rounding)


def reference(device: Device, scene: Scene, integrand: str, size: int, spp: int) -> Reference:
    """The reference of a scene at `size` × `size` points, from disk or rendered now.

    Raises
    ------
    RuntimeError
        If its two halves disagree: one of the methods is biased, and nothing can be measured.
    """
    file = cache_folder() / f"{scene.name}_{integrand}_{key(scene, integrand, size, spp)[:16]}.npz"
    if file.exists():
        with np.load(file) as found:
            halves, seconds, cached = found["halves"], float(found["seconds"]), True
    else:
        started = time.perf_counter()
        options = {"spp": max(1, spp // 2), "size": (size, size), "device": device}
        halves = np.stack([render(scene, integrand, **options, **half).pixels for half in HALVES])
        seconds, cached = time.perf_counter() - started, False
        _write(file, halves, seconds)
    first, second = halves.astype(np.float64)
    z, agree = z_test(first, second)
    if not agree:
        raise RuntimeError(
            f"{scene.name} {integrand}: plain Monte Carlo and the control variate differ by {z:.1f} "
            "deviations in the image's mean; one of them is biased"
        )
    return Reference((first + second) / 2, (first - second) ** 2 / 4, spp, seconds, z, cached)


def key(scene: Scene, integrand: str, size: int, spp: int) -> str:
    """SHA-256, in hex, of all that decides a reference: any change of these renders it again."""
    kind = INTEGRANDS[integrand]
    decided = {
        "scene": scene.digest,
        "integrand": integrand,
        "options": {name: str(value) for name, value in sorted(vars(kind()).items())},
        "kernels": source(("points", "surface", *kind.files)),
        "size": size,
        "spp": spp,
        "halves": HALVES,
        "version": package_version(),
    }
    return hashlib.sha256(json.dumps(decided, sort_keys=True).encode()).hexdigest()


def cache_folder() -> Path:
    """Where references are kept: in the user's cache folder."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "ncv_cl" / "references"


def _write(file: Path, halves: np.ndarray, seconds: float) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    # Complete under its name or not at all: others may look for it at the same time.
    with tempfile.TemporaryDirectory(dir=file.parent) as folder:
        complete = Path(folder) / file.name
        np.savez(complete, halves=halves, seconds=seconds)
        os.replace(complete, file)
