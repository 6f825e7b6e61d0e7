"""Statistics and metadata of an image."""

from __future__ import annotations

import functools
import hashlib
import math
import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from ..estimation.image_estimate import error_of
from ..host.clock import Stopwatch
from ..host.version import package_version
from ..network.network import Network
from ..opencl.device import Device
from ..opencl.program import kernel_folder
from ..points.points import ShadingPoints
from ..sampling.accumulate import Estimate
from ..sampling.problem import Apart
from ..scene.load import Scene
from ..settings.settings import Settings
from ..visibility.rays import RayCount
from .image import Image, error_metrics


@functools.cache
def kernel_digest() -> str:
    """A hash of all kernel files."""
    return _digest(kernel_folder().rglob("*.cl"))


@functools.cache
def tuning_digest() -> str:
    """A hash of the tuning files: the measured numbers on which decisions rest."""
    return _digest(Path(__file__).parent.parent.rglob("tuning.py"))


def _digest(files: Iterable[Path]) -> str:
    digest = hashlib.sha256()
    for file in sorted(files):
        digest.update(file.name.encode() + b"\0" + file.read_bytes() + b"\0")
    return digest.hexdigest()


def seconds_of(watch: Stopwatch, rays: RayCount, total: float) -> dict[str, float]:
    """Seconds of each stage, and of the whole render."""
    drawing = {"trace": rays.trace_seconds, "sample": rays.sample_seconds}
    return {**watch.seconds, **drawing, "total": total}


def statistics(
    points: ShadingPoints,
    rays: RayCount,
    device: Device,
    plain: Estimate,
    training: Estimate | None,
    residual: Estimate | None,
    network: Network | None,
    points_done_twice: int,
) -> dict[str, Any]:
    """Counts of a render; means are over the sampled points."""
    drawn = _mean_samples(plain) if points.active else 0.0
    trained = _mean_samples(training)
    found: dict[str, Any] = {
        "rays_traced": rays.traced,
        "rays_on_device": rays.on_device,
        "samples_off_lines": rays.off_lines,
        "rays_skipped": rays.skipped,
        "points": points.active,
        "points_skipped": points.background + points.total - points.active,
        "samples_per_point": drawn + trained,
        "points_done_twice": points_done_twice,
        "network_inputs": list(network.description.encoding.inputs) if network else [],
        "device": device.identity,
        "method": "ncv" if network is not None else "mc",
    }
    if points.active:
        found["samples_per_point_range"] = [int(plain.samples.min()), int(plain.samples.max())]
    if residual is not None:
        reference = plain if training is None else training
        spread = reference.variance[:, reference.known]
        if spread.any() and residual.known.any():
            found["residual_variance_ratio"] = float(
                residual.variance[:, residual.known].mean() / spread.mean()
            )
    return found


def about_direct(apart: Apart, found: Estimate, settings: Settings) -> dict[str, Any]:
    """Counts of direct light that was estimated apart; means are over the points that face a light."""
    rays = apart.source.rays
    return {
        "points": len(apart.lit),
        "samples_per_point": float(found.samples[apart.lit].mean()),
        "rays_traced": rays.traced,
        "rays_on_device": rays.on_device,
        "samples_off_lines": rays.off_lines,
        "estimated_mse": error_of(found, settings),
        "seconds": rays.trace_seconds + rays.sample_seconds,
    }


def about_values(image: Image, reference: np.ndarray | None) -> None:
    """Add to an image's statistics its estimated and measured errors, and pixels that are not finite.

    ``estimated_mse`` is the mean of the pixels' variances; None where one is not known. Nothing in the
    statistics is NaN or infinite.
    """
    stats, pixels = image.stats, image.pixels.shape[0] * image.pixels.shape[1]
    unknown = int(np.count_nonzero(np.isnan(image.variance).any(axis=2)))
    stats["estimated_mse"] = None if unknown else float(image.variance.mean(dtype=np.float64))
    if unknown:
        stats["pixels_without_variance"] = unknown
        note = f"not known at {unknown} of {pixels} pixels: a point has fewer than two samples"
        image.metadata["variance"] = note
    broken = np.argwhere(~np.isfinite(image.pixels).all(axis=2))
    if len(broken):
        stats["pixels_not_finite"] = len(broken)
        row, column = broken[0].tolist()
        warnings.warn(
            f"{len(broken)} of {pixels} pixels are not finite, the first in row {row}, column {column}",
            stacklevel=5,
        )
    if reference is not None:
        stats |= {"mse": None, "relmse": None} if len(broken) else error_metrics(image.pixels, reference)
    image.stats = finite(stats)


def finite(value: Any) -> Any:
    """The same with None for NaN and infinity, which JSON cannot hold."""
    if isinstance(value, dict):
        return {name: finite(one) for name, one in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite(one) for one in value]
    is_broken = isinstance(value, (float, np.floating)) and not math.isfinite(value)
    return None if is_broken else value


def skips(
    points: ShadingPoints, rays: RayCount, inputs: tuple[str, ...], varying: tuple[str, ...]
) -> dict[str, Any]:
    """What the scene did not need; skipped rays count with the mean seconds of traced ones."""
    a_ray = rays.trace_seconds / rays.traced if rays.traced else 0.0
    return {
        "background_points": points.background,
        "points_without_light": points.dark,
        "points_on_lights": points.total - points.active - points.dark,
        "rays": rays.skipped,
        "ray_seconds": rays.skipped * a_ray,
        "inputs": [name for name in inputs if name not in varying],
    }


def identity(
    scene: Scene, settings: Settings, device: Device, network: Network | None
) -> dict[str, Any]:
    """All that decides an image's bits, by name; `network` is the one that was given."""
    return {
        "version": package_version(),
        "scene": scene.digest,
        "integrand": settings.integrand.name,
        "integrand options": {k: str(v) for k, v in sorted(settings.integrand.options.items())},
        "integrand's hash": settings.integrand.digest(scene),
        "method": settings.method,
        "spp": settings.spp,
        "size": settings.size,
        "seed": settings.seed,
        **settings.options("sampling", "training"),
        "network": "trained" if network is None else network.digest,
        "device": f"{device.identity}, VEC {device.vector_width}, LANES {device.lanes}",
        "fma": device.use_fma,
        "kernels": kernel_digest(),
        "tuning": tuning_digest(),
    }


def metadata(
    scene: Scene,
    settings: Settings,
    device: Device,
    drawn: Estimate | None,
    before: Estimate | None,
) -> dict[str, Any]:
    """What image files carry: enough to render them again."""
    chosen = settings.options("sampling", "training", "stopping")
    found: dict[str, Any] = {
        "version": package_version(),
        "scene": scene.name,
        "scene_digest": scene.digest,
        "integrand": settings.integrand.name,
        "method": settings.method,
        # Options that are None are left out.
        **{name: value for name, value in chosen.items() if value is not None},
        "density": settings.residual_density,
        "allocation": settings.allocation,
        "spp": _mean_samples(drawn),
        "train_spp": _mean_samples(before),
        "seed": settings.seed,
        "device": device.identity,
    }
    options = settings.integrand.options.items()
    return found | {k: v for k, v in options if k not in found and v is not None and v != math.inf}


def _mean_samples(estimate: Estimate | None) -> float:
    """Samples a point on average."""
    return float(estimate.samples.mean()) if estimate is not None else 0.0
