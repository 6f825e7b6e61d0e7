"""From a scene to its `Problem`: shading points, and the source of their samples."""

from __future__ import annotations

import numpy as np

from ..estimation.direct import direct_samples
from ..estimation.method import noise_that_stays
from ..host.clock import Stopwatch
from ..integrands import Integrand
from ..integrands.emitted import emitted_light
from ..integrands.light_sources import light_sources
from ..integrands.lights import narrowest_strip
from ..opencl.device import Device
from ..points.arrays import PointArrays, place_points
from ..points.points import ShadingPoints, find_points
from ..points.trace import Tracer
from ..sampling.paths import sample_source
from ..sampling.problem import Apart, Decisions, Problem
from ..sampling.samples import SAMPLES_A_PASS, SampleSource
from ..scene.load import Scene
from ..settings.settings import Settings
from ..visibility.hierarchy import Hierarchy
from ..visibility.lines import lines_pay
from ..visibility.shaft import MOST_OCCLUDERS, Occluders, shafts_pay
from ..visibility.slices import SliceChoice, Slices, boxes_pay, slices_for
from ..visibility.trace import DeviceTracer
from ..visibility.tuning import MOST_LIGHTS, MOST_ON_LINES

# Points that are farther out of a scene's bounds than this part of its extent widen them.
OUTSIDE = 2.0**-10
# Where a point's coordinates are larger than the scene's by this factor, shadows are left to embree: at
# 20 times they are right, at 200 some percent are not.
FAR = 16.0


def prepare(
    device: Device,
    scene: Scene,
    settings: Settings,
    threads: int | None,
    watch: Stopwatch,
    given: PointArrays | None = None,
) -> Problem:
    """Find shading points, and set up their sampling.

    Parameters
    ----------
    given : PointArrays, optional
        The points; by default they are what the camera's rays hit.
    threads : int, optional
        Of the host, for tracing; all cores by default.
    watch : Stopwatch
        Gets the seconds of stages "scene", "points", "shafts" and "slices".
    """
    integrand = settings.integrand
    if settings.sampling.visibility == "lines" and scene.has_holes:
        raise ValueError(
            f"{scene.name}: visibility 'lines' takes triangles for whole, but textures make holes in "
            "some; take 'auto'"
        )
    by_lines = settings.sampling.visibility == "lines" and not integrand.promises("sliced")
    if by_lines and scene.environment is not None:
        raise ValueError(
            f"{scene.name}: visibility 'lines' is for area lights, there is an environment or a "
            "directional light; take 'auto'"
        )
    by_lights = integrand.promises("to_lights") or integrand.splits
    if settings.sampling.visibility == "lines" and scene.has_panes and by_lights:
        raise ValueError(
            f"{scene.name}: visibility 'lines' takes triangles for opaque, but there are thin panes; "
            "take 'auto'"
        )
    if settings.sampling.visibility == "lines" and not (
        integrand.promises("sliced") or shafts_pay(scene)
    ):
        raise ValueError(
            f"{scene.name}: visibility 'lines' is for at most {MOST_LIGHTS} parallelograms, triangles "
            f"and discs that shine, there are {_lights(scene)}; take 'auto'"
        )
    is_near = _is_near(scene, given)
    if settings.sampling.visibility == "lines" and not is_near:
        raise ValueError(
            f"{scene.name}: visibility 'lines' is for points that are no farther away than {FAR:g} "
            "times the scene's extent; take 'auto'"
        )
    with watch("scene"):
        tracer = Tracer(scene, threads)
        hierarchy = Hierarchy(device, scene) if traces_on_device(device, scene, settings) else None
    with watch("points"):
        points = _points(device, scene, tracer, settings, given)
        points = _without_dark(scene, settings, points)
    occluders, lines = None, False
    looked_for = settings.sampling.visibility != "embree" and shafts_pay(scene) and is_near
    if integrand.promises("to_lights") and looked_for and points.active:
        with watch("shafts"):
            occluders, lines = _occluders(device, scene, settings, points, hierarchy)
    slices, choice = None, None
    if integrand.promises("sliced") and points.active and is_near:
        with watch("slices"):
            slices, choice = _slices(device, scene, settings, points, hierarchy)
    split = _splits(scene, settings, points, lines)
    return assemble(
        device,
        scene,
        # Whoever found the points.
        tracer if hierarchy is None else DeviceTracer(device, hierarchy),
        settings,
        points,
        _bounds(scene, given),
        occluders,
        slices,
        lines,
        split,
        choice,
    )


def assemble(
    device: Device,
    scene: Scene,
    tracer: Tracer | DeviceTracer,
    settings: Settings,
    points: ShadingPoints,
    bounds: np.ndarray,
    occluders: Occluders | None,
    slices: Slices | None,
    lines: bool,
    split: bool,
    choice: SliceChoice | None = None,
) -> Problem:
    """The problem of some points, by what was decided for all of them (`Decisions`)."""
    integrand = settings.integrand
    decisions = Decisions(occluders.longest if occluders else None, lines, slices is not None, split)
    common = (settings.sampling.sampler, settings.seed, SAMPLES_A_PASS)
    apart, rest = None, integrand
    parts = integrand.apart(scene) if split else None
    if parts is not None:
        direct, rest = parts
        lit = _lit(scene, settings, direct, points)
        own = SampleSource(device, scene, tracer, points, direct, *common, occluders, lines=lines)
        # Paths have no rays to test then.
        apart, occluders = Apart(own, lit), None
    source = sample_source(
        device,
        scene,
        tracer,
        points,
        rest,
        *common,
        occluders,
        lines=lines,
        slices=slices,
        shadows_tested=settings.sampling.visibility != "embree",
    )
    glow = emitted_light(scene, integrand, points)[: points.active].T
    narrowest = 1.0
    if "LIGHT_COUNT" in integrand.defines(scene):
        narrowest = narrowest_strip(scene)
    return Problem(
        device,
        points,
        source,
        bounds,
        integrand.inputs,
        integrand.demodulated,
        narrowest=narrowest,
        glow=glow if glow.any() else None,
        apart=apart,
        slices=choice,
        decisions=decisions,
        no_network=noise_that_stays(scene, integrand, points) if settings.method == "auto" else None,
    )


