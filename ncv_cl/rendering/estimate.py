"""Integrals of functions of the user over the unit square, by the renderer's own pipeline."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..host.clock import Clock, Run, Stopwatch, never
from ..opencl.choose import choose_device
from ..opencl.device import Device
from ..output.keep import Keep
from ..output.report import finite
from ..output.resolve import combine, estimate_of
from ..points.points import ShadingPoints
from ..sampling.callable import CallableSource, Function, HostIntegrand, function_points
from ..sampling.problem import Problem
from ..settings.options import MOST_CELLS, Sampling, Stopping, Training, changed, checked_whole, gathered
from ..settings.settings import Settings
from .carried.passes import carried
from .pipeline import Outcome, estimate_integrals

# There are usually few integrals, so a wider network costs little in all.
WIDE = Training(preset="wide")
# Options of sampling that need a scene.
OF_SCENES = {"supersample", "filter", "visibility", "rays", "split_direct", "skip_dark"}
# Features are brought into this cube.
UNIT_CUBE = np.array([(0.0, 0.0, 0.0), (1.0, 1.0, 1.0)])


@dataclass(frozen=True)
class Integrals:
    """Estimates of integrals.

    Attributes
    ----------
    mean, variance : ndarray
        float64 (points, channels): the estimates, and their variances, NaN where a point has one sample.
        Under Sobol sampling the variances are calibrated by a share of the points: with fewer than some
        hundred points they are coarse.
    network_integral : ndarray or None
        float64 (points, channels), the exact integral of the control variate.
    stats : dict
        Seconds, samples, and the residual's variance over the function's.
    """

    mean: np.ndarray
    variance: np.ndarray
    network_integral: np.ndarray | None
    stats: dict[str, Any]


def estimate(
    f: Function,
    points: int = 1,
    features: np.ndarray | None = None,
    channels: int = 1,
    method: str = "ncv",
    spp: int = 256,
    seed: int = 0,
    device: Device | int | str | None = None,
    sampling: Sampling | None = None,
    training: Training = WIDE,
    stopping: Stopping | None = None,
    **options: object,
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
    spp, seed, device, sampling, training, stopping, **options
        As `render` takes them, and options of the group machine; with an executor f must be one that can
        be pickled, and is called by workers; `spp` and `train_spp` are samples a point. For `train_spp`
        "auto" a call of f is assumed to cost as much as a cheap sample of a scene. The preset is "wide"
        by default, which leaves the least residual.

    Returns
    -------
    Integrals

    Raises
    ------
    IntegrandError
        If f returns another shape than it should, or numbers that are not finite.
    ValueError, TypeError
        For bad arguments, and options of scenes and cameras.
    """
    started = time.perf_counter()
    points = checked_whole("points", points, MOST_CELLS)
    channels = checked_whole("channels", channels, MOST_CELLS)
    if method not in ("ncv", "mc"):
        raise ValueError(f"method must be ncv or mc, got {method!r}")
    if method == "mc" and training is WIDE:
        training = Training()
    known = {"sampling": sampling, "training": training, "stopping": stopping, "machine": None}
    groups = gathered(known, options)
    machine = groups.pop("machine")
    machine.check()
    if machine.threads is not None:
        raise ValueError("threads is for scenes")
    settings = Settings(HostIntegrand(channels), method, spp, (points, 1), seed, **groups)
    unused = sorted(OF_SCENES & set(changed(settings.sampling)))
    if settings.allocation in ("pilot", "relative"):
        unused.append(f"allocation {settings.allocation}")
    if unused:
        raise ValueError(f"{unused[0]} is for scenes")
    device = choose_device(device)
    shading = _points_of(device, points, features)
    source = CallableSource(device, shading, f, channels, settings.sampling.sampler, seed)
    source.centre()
    problem = Problem(device, shading, source, UNIT_CUBE, ("position",), is_image=False)
    run = Run(clock=Clock(settings.stopping.time_limit, started), stop=settings.stopping.stop or never)
    with carried(problem, machine, run) as problem:
        outcome = estimate_integrals(problem, settings, run, Keep())
    return _integrals(problem, settings, outcome, source.offset, run.watch, started)


def _integrals(
    problem: Problem,
    settings: Settings,
    outcome: Outcome,
    offset: np.ndarray,
    watch: Stopwatch,
    started: float,
) -> Integrals:
    """The result of the pipeline, with `CallableSource.offset` added again."""
    drawn, training, integral = outcome.drawn, outcome.before, outcome.integral
    offset = offset[:, None]
    estimates = estimate_of(drawn.plain, drawn.residual, integral)
    mean, variance = combine(*estimates, training, float(settings.spp), outcome.by_count)
    stats: dict[str, Any] = {}
    if problem.carrier is not None:
        stats["machines"] = problem.carrier.statistics()
    stats |= {
        "seconds": {**watch.seconds, "total": time.perf_counter() - started},
        "samples_per_point": float(drawn.plain.samples.mean()),
        "training_samples_per_point": float(training.samples.mean()) if training else 0.0,
        "training": outcome.training,
        "ended_by": drawn.ended_by,
        "device": problem.device.identity,
    }
    residual = drawn.residual
    if residual is not None and training is not None and training.known.any():
        spread = training.variance[:, training.known].mean()
        left = residual.variance[:, residual.known].mean() if residual.known.any() else np.nan
        stats["residual_variance_ratio"] = float(left / spread) if spread else None
    network_integral = None if integral is None else (integral + offset).T
    return Integrals((mean + offset).T, variance.T, network_integral, finite(stats))


def _points_of(device: Device, points: int, features: np.ndarray | None) -> ShadingPoints:
    """Points whose positions are the features, brought into the unit cube."""
    positions = np.zeros((points, 3), np.float32)
    if features is not None:
        features = np.asarray(features)
        if features.dtype.kind not in "bfiu":
            raise ValueError(f"features must be real numbers, are {features.dtype}")
        # Features far from zero are centred first: float32 could not tell them apart.
        features = features.astype(np.float64)
        if features.ndim != 2 or len(features) != points or not 1 <= features.shape[1] <= 3:
            raise ValueError(f"features must be ({points}, 1 to 3), is {features.shape}")
        if not np.isfinite(features).all():
            raise ValueError("features must be finite")
        # Each axis has its own scale, since its range may differ from the others'. The numbers are
        # halved first, since the difference of two might overflow float64.
        lower, upper = 0.5 * features.min(axis=0), 0.5 * features.max(axis=0)
        positions[:, : features.shape[1]] = (0.5 * features - lower) / np.where(
            upper > lower, upper - lower, 1
        )
    return function_points(device, positions)
