"""The passes of a render: allocate samples, draw them, and stop."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from ..host.clock import Run
from ..sampling.accumulate import Estimate
from ..sampling.problem import Problem
from ..settings.settings import BY_RESIDUAL, Settings
from .allocate import Allocation, allocate
from .control_variate import ControlVariate
from .direct import DirectEstimate
from .image_estimate import ImageEstimate
from .passes import edges_of
from .pilot import allocate_by_pilot, expected, scales
from .stopping import ErrorTarget, Stopping


@dataclass(frozen=True)
class Drawn:
    """The result of the passes.

    Attributes
    ----------
    plain : Estimate
        Of f.
    residual : Estimate, optional
        Of f - g.
    allocation : Allocation
    ended_by : {"samples", "target_mse", "time_limit", "request"}
    points_done_twice : int
    direct : Estimate, optional
        Of direct light, if that is estimated apart.
    """

    plain: Estimate
    residual: Estimate | None
    allocation: Allocation
    ended_by: str
    points_done_twice: int
    direct: Estimate | None = None


def allocation_of(
    problem: Problem,
    settings: Settings,
    variate: ControlVariate | None,
    before: Estimate | None,
    direct: DirectEstimate | None = None,
) -> Allocation:
    """How many samples each point gets.

    Parameters
    ----------
    before : Estimate, optional
        Of f, from the samples of training or of a pilot.
    direct : DirectEstimate, optional
        Of light that f leaves out.
    """
    density = None if variate is None else variate.density
    if variate is not None and density is not None and settings.allocation in BY_RESIDUAL:
        magnitude = density.magnitude
        if settings.allocation == "relative":
            magnitude = magnitude / scales(expected(problem, settings, variate, before, direct))
        return Allocation.of_counts(allocate(magnitude, settings.spp))
    if before is not None and settings.allocation == "pilot":
        return allocate_by_pilot(before, settings.spp)
    return grouped_allocation(problem, settings, variate is not None, settings.spp)


def grouped_allocation(
    problem: Problem, settings: Settings, has_network: bool, count: int
) -> Allocation:
    """The same number of samples for every point; those that share paths in groups."""
    density = settings.residual_density if has_network else "none"
    groups = problem.source.groups(density, settings.sampling.supersample**2)
    return Allocation.of_groups(groups, count)


def begin(
    problem: Problem,
    settings: Settings,
    run: Run,
    variate: ControlVariate | None,
    allocation: Allocation,
    done: list[int] | None = None,
) -> ImageEstimate:
    """Estimates of an image, before the first sample.

    Parameters
    ----------
    done : list of int, optional
        As `edges_of` takes it.
    """
    edges = edges_of(settings, problem.points.active, done)
    folded, density = (variate.folded, variate.density) if variate else (None, None)
    return ImageEstimate(problem, settings, allocation, edges, folded, density, run.watch)


def draw(
    problem: Problem,
    settings: Settings,
    run: Run,
    image_estimate: ImageEstimate,
    target: ErrorTarget,
    after_pass: Callable[[], None],
    direct: DirectEstimate | None = None,
) -> str:
    """Draw the remaining passes until a condition ends them; returns which one (`Drawn.ended_by`).

    Parameters
    ----------
    after_pass : callable
        Called before the first and after every pass.
    direct : DirectEstimate, optional
        What is drawn beside.
    """
    after_pass()
    if not problem.points.active:
        return "samples"
    if settings.stopping.time_limit is not None and problem.carrier is None:
        with run.watch("compile"):
            image_estimate.warm_up()
    stopping = Stopping(image_estimate, target, run, direct)

    def enough(done: int) -> bool:
        if direct is not None:
            # What is compared takes time, so that is done after ever more passes.
            compares = done & (done - 1) == 0 or done == image_estimate.passes.number
            direct.follow(int(image_estimate.passes.edges[done]), image_estimate if compares else None)
        after_pass()
        return stopping.enough(done)

    if image_estimate.done and run.clock.over():
        return "time_limit"
    image_estimate.passes.run("render", run.progress, enough, image_estimate.done)
    return "request" if image_estimate.passes.stopped else stopping.ended_by


def finish(
    image_estimate: ImageEstimate,
    allocation: Allocation,
    ended_by: str,
    direct: DirectEstimate | None = None,
) -> Drawn:
    """The final estimates; memory that only drawing needs is freed."""
    twice = len(image_estimate.twice)
    plain, residual = image_estimate.end()
    found = direct.result() if direct is not None else None
    return Drawn(plain, residual, allocation, ended_by, twice, found)