def _lights(scene: Scene) -> str:
    lights = light_sources(scene).lights
    return f"{len(lights.strip)} lights" + (", some of them balls" if lights.has_balls else "")


def traces_on_device(device: Device, scene: Scene, settings: Settings) -> bool:
    """Whether kernels trace the rays of samples and paths, as option `rays` has it."""
    sampling = settings.sampling
    if sampling.rays == "device" and scene.has_gaps:
        raise ValueError(
            f"{scene.name}: rays 'device' take triangles for whole, but textures make holes in some or "
            "there are thin panes; take 'auto'"
        )
    if sampling.rays == "auto":
        return device.is_gpu and sampling.visibility != "embree" and not scene.has_gaps
    return sampling.rays == "device"


def _points(
    device: Device, scene: Scene, tracer: Tracer, settings: Settings, given: PointArrays | None
) -> ShadingPoints:
    emitters_active = settings.integrand.emitters_active
    if given is not None:
        return place_points(device, scene, tracer, given, emitters_active)
    size, supersample = settings.size, settings.sampling.supersample
    return find_points(device, scene, tracer, *size, supersample, emitters_active)


def _is_near(scene: Scene, given: PointArrays | None) -> bool:
    """Whether occluders, whose corners are taken from each point, are resolved there."""
    if given is None or not len(given.positions):
        return True
    return float(np.abs(given.positions).max()) <= FAR * float(np.abs(scene.bounds).max())


def _bounds(scene: Scene, given: PointArrays | None) -> np.ndarray:
    """Bounds in the world, float64 (2, 3), of the scene and of points that lie outside of it."""
    bounds = scene.world_bounds
    if given is None:
        return bounds
    positions = given.positions.astype(np.float64) + scene.origin
    least, most = positions.min(axis=0), positions.max(axis=0)
    # Points of the surface may be rounded out of it.
    slack = OUTSIDE * np.ptp(bounds, axis=0).max()
    lower = np.where(least < bounds[0] - slack, least, bounds[0])
    return np.stack([lower, np.where(most > bounds[1] + slack, most, bounds[1])])


def _occluders(
    device: Device,
    scene: Scene,
    settings: Settings,
    points: ShadingPoints,
    hierarchy: Hierarchy | None,
) -> tuple[Occluders, bool]:
    """What stands between the points and the lights, and whether to sample along lines."""
    integrand, visibility = settings.integrand, settings.sampling.visibility
    splits = integrand.apart(scene) is not None and settings.sampling.split_direct != "off"
    if (integrand.promises("along_lines") or splits) and visibility in ("auto", "lines"):
        samples = direct_samples(settings.spp) if splits else settings.spp
        occluders = Occluders(device, scene, points, integrand, MOST_ON_LINES, hierarchy)
        if visibility == "lines" or lines_pay(occluders.mean_count, samples):
            return occluders, True
        hierarchy = occluders.hierarchy
    return Occluders(device, scene, points, integrand, MOST_OCCLUDERS, hierarchy), False


def _splits(scene: Scene, settings: Settings, points: ShadingPoints, lines: bool) -> bool:
    """Whether direct light and the rest are estimated apart."""
    asked = settings.sampling.split_direct
    parts = settings.integrand.apart(scene)
    if asked == "on" and parts is None:
        raise ValueError(f"{scene.name}: there is no light but direct light, or none of it, to split")
    if parts is None or not points.active or not (asked == "on" or (asked == "auto" and lines)):
        return False
    return bool(len(_lit(scene, settings, parts[0], points)))


def _lit(scene: Scene, settings: Settings, direct: Integrand, points: ShadingPoints) -> np.ndarray:
    """The points that direct light can reach, uint32."""
    lit = np.arange(points.active, dtype=np.uint32)
    dark = direct.dark(scene, points) if settings.sampling.skip_dark else None
    return lit if dark is None else lit[~dark]


def _slices(
    device: Device,
    scene: Scene,
    settings: Settings,
    points: ShadingPoints,
    hierarchy: Hierarchy | None,
) -> tuple[Slices | None, SliceChoice | None]:
    """Boxes to find slices in, if these are to be taken; and of "auto", how many, if it looked.

    A network that is asked for gets rays: of slices it takes off no more than a few more of them.
    """
    sampling, spp = settings.sampling, settings.spp
    if sampling.visibility == "lines":
        return Slices(device, scene, hierarchy), None
    by_network = settings.method == "ncv" or settings.training.network is not None
    if sampling.visibility != "auto" or by_network or scene.has_holes:
        return None, None
    if not boxes_pay(len(scene.triangles), points.active, spp):
        return None, None
    slices = Slices(device, scene, hierarchy)
    cost = slices.cost(points, float(settings.integrand.data(scene)[0]))
    choice = SliceChoice(slices_for(spp, cost, sampling.sampler), cost)
    return (slices if choice.number else None), choice


def _without_dark(scene: Scene, settings: Settings, points: ShadingPoints) -> ShadingPoints:
    """The points without those that face away from every light; the others keep their samples."""
    dark = settings.integrand.dark(scene, points)
    if dark is None:
        return points
    points = points.with_dark_last(dark)
    return points.without_last(int(dark.sum())) if settings.sampling.skip_dark else points
