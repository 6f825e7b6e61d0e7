"""Integrals of other people's functions over the unit square, by the renderer's own machinery."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from ..estimation.allocate import Allocation, allocate
from ..estimation.control_variate import ControlVariate, control_variate
from ..estimation.image_estimate import ImageEstimate
from ..estimation.passes import pass_edges
from ..learning.learn import learn
from ..network.encode import GridCube
from ..opencl.choose import choose_device
from ..opencl.device import Device, HostArray
from ..output.report import finite
from ..output.resolve import combine, estimate_of
from ..points.points import ROW, ROW_COUNT, ShadingPoints
from ..sampling.accumulate import Estimate
from ..sampling.callable import SAMPLES_A_PASS, CallableSource, Function, HostIntegrand
from ..settings.presets import PRESETS
from ..settings.settings import RenderSettings, Stopwatch


@dataclass(frozen=True)
class Integrals:
    """Estimates of integrals.

    Attributes
    ----------
    mean, variance : ndarray
        float64 (points, channels): the estimates, and the variances of these, NaN where they rest on one
        sample. Under Sobol sampling the latter are calibrated by a share of the points: with less than
        some hundreds they are coarse.
    network_integral : ndarray or None
        float64 (points, channels), the exact integral of the control variate.
    stats : dict
        Seconds, samples, and the residual's variance over the function's.
    """

    mean: np.ndarray
    variance: np.ndarray
    network_integral: np.ndarray | None
    stats: dict[str, object]


def estimate(
    f: Function,
    points: int = 1,
    features: np.ndarray | None = None,
    channels: int = 1,
    method: str = "ncv",
    sampler: str = "sobol",
    spp: int = 256,
    train_spp: float | str = "auto",
    seed: int = 0,
    preset: str = "wide",
    density: str | None = None,
    allocation: str | None = None,
    device: Device | int | str | None = None,
) -> Integrals:
    """Estimate ∫ f(u, v | point) du dv over the unit square for every point.

    Parameters
    ----------
    f : callable
        f(u, v, point) of float32 (n,), float32 (n,) and uint32 (n,) arrays returns (n, channels)
        numbers, or (n,) for one channel. Called with many samples at a time, from this thread only.
    points : int
        How many integrals.
    features : ndarray, optional
        (points, 1 to 3): what tells the integrals apart, as coordinates in a space where near points
        have similar integrands. Without it all points share one function of (u, v).
    channels : int
        Values of f.
    method : {"ncv", "mc"}
    sampler, spp, train_spp, seed, preset, density, allocation, device
        As `render` takes them; `spp` and `train_spp` are samples a point. A call of f counts as much
        as a cheap sample of a scene where "auto" weighs what training costs. The preset is by default
        the one of least residual, for each of few integrals bears a wider network.

    Returns
    -------
    Integrals

    Raises
    ------
    IntegrandError
        If f returns another shape than it should, or numbers that are not finite.
    ValueError
        For bad arguments.
    """
    if int(points) != points or points < 1 or int(channels) != channels or channels < 1:
        raise ValueError(f"points and channels must be at least 1, got {points!r} and {channels!r}")
    if method not in ("ncv", "mc"):
        raise ValueError(f"method must be ncv or mc, got {method!r}")
    settings = RenderSettings(
        HostIntegrand(channels), method, sampler, spp, train_spp, (points, 1), 1, seed, preset, density,
        allocation,
    )  # fmt: skip
    if settings.allocation == "pilot":
        raise ValueError("allocation 'pilot' is for scenes")
    device, watch = choose_device(device), Stopwatch()
    started = time.perf_counter()
    shading, cube = _points_of(device, points, features)
    source = CallableSource(device, shading, f, channels, sampler, seed)
    source.centre()
    variate = training = None
    about: dict[str, object] = {}
    if method == "ncv":
        variate, training, about = _control_variate(device, source, settings, cube, watch)
    if variate is not None and variate.density is not None and settings.allocates:
        chosen = Allocation.of_counts(allocate(variate.density.magnitude, spp))
    else:
        chosen = Allocation.uniform(np.arange(points, dtype=np.uint32), spp)
    folded, table = (variate.folded, variate.density) if variate else (None, None)
    edges = pass_edges(spp, SAMPLES_A_PASS)
    image_estimate = ImageEstimate(device, source, settings, chosen, edges, folded, table, watch)
    image_estimate.passes.run("estimate")
    results = image_estimate.results()
    by_count = not PRESETS[preset].density
    integral = variate.integral if variate else None
    offset = source.offset[:, None]
    residual = results[1] if variate else None
    mean, variance = combine(
        *estimate_of(results[0], residual, integral), training, float(spp), by_count
    )
    stats: dict[str, object] = {
        "seconds": {**watch.seconds, "total": time.perf_counter() - started},
        "samples_per_point": float(results[0].samples.mean()),
        "training_samples_per_point": float(training.samples.mean()) if training else 0.0,
        "training": about,
        "device": device.identity,
    }
    if residual is not None and training is not None and training.known.any():
        spread = training.variance[:, training.known].mean()
        left = residual.variance[:, residual.known].mean() if residual.known.any() else np.nan
        stats["residual_variance_ratio"] = float(left / spread) if spread else None
    network_integral = None if integral is None else (integral + offset).T
    return Integrals((mean + offset).T, variance.T, network_integral, finite(stats))


def _points_of(
    device: Device, points: int, features: np.ndarray | None
) -> tuple[ShadingPoints, GridCube]:
    """Points whose positions are the features, and the cube around these."""
    positions = np.zeros((points, 3), np.float32)
    if features is not None:
        features = np.asarray(features)
        if features.dtype.kind not in "bfiu":
            raise ValueError(f"features must be real numbers, are {features.dtype}")
        # Far from zero, features differ by less than float32 can say until they are centred.
        features = features.astype(np.float64)
        if features.ndim != 2 or len(features) != points or not 1 <= features.shape[1] <= 3:
            raise ValueError(f"features must be ({points}, 1 to 3), is {features.shape}")
        if not np.isfinite(features).all():
            raise ValueError("features must be finite")
        # Each axis at its own scale: what differs by much on one may differ by little on another. In
        # halves, or the difference of two numbers might be beyond float64.
        lower, upper = 0.5 * features.min(axis=0), 0.5 * features.max(axis=0)
        positions[:, : features.shape[1]] = (0.5 * features - lower) / np.where(
            upper > lower, upper - lower, 1
        )
    surface = np.zeros((ROW_COUNT, points), np.float32)
    surface[ROW["POSITION"] : ROW["POSITION"] + 3] = positions.T
    nowhere = np.full(points, -1, np.int32)
    shading = ShadingPoints(
        HostArray.of(device, surface), np.arange(points, dtype=np.uint32), nowhere, points, 0
    )
    return shading, GridCube((0.0, 0.0, 0.0), 1.0)


def _control_variate(
    device: Device, source: CallableSource, settings: RenderSettings, cube: GridCube, watch: Stopwatch
) -> tuple[ControlVariate | None, Estimate, dict[str, object]]:
    """The control variate, None where training diverged twice; training's estimate and statistics."""
    learned = learn(device, cube, source, settings, ("position",), lambda _: None, watch, lambda: False)
    if learned.network is None:
        return None, learned.estimate, learned.statistics
    variate = control_variate(device, source.points, settings, learned.network, watch, learned)
    return variate, learned.estimate, learned.statistics
