"""An image's statistics and metadata: how it was made, and what the scene did not need."""

from __future__ import annotations

from typing import Any

from ..host.clock import Stopwatch
from ..output.image import Image
from ..output.report import about_direct, metadata, seconds_of, skips, statistics
from ..sampling.problem import Problem
from ..scene.load import Scene
from ..settings.settings import Settings
from .pipeline import Outcome


def counts(
    settings: Settings, problem: Problem, outcome: Outcome, watch: Stopwatch, total: float
) -> dict[str, Any]:
    """Statistics of estimates, of an image's points or of others; arguments as `describe` takes them."""
    drawn = outcome.drawn
    stats: dict[str, Any] = {"seconds": seconds_of(watch, problem.rays, total)}
    stats |= statistics(
        problem.points,
        problem.rays,
        problem.device,
        drawn.plain,
        outcome.before,
        drawn.residual,
        outcome.network,
        drawn.points_done_twice,
    )
    if outcome.training:
        stats["training"] = outcome.training
    if problem.apart is not None and drawn.direct is not None:
        stats["direct"] = about_direct(problem.apart, drawn.direct, settings)
    if settings.method == "auto":
        stats["auto"] = outcome.plan.as_dict()
    if problem.slices is not None:
        stats["slices"] = problem.slices.as_dict()
    if problem.carrier is not None:
        stats["machines"] = problem.carrier.statistics()
    return stats | {"ended_by": drawn.ended_by}


def describe(
    image: Image,
    scene: Scene,
    settings: Settings,
    problem: Problem,
    outcome: Outcome,
    watch: Stopwatch,
    total: float,
) -> None:
    """Fill `image.stats` and `image.metadata`.

    Parameters
    ----------
    settings : Settings
        Settings of the call, not those of the plan.
    total : float
        Seconds of the whole render.
    """
    points, rays, drawn = problem.points, problem.rays, outcome.drawn
    stats = counts(settings, problem, outcome, watch, total)
    stats["skipped"] = {
        **skips(points, rays, settings.integrand.inputs, problem.inputs),
        **outcome.idle,
        **drawn.allocation.converged(),
    }
    image.stats = stats
    sampled = (drawn.plain, outcome.before) if points.active else (None, None)
    # Of "auto", the options of what it has chosen.
    found = metadata(scene, outcome.plan.settings, problem.device, *sampled)
    image.metadata = found | {"method": settings.method}
    if "direct" in stats:
        image.metadata["direct_spp"] = stats["direct"]["samples_per_point"]
    if problem.carrier is not None:
        image.metadata["task_devices"] = problem.carrier.metadata()
