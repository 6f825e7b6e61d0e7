"""From a scene to what an image's samples are drawn with: traced points, and their source."""

from __future__ import annotations

from ..opencl.device import Device
from ..points.points import ShadingPoints, find_points
from ..points.trace import Tracer
from ..sampling.paths import sample_source
from ..sampling.samples import SampleSource
from ..scene.load import Scene
from ..settings.settings import RenderSettings, Stopwatch
from ..visibility.lines import MOST_ON_LINES
from ..visibility.shaft import MOST_OCCLUDERS, Occluders


def prepare(
    device: Device,
    scene: Scene,
    settings: RenderSettings,
    threads: int | None,
    samples_a_pass: int,
    watch: Stopwatch,
) -> tuple[ShadingPoints, SampleSource]:
    """Trace the camera's rays, and make ready to sample the points that they hit.

    Parameters
    ----------
    threads : int, optional
        Of the host, for tracing; all cores by default.
    samples_a_pass : int
        Samples a point that batches leave room for.
    watch : Stopwatch
        Gets the seconds of stages "scene", "points" and "shafts".
    """
    integrand = settings.integrand
    with watch("scene"):
        tracer = Tracer(scene, threads)
    with watch("points"):
        points = find_points(
            device, scene, tracer, *settings.size, settings.supersample, integrand.emitters_active
        )
        points = _without_dark(scene, settings, points)
    occluders = None
    lines = settings.visibility == "lines"
    if integrand.to_lights and settings.visibility != "embree" and points.active:
        with watch("shafts"):
            most = MOST_ON_LINES if lines else MOST_OCCLUDERS
            occluders = Occluders(device, scene, points, integrand, most)
    source = sample_source(
        device,
        scene,
        tracer,
        points,
        integrand,
        settings.sampler,
        settings.seed,
        samples_a_pass,
        occluders,
        lines=lines,
        shadows_tested=settings.visibility != "embree",
    )
    return points, source


def _without_dark(scene: Scene, settings: RenderSettings, points: ShadingPoints) -> ShadingPoints:
    """Points that cannot see a light are left out; all others keep their samples either way."""
    dark = settings.integrand.dark(scene, points)
    if dark is None:
        return points
    points = points.with_dark_last(dark)
    return points.without_last(int(dark.sum())) if settings.skip_dark else points
