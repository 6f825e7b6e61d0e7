"""From a scene to its `Problem`: shading points, and the source of their samples."""

from __future__ import annotations

from ..host.clock import Stopwatch
from ..integrands.lights import narrowest_strip
from ..opencl.device import Device
from ..points.points import ShadingPoints, find_points
from ..points.trace import Tracer
from ..sampling.paths import sample_source
from ..sampling.problem import Problem
from ..sampling.samples import SAMPLES_A_PASS
from ..scene.load import Scene
from ..settings.settings import Settings
from ..visibility.lines import lines_pay, most_on_lines
from ..visibility.shaft import MOST_OCCLUDERS, Occluders, shafts_pay
from ..visibility.slices import SliceChoice, Slices, boxes_pay, slices_for
from ..visibility.tuning import MOST_LIGHTS


def prepare(
    device: Device,
    scene: Scene,
    settings: Settings,
    threads: int | None,
    watch: Stopwatch,
) -> Problem:
    """Trace the camera's rays, and set up the sampling of the points that they hit.

    Parameters
    ----------
    threads : int, optional
        Of the host, for tracing; all cores by default.
    watch : Stopwatch
        Gets the seconds of stages "scene", "points", "shafts" and "slices".
    """
    integrand = settings.integrand
    if settings.sampling.visibility == "lines" and not (
        integrand.promises("sliced") or shafts_pay(scene)
    ):
        raise ValueError(
            f"{scene.name}: visibility 'lines' is for at most {MOST_LIGHTS} lights, there are "
            f"{len(scene.lights)}; take 'auto'"
        )
    with watch("scene"):
        tracer = Tracer(scene, threads)
    with watch("points"):
        points = find_points(
            device,
            scene,
            tracer,
            *settings.size,
            settings.sampling.supersample,
            integrand.emitters_active,
        )
        points = _without_dark(scene, settings, points)
    occluders, lines = None, False
    looked_for = settings.sampling.visibility != "embree" and shafts_pay(scene)
    if integrand.promises("to_lights") and looked_for and points.active:
        with watch("shafts"):
            occluders, lines = _occluders(device, scene, settings, points)
    slices, choice = None, None
    if integrand.promises("sliced") and points.active:
        with watch("slices"):
            slices, choice = _slices(device, scene, settings, points)
    source = sample_source(
        device,
        scene,
        tracer,
        points,
        integrand,
        settings.sampling.sampler,
        settings.seed,
        SAMPLES_A_PASS,
        occluders,
        lines=lines,
        slices=slices,
        shadows_tested=settings.sampling.visibility != "embree",
    )
    narrowest = 1.0
    if integrand.defines(scene).get("LIGHT_COUNT"):
        narrowest = narrowest_strip(scene)
    return Problem(
        device,
        points,
        source,
        scene.world_bounds,
        integrand.inputs,
        integrand.demodulated,
        narrowest=narrowest,
        slices=choice,
    )


def _occluders(
    device: Device, scene: Scene, settings: Settings, points: ShadingPoints
) -> tuple[Occluders, bool]:
    """What stands between the points and the lights, and whether to sample along lines."""
    integrand, visibility = settings.integrand, settings.sampling.visibility
    if integrand.promises("along_lines") and visibility in ("auto", "lines"):
        occluders = Occluders(device, scene, points, integrand, most_on_lines(device))
        if visibility == "lines" or lines_pay(occluders.unknown, points.active):
            return occluders, True
    return Occluders(device, scene, points, integrand, MOST_OCCLUDERS), False


def _slices(
    device: Device, scene: Scene, settings: Settings, points: ShadingPoints
) -> tuple[Slices | None, SliceChoice | None]:
    """Boxes to find slices in, if these are to be taken; and of "auto", how many, if it looked.

    A network that is asked for gets rays: of slices it takes off no more than a few more of them.
    """
    sampling, spp = settings.sampling, settings.spp
    if sampling.visibility == "lines":
        return Slices(device, scene), None
    by_network = settings.method == "ncv" or settings.training.network is not None
    if sampling.visibility != "auto" or by_network:
        return None, None
    if not boxes_pay(len(scene.triangles), points.active, spp):
        return None, None
    slices = Slices(device, scene)
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
