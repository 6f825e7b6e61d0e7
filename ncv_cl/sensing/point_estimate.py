"""Estimates of an integrand at points of the user, by the stages that make an image of a camera's."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..host.clock import Clock, Run, never
from ..integrands import Integrand
from ..integrands.emitted import emitted_light
from ..opencl.choose import choose_device
from ..output.keep import Keep
from ..output.report import finite
from ..output.resolve import combine, estimate_of, with_direct
from ..points.arrays import (
    OffSurfaceError,
    PointArrays,
    PointError,
    curve_cells,
    ordered,
)
from ..rendering.carried.passes import carried
from ..rendering.describe import counts
from ..rendering.pipeline import Outcome, estimate_integrals
from ..rendering.prepare import prepare
from ..rendering.render import given_network
from ..sampling.problem import Problem
from ..scene.load import Scene, load_scene
from ..settings.options import check_real, gathered
from ..settings.settings import Settings

# Errors are told from points that are estimated twice. So fewer points than these are each estimated
# several times over, by independent samples, until there are as many estimates.
FEWEST_ESTIMATES = 256
# Groups of options that points have; the others are for pictures.
POINT_GROUPS = ("sampling", "training", "stopping", "machine")


@dataclass(frozen=True)
class PointValues:
    """Estimates at points.

    Attributes
    ----------
    values, variance : ndarray
        float64, of the shape of the positions: (n, 3) or (rows, columns, 3), linear RGB, and the
        variances of these estimates; without the last axis for ambient occlusion. A variance is NaN
        where a point has one sample.
    stats : dict
        As `Image.stats`, and what is said in docs/sensors.md. Nothing in it is NaN or infinite.
    """

    values: np.ndarray
    variance: np.ndarray
    stats: dict[str, Any]

    @property
    def standard_error(self) -> np.ndarray:
        """The root of `variance`."""
        return np.sqrt(self.variance)


@dataclass(frozen=True)
class Asked:
    """What is asked for: an integrand at points, arrays float64 (n, 3) or (rows, columns, 3).

    Attributes
    ----------
    factor : float
        By which estimates are multiplied.
    sides : int
        2: the second half of the points are the other sides of the first.
    """

    integrand: Integrand
    positions: np.ndarray
    normals: np.ndarray
    outgoing: np.ndarray
    is_sensor: bool = False
    factor: float = 1.0
    sides: int = 1

    @property
    def shape(self) -> tuple[int, ...]:
        """Of the values, without the channels."""
        first, *rest = self.positions.shape[:-1]
        return (first // self.sides, *rest)


def estimate_at(scene: Scene | str | Path, asked: Asked, options: Mapping[str, Any]) -> PointValues:
    """The values that are asked for; options as `estimate_points` takes them."""
    started = time.perf_counter()
    if not isinstance(scene, Scene):
        scene = load_scene(scene)
    given, number, copies = _arrays(scene, asked)
    weight = asked.factor**2 * asked.sides / copies
    try:
        values, variance, stats = estimate_points(scene, asked.integrand, given, options, weight)
    except OffSurfaceError as error:
        raise _off_surface(scene, asked, np.isin(number, error.where // copies)) from error
    channels = values.shape[1]
    values, variance = (
        one.reshape(-1, copies, channels).mean(axis=1) for one in (values, variance / copies)
    )
    zero = int(np.count_nonzero((values == 0).all(axis=1)))
    shape = (asked.sides, *asked.shape, channels)
    values = asked.factor * values[number].reshape(shape).sum(axis=0)
    variance = asked.factor**2 * variance[number].reshape(shape).sum(axis=0)
    counts = {name: stats[name] // copies for name in stats if name.startswith("points_")}
    stats |= counts | {
        "points": len(number) // asked.sides,
        "points_zero": zero,
        "equal_points": len(number) - len(given.positions) // copies,
        "estimates_a_point": copies,
    }
    if values.size:
        stats["mean_standard_error"] = float(np.sqrt(variance).mean())
        stats["largest_standard_error"] = float(np.sqrt(variance).max())
        stats["seconds"]["total"] = time.perf_counter() - started
    return PointValues(values, variance, finite(stats))


def estimate_points(
    scene: Scene,
    integrand: Integrand,
    given: PointArrays,
    options: Mapping[str, Any],
    weight: float,
) -> tuple[np.ndarray, np.ndarray, dict[str, Any]]:
    """Estimates at points, their variances, float64 (points, channels), and statistics.

    Parameters
    ----------
    options : mapping
        `method`, `spp`, `seed`, `device`, `progress`, `target_error`, the groups of options
        that points have, and single options of these, as `irradiance` takes them.
    weight : float
        Mean square error of what is made of the estimates, over that of the estimates.
    """
    started = time.perf_counter()
    options = dict(options)
    method, spp, seed = (options.pop(k, v) for k, v in (("method", "auto"), ("spp", 256), ("seed", 0)))
    wanted, progress = options.pop("target_error", None), bool(options.pop("progress", False))
    device = options.pop("device", None)
    groups = gathered({kind: options.pop(kind, None) for kind in POINT_GROUPS}, options)
    machine = groups.pop("machine")
    machine.check()
    settings = Settings(integrand, method, spp, given.size, seed, **groups)
    share = len(given.positions) / (settings.columns * settings.rows)
    settings = _with_target(settings, wanted, share / weight)
    integrand.check(scene)
    network = given_network(settings.training.network)
    device = choose_device(device)
    if not len(given.positions):
        empty = np.zeros((0, integrand.channels))
        return empty, empty.copy(), {"device": device.identity}
    clock = Clock(settings.stopping.time_limit, started)
    run = Run(clock=clock, stop=settings.stopping.stop or never, progress=progress)
    problem = prepare(device, scene, settings, machine.threads, run.watch, given)
    settings = problem.sampled(settings)
    with carried(problem, machine, run, scene, given) as problem:
        outcome = estimate_integrals(problem, settings, run, Keep(), network)
    values, variance = _values(scene, settings, problem, outcome, given.cells)
    stats = _stats(settings, problem, outcome, run)
    stats["seconds"]["total"] = time.perf_counter() - started
    return values, variance, stats


def _arrays(scene: Scene, asked: Asked) -> tuple[PointArrays, np.ndarray, int]:
    """The points to estimate, how many copies of each, and which each point that is asked for is."""
    parts = (asked.positions - scene.origin, asked.normals, asked.outgoing)
    rows = np.concatenate([part.reshape(-1, 3) for part in parts], axis=1).astype(np.float32)
    if asked.positions.ndim == 3:
        cells, size = np.arange(len(rows), dtype=np.uint32), asked.positions.shape[1::-1]
        number, copies = np.arange(len(rows)), 1
    else:
        # A zero has a sign, which equal points must not differ in.
        rows += np.float32(0.0)
        first, number = ordered(rows) if len(rows) else (np.arange(0), np.arange(0))
        rows = rows[first]
        copies = -(-FEWEST_ESTIMATES // max(len(rows), 1)) if len(rows) < FEWEST_ESTIMATES else 1
        rows = np.repeat(rows, copies, axis=0)
        cells, size = curve_cells(len(rows))
    size = (max(size[0], 1), max(size[1], 1))
    position, normal, outgoing = (np.ascontiguousarray(part) for part in np.split(rows, 3, axis=1))
    return PointArrays(position, normal, outgoing, cells, size, asked.is_sensor), number, copies


def _off_surface(scene: Scene, asked: Asked, off: np.ndarray) -> PointError:
    """What is said of points that are `off` the surface, bool (points,)."""
    first = np.unravel_index(int(np.flatnonzero(off)[0]), asked.positions.shape[:-1])
    index = "".join(f"[{number}]" for number in first)
    return PointError(
        f"positions{index}: {asked.positions[first].tolist()} lies on no surface of {scene.name}, or "
        f"its normal lies in the surface; so do {np.count_nonzero(off) - 1} more. Radiance is that of a "
        "surface: give points of one, or ask for irradiance"
    )


def _with_target(settings: Settings, wanted: float | None, share: float) -> Settings:
    """The settings with the mean square error that stands for a root mean square error of the values.

    `share` is the one over the square of the other: it is a mean over the grid's cells.
    """
    if settings.sampling.supersample != 1:
        raise ValueError("supersample is for a camera's pixels: give more points instead")
    if wanted is None:
        return settings
    if settings.stopping.target_mse is not None:
        raise ValueError("give target_error or target_mse, not both")
    check_real("target_error", wanted, np.inf)
    mse = share * float(wanted) ** 2
    return replace(settings, stopping=replace(settings.stopping, target_mse=mse))


def _values(
    scene: Scene, settings: Settings, problem: Problem, outcome: Outcome, cells: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Estimates and variances, float64 (points, channels), of the points that were given in `cells`."""
    points, drawn, integrand = problem.points, outcome.drawn, settings.integrand
    estimates = estimate_of(drawn.plain, drawn.residual, outcome.integral)
    own = combine(*estimates, outcome.before, float(settings.spp), outcome.by_count)
    mean, variance = with_direct(*own, drawn.direct)
    found = np.zeros((2, points.total, integrand.channels))
    found[:, : points.active] = mean.T, variance.T
    emitted = emitted_light(scene, integrand, points)
    if emitted.any():
        found = np.broadcast_to(found, (2, points.total, 3)).copy()
        found[0] += emitted
    place = np.empty(settings.columns * settings.rows, np.int64)
    place[points.cell] = np.arange(points.total)
    mean, variance = found[:, place[cells]]
    return mean, variance


def _stats(settings: Settings, problem: Problem, outcome: Outcome, run: Run) -> dict[str, Any]:
    """Counts as of a render, and what is particular to points."""
    points = problem.points
    found = counts(settings, problem, outcome, run.watch, 0.0)
    detached = (points.rows("detached")[0] > 0) & (points.light < 0)
    return found | {
        "points_sampled": found["points"],
        "points_detached": int(np.count_nonzero(detached)),
        "points_on_lights": int(np.count_nonzero(points.light >= 0)),
        "points_without_light": points.dark,
    }
