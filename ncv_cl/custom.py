"""Integrals of other people's functions over the unit square, by the renderer's own machinery."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from .allocate import Allocation, allocate
from .choose import choose_device
from .device import Device, HostArray
from .encode import GridCube
from .estimate import Estimate
from .estimation import Estimation
from .integrands import Integrand, IntegrandError
from .learn import learn
from .passes import pass_edges
from .points import ROW, ROW_COUNT, ShadingPoints
from .presets import PRESETS
from .program import build
from .report import finite
from .resolve import combine, estimate_of
from .sampler import Stream, sampler_defines, seed_words
from .samples import Batch, Batches, ray_defines
from .scene import Scene
from .settings import RenderSettings, Stopwatch
from .variate import ControlVariate, control_variate
from .warp import Warp

# Samples a point on average in one call of the callable, about.
SAMPLES_A_PASS = 128
# How many values a callable's constant is the median of: an odd number at each of some points.
OFFSET_POINTS, OFFSET_SAMPLES = 256, 17
# Squares of larger values, and sums of these, are beyond float32.
LARGEST_VALUE = 1e15

Function = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


class HostIntegrand(Integrand):
    """An integrand that a Python callable evaluates."""

    name = "custom"
    files = ()
    inputs = ("position",)
    demodulated = False
    emitters_active = True
    channels = 1

    def __init__(self, channels: int) -> None:
        self.channels = channels

    def data(self, scene: Scene) -> np.ndarray:
        return np.empty(0, np.float32)

    def defines(self, scene: Scene) -> dict[str, int]:
        return {"CHANNELS": self.channels}


class CallableSource(Batches):
    """Draws samples of a callable less a constant, as `SampleSource` does of a scene's integrand.

    Attributes
    ----------
    offset : ndarray
        float64 (channels,), the constant: 0, and after `centre` the median of a few values at some
        points. What is integrated is then near zero whatever f is, and float32 holds its differences.
        Any constant leaves the estimate as it is once it is added again; this one rests on samples that
        nothing else uses.
    """

    def __init__(
        self,
        device: Device,
        points: ShadingPoints,
        function: Function,
        channels: int,
        sampler: str,
        seed: int,
    ) -> None:
        super().__init__(device, points, channels, SAMPLES_A_PASS)
        self._function = function
        self._seed = seed_words(seed)
        self._defines = {
            **sampler_defines(sampler),
            **ray_defines(),
        }
        with self._slot.mapped(write=True) as slot, self._visible.mapped(write=True) as visible:
            slot[...], visible[...] = np.arange(len(slot), dtype=np.uint32), 1
        self.offset = np.zeros(channels)

    def centre(self) -> None:
        """Take off the medians of f's channels, over `OFFSET_SAMPLES` at each of some of the points."""
        points = self.points.active
        chosen = np.linspace(0, points, min(points, OFFSET_POINTS), endpoint=False)
        order = HostArray.of(self.device, chosen.astype(np.uint32))
        parts = self.parts(range(len(chosen)), range(OFFSET_SAMPLES))
        values = [self._values(*part, Stream.OFFSET, order)[0] for part in parts]
        flat = np.concatenate([one.reshape(-1, self.channels) for one in values])
        self.offset = self.offset + np.median(flat, axis=0)

    def draw(
        self,
        points: range,
        samples: range,
        stream: int,
        order: HostArray | None = None,
        density: Warp | None = None,
    ) -> Batch:
        order = self._every_point if order is None else order
        values, warp = self._values(points, samples, stream, order, density)
        stride = self._stride_of(len(samples))
        count, shape = len(points) * stride, (len(points), stride)
        with self._value.mapped(write=True) as view:
            planes = view.reshape(-1)[: self.channels * count].reshape(self.channels, *shape)
            planes[..., : len(samples)] = np.moveaxis(values, -1, 0)
            planes[..., len(samples) :] = 0
        arrays = (self._u, self._v, self._value, self._slot, self._visible)
        return Batch(points, order, len(samples), stride, *arrays, *warp)

    def _values(
        self,
        points: range,
        samples: range,
        stream: int,
        order: HostArray,
        density: Warp | None = None,
    ) -> tuple[np.ndarray, list[HostArray]]:
        """f less the constant, float64 (points, samples, channels), and with a density the weights."""
        stride = self._stride_of(len(samples))
        warp, files, defines = [], (), {}
        if density is not None:
            warp = [density.records(order, points), self._weight]
            files, defines = density.files, density.defines
        defines = {**self._defines, **defines, "WARPED": int(bool(warp))}
        program = build(self.device, ("common", "sampler", *files, "custom"), defines)
        program.kernel("draw_coordinates")(
            len(points) * stride // self.device.vector_width,
            points.start,
            len(points),
            samples.start,
            stride,
            stream,
            *self._seed,
            order,
            *warp,
            self._u,
            self._v,
        )
        count, shape = len(points) * stride, (len(points), stride)
        u, v = (array.read(count).reshape(shape)[:, : len(samples)] for array in (self._u, self._v))
        chosen = order.read()[points.start : points.stop]
        index = np.broadcast_to(chosen[:, None], u.shape)
        values = self._evaluate(u.ravel(), v.ravel(), index.ravel())
        return values.reshape(*u.shape, self.channels), warp[1:]

    def _evaluate(self, u: np.ndarray, v: np.ndarray, index: np.ndarray) -> np.ndarray:
        """f less the constant, float64 (samples, channels), checked."""
        values = np.asarray(self._function(u, v, index))
        if values.shape not in ((u.size, self.channels), *(((u.size,),) if self.channels == 1 else ())):
            raise IntegrandError(
                f"f must return {(u.size, self.channels)} values for {u.size} samples, "
                f"returned {values.shape}"
            )
        if values.dtype.kind not in "bfiu":
            raise IntegrandError(f"f must return real numbers, returned {values.dtype}")
        values = values.reshape(u.size, self.channels).astype(np.float64) - self.offset
        for what, bad in (
            ("not finite", ~np.isfinite(values)),
            (f"beyond its median by more than {LARGEST_VALUE:.0e}", np.abs(values) > LARGEST_VALUE),
        ):
            if not bad.any():
                continue
            samples = np.flatnonzero(bad.any(axis=1))
            first = samples[0]
            raise IntegrandError(
                f"f is {what} at {len(samples)} of {u.size} samples of "
                f"{len(np.unique(index[samples]))} points, "
                f"first at u = {u[first]}, v = {v[first]}, point {index[first]}"
            )
        return values


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
    estimation = Estimation(device, source, settings, chosen, edges, folded, table, watch)
    estimation.passes.run("estimate")
    results = estimation.results()
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
