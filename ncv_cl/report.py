"""What an image says of how it was made: statistics and metadata."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version

from .device import Device
from .estimate import Estimate
from .network import Network
from .points import ShadingPoints
from .samples import RayCount
from .scene import Scene
from .settings import RenderSettings, Stopwatch


def package_version() -> str:
    """The installed version of ncv_cl."""
    try:
        return version("ncv_cl")
    except PackageNotFoundError:
        return "unpackaged"


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
) -> dict[str, object]:
    """Counts of a render; means are over the image's points, whole numbers where all have the same."""
    drawn = _mean_samples(plain) if points.active else 0.0
    trained = _mean_samples(training)
    found: dict[str, object] = {
        "rays_traced": rays.traced,
        "rays_on_device": rays.on_device,
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
    reference = plain if training is None else training
    if residual is not None and reference.variance.any():
        sampled = reference.samples > 1
        found["residual_variance_ratio"] = float(
            residual.variance.mean() / reference.variance[:, sampled].mean()
        )
    return found


def skips(
    points: ShadingPoints, rays: RayCount, inputs: tuple[str, ...], varying: tuple[str, ...]
) -> dict[str, object]:
    """What the scene did not need, and the seconds that rays would have taken at the others' mean."""
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
    scene: Scene, settings: RenderSettings, device: Device, given_network: bool
) -> dict[str, object]:
    """All that decides an image's bits, by name."""
    return {
        "version": package_version(),
        "scene": scene.digest,
        "integrand": settings.integrand.name,
        "integrand options": {k: str(v) for k, v in sorted(vars(settings.integrand).items())},
        "method": settings.method,
        "sampler": settings.sampler,
        "spp": settings.spp,
        "train_spp": settings.train_spp,
        "size": settings.size,
        "supersample": settings.supersample,
        "seed": settings.seed,
        "preset": settings.preset,
        "density": settings.density,
        "allocation": settings.allocation,
        "skip_dark": settings.skip_dark,
        "visibility": settings.visibility,
        "network": "given" if given_network else "trained",
        "device": f"{device.identity}, VEC {device.vector_width}, LANES {device.lanes}",
    }


def metadata(
    scene: Scene,
    settings: RenderSettings,
    device: Device,
    drawn: Estimate | None,
    before: Estimate | None,
) -> dict[str, object]:
    """What image files carry: enough to render them again."""
    return {
        "version": package_version(),
        "scene": scene.name,
        "scene_digest": scene.digest,
        "integrand": settings.integrand.name,
        "method": settings.method,
        "preset": settings.preset,
        "sampler": settings.sampler,
        "density": settings.residual_density,
        "spp": _mean_samples(drawn),
        "train_spp": _mean_samples(before),
        "supersample": settings.supersample,
        "seed": settings.seed,
        "device": device.identity,
        # Options of the integrand; without an entry: none.
        **{name: value for name, value in vars(settings.integrand).items() if value is not None},
    }


def _mean_samples(estimate: Estimate | None) -> float:
    """Samples a point on average."""
    return float(estimate.samples.mean()) if estimate is not None else 0.0
