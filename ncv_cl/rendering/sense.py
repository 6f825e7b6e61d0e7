"""Values at points of the user: irradiance of sensors, radiance of surfaces, ambient occlusion."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..host.clock import Clock, Run, never
from ..integrands import AmbientOcclusion, DirectLight, GlobalIllumination, Integrand, IntegrandError
from ..opencl.choose import choose_device
from ..output.keep import Keep
from ..output.report import finite, seconds_of, statistics
from ..output.resolve import combine, estimate_of
from ..points.arrays import PointArrays, checked_vectors, curve_cells, ordered, unit_vectors
from ..sampling.problem import Problem
from ..scene.load import Scene, load_scene
from ..settings.options import check_real, gathered
from ..settings.settings import Settings
from .pipeline import Outcome, estimate_integrals
from .prepare import prepare
from .render import integrand_of


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
    stats: dict[str, object]

    @property
    def standard_error(self) -> np.ndarray:
        """The root of `variance`."""
        return np.sqrt(self.variance)


def irradiance(
    scene: Scene | str | Path,
    positions: np.ndarray,
    normals: np.ndarray,
    *,
    integrand: str | Integrand = "direct",
    both_sides: bool = False,
    **options: object,
) -> PointValues:
    """Irradiance of plane sensors, in the unit of the scene's radiance times steradian.

    E(x, n) = ∫ L(x, ω) max(n · ω, 0) dω over the directions ω that light comes from.

    Parameters
    ----------
    scene : Scene, str or Path
        A scene, or the path of its TOML file.
    positions : array (n, 3) or (rows, columns, 3)
        Where the sensors are, in the world. A sensor within 2^-16 of its largest coordinate (and 2^-20
        of the scene's) of a surface lies on it, on the side of its normal. Of sensors in rows and
        columns, neighbours are taken for neighbours in space, as in an image; of others it does not
        matter in which order they come.
    normals : array of the shape of positions
        Scaled to length 1.
    integrand : {"direct", "gi"} or Integrand
        Light that arrives straight from area lights, or all light.
    both_sides : bool
        Add the irradiance of the sensor's other side.
    **options
        `method`, `spp`, `seed`, `device`, `progress`, the groups `sampling`, `training`, `stopping` and
        `machine` and their single options as `render` takes them, but for `supersample`; and
        `target_error`: end when the root mean square standard error of the values is estimated to be
        this.

    Returns
    -------
    PointValues

    Raises
    ------
    PointError
        For arrays of wrong shapes, and numbers that are not finite or vectors of length zero, by index.
    ValueError, TypeError, DeviceError
        As `render` raises them.
    """
    chosen = integrand_of(integrand)
    if not isinstance(chosen, (DirectLight, GlobalIllumination)):
        raise IntegrandError(
            f"irradiance is of integrand direct or gi, not {chosen.name}; there are also "
            "ncv.ambient_occlusion and ncv.radiance"
        )
    at, normal = _place_and_normal(positions, normals)
    ask = _Asked(chosen, at, normal, normal, is_sensor=True, factor=np.pi)
    if not both_sides:
        return _estimate(scene, ask, options)
    # Another axis in front, so that a grid stays one.
    both = replace(ask, positions=np.concatenate([at, at]), normals=np.concatenate([normal, -normal]),
                   outgoing=np.concatenate([normal, -normal]), sides=2)  # fmt: skip
    return _estimate(scene, both, options)


def radiance(
    scene: Scene | str | Path,
    positions: np.ndarray,
    normals: np.ndarray,
    directions: np.ndarray,
    *,
    integrand: str | Integrand = "gi",
    **options: object,
) -> PointValues:
    """Radiance that leaves points of the scene's surface, as a camera sees it.

    Parameters
    ----------
    scene, positions, **options
        As for `irradiance`; every position must lie on a surface, whose material counts.
    normals : array of the shape of positions
        Shading normals, scaled to length 1. The triangle's own normal is the scene's.
    directions : array of the shape of positions
        Towards the viewer, scaled to length 1.
    integrand : {"gi", "direct", "ao"}, str or Integrand
        As `render` takes it. What lights and materials emit is part of the radiance, as in an image.

    Returns
    -------
    PointValues
        Its values are those of a pixel whose camera ray hits the point.

    Raises
    ------
    PointError
        As `irradiance` raises it, and for positions that lie on no surface.
    """
    at, normal = _place_and_normal(positions, normals)
    outgoing = unit_vectors("directions", directions, at.shape)
    return _estimate(scene, _Asked(integrand_of(integrand), at, normal, outgoing), options)


def ambient_occlusion(
    scene: Scene | str | Path,
    positions: np.ndarray,
    normals: np.ndarray,
    *,
    radius: float = np.inf,
    mapping: str = "height",
    **options: object,
) -> PointValues:
    """The share of the hemisphere about each normal that is open, weighted by the cosine.

    Parameters
    ----------
    scene, positions, normals, **options
        As for `irradiance`.
    radius, mapping
        As `AmbientOcclusion` takes them. Without a radius this is the sky view factor.

    Returns
    -------
    PointValues
        Its arrays are (n,), or (rows, columns).
    """
    at, normal = _place_and_normal(positions, normals)
    asked = _Asked(AmbientOcclusion(radius, mapping), at, normal, normal, is_sensor=True)
    found = _estimate(scene, asked, options)
    return replace(found, values=found.values[..., 0], variance=found.variance[..., 0])


@dataclass(frozen=True)
class _Asked:
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


def _place_and_normal(positions: object, normals: object) -> tuple[np.ndarray, np.ndarray]:
    at = checked_vectors("positions", positions)
    return at, unit_vectors("normals", normals, at.shape)


def _estimate(scene: Scene | str | Path, asked: _Asked, options: dict[str, object]) -> PointValues:
    """The values that are asked for."""
    started = time.perf_counter()
    options = dict(options)
    method, spp, seed = (options.pop(k, v) for k, v in (("method", "auto"), ("spp", 256), ("seed", 0)))
    wanted, progress = options.pop("target_error", None), bool(options.pop("progress", False))
    device = options.pop("device", None)
    kinds = ("sampling", "training", "stopping", "machine")
    groups = gathered({kind: options.pop(kind, None) for kind in kinds}, options)
    machine = groups.pop("machine")
    if not isinstance(scene, Scene):
        scene = load_scene(scene)
    given, number = _arrays(scene, asked)
    settings = Settings(asked.integrand, method, spp, given.size, seed, **groups)
    settings = _with_target(settings, wanted, asked, len(given.positions))
    settings.integrand.check(scene)
    device = choose_device(device)
    if not len(number):
        empty = np.zeros((*asked.shape, asked.integrand.channels))
        return PointValues(empty, empty.copy(), {"points": 0, "device": device.identity})
    clock = Clock(settings.stopping.time_limit, started)
    run = Run(clock=clock, stop=settings.stopping.stop or never, progress=progress)
    problem = prepare(device, scene, settings, machine.threads, run.watch, given)
    outcome = estimate_integrals(problem, settings, run, Keep())
    values, variance = _values(scene, settings, problem, outcome, given.cells)
    stats = _stats(settings, problem, outcome, run, values)
    shape = (asked.sides, *asked.shape, -1)
    values = asked.factor * values[number].reshape(shape).sum(axis=0)
    variance = asked.factor**2 * variance[number].reshape(shape).sum(axis=0)
    stats["equal_points"] = len(number) - len(given.positions)
    stats["mean_standard_error"] = float(np.sqrt(variance).mean())
    stats["largest_standard_error"] = float(np.sqrt(variance).max())
    stats["seconds"]["total"] = time.perf_counter() - started
    return PointValues(values, variance, finite(stats))


def _arrays(scene: Scene, asked: _Asked) -> tuple[PointArrays, np.ndarray]:
    """The points to estimate, and which of them each point that is asked for is."""
    parts = (asked.positions - scene.origin, asked.normals, asked.outgoing)
    rows = np.concatenate([part.reshape(-1, 3) for part in parts], axis=1).astype(np.float32)
    if asked.positions.ndim == 3:
        cells, size = np.arange(len(rows), dtype=np.uint32), asked.positions.shape[1::-1]
        number = np.arange(len(rows))
    else:
        # A zero has a sign, which equal points must not differ in.
        rows += np.float32(0.0)
        first, number = ordered(rows)
        rows = rows[first]
        cells, size = curve_cells(len(rows))
    size = (max(size[0], 1), max(size[1], 1))
    arrays = (np.ascontiguousarray(part) for part in np.split(rows, 3, axis=1))
    return PointArrays(*arrays, cells, size, asked.is_sensor), number


def _with_target(settings: Settings, wanted: object, asked: _Asked, points: int) -> Settings:
    """The settings with the mean square error, over cells, that stands for this error of the values."""
    if settings.sampling.supersample != 1:
        raise ValueError("supersample is for a camera's pixels: give more points instead")
    if wanted is None:
        return settings
    if settings.stopping.target_mse is not None:
        raise ValueError("give target_error or target_mse, not both")
    check_real("target_error", wanted, np.inf)
    share = points / (settings.columns * settings.rows) / asked.sides
    mse = (float(wanted) / asked.factor) ** 2 * share
    return replace(settings, stopping=replace(settings.stopping, target_mse=mse))


def _values(
    scene: Scene, settings: Settings, problem: Problem, outcome: Outcome, cells: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Estimates and variances, float64 (points, channels), of the points that were given in `cells`."""
    points, drawn, integrand = problem.points, outcome.drawn, settings.integrand
    estimates = estimate_of(drawn.plain, drawn.residual, outcome.integral)
    mean, variance = combine(*estimates, outcome.before, float(settings.spp), outcome.by_count)
    found = np.zeros((2, points.total, integrand.channels))
    found[:, : points.active] = mean.T, variance.T
    if points.material is not None:
        lit = np.flatnonzero(points.light >= 0)
        emitted = integrand.emitted(scene, points.light[lit], points.rows("outgoing")[:, lit])
        added = integrand.glow(scene, points.material)
        added[lit] += emitted
        if added.any():
            found = np.broadcast_to(found, (2, points.total, 3)).copy()
            found[0] += added
    place = np.empty(settings.columns * settings.rows, np.int64)
    place[points.cell] = np.arange(points.total)
    mean, variance = found[:, place[cells]]
    return mean, variance


def _stats(
    settings: Settings, problem: Problem, outcome: Outcome, run: Run, values: np.ndarray
) -> dict[str, object]:
    """Counts as of a render, and what is particular to points."""
    points, rays, drawn = problem.points, problem.source.rays, outcome.drawn
    found = statistics(
        points,
        rays,
        problem.device,
        drawn.plain,
        outcome.before,
        drawn.residual,
        outcome.network,
        drawn.points_done_twice,
    )
    found["seconds"] = seconds_of(run.watch, rays, 0.0)
    if outcome.training:
        found["training"] = outcome.training
    if settings.method == "auto":
        found["auto"] = outcome.plan.as_dict()
    detached = points.rows("detached")[0] > 0
    return found | {
        "ended_by": drawn.ended_by,
        "points_detached": int(np.count_nonzero(detached)),
        "points_on_lights": int(np.count_nonzero(points.light >= 0)),
        "points_without_light": points.dark,
        "points_zero": int(np.count_nonzero((values == 0).all(axis=1))),
    }
