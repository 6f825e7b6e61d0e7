"""The order of the stages, for images and functions of the user: plan, control variate, samples."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ..estimation.allocate import Allocation
from ..estimation.control_variate import ControlVariate, Trained, control_variate, idle
from ..estimation.direct import DirectEstimate, direct_edges
from ..estimation.draw import Drawn, allocation_of, begin, draw, finish, grouped_allocation
from ..estimation.passes import edges_of
from ..estimation.pilot import draw_pilot
from ..estimation.stopping import ErrorTarget
from ..host.clock import UNLIMITED, Run
from ..learning.learn import learn
from ..network.network import Network, NetworkDescription
from ..output.checkpoint import Checkpoint
from ..output.keep import Keep
from ..sampling.accumulate import Estimate
from ..sampling.guide import Guide
from ..sampling.problem import Problem
from ..settings.settings import Settings
from .memory import check_memory
from .plan import Plan, make_plan


@dataclass(frozen=True)
class Before:
    """The results of training, or of a pilot, before the passes.

    Attributes
    ----------
    trained : Trained, optional
        The network; None for plain Monte Carlo.
    estimate : Estimate, optional
        Of f, from the samples of training or of a pilot.
    about : dict
        How the network was trained, if it was.
    guide : Guide, optional
        Densities that guide bounces.
    """

    trained: Trained | None = None
    estimate: Estimate | None = None
    about: dict[str, object] | None = None
    guide: Guide | None = None


@dataclass(frozen=True)
class Outcome:
    """The result of the stages, for `resolve`.

    Attributes
    ----------
    plan : Plan
    drawn : Drawn
    before : Estimate, optional
        Of f, from the samples of training or of a pilot.
    network : Network, optional
        The network that was used, if any.
    integral : ndarray, optional
        float32 (channels, points), G of each active point.
    training, idle : dict
        Statistics: how the network was trained, and which parts of it the points do not need.
    """

    plan: Plan
    drawn: Drawn
    before: Estimate | None
    network: Network | None
    integral: np.ndarray | None
    training: dict[str, object]
    idle: dict[str, object]

    @property
    def by_count(self) -> bool:
        """Whether training samples are weighed by their number, as on the slides, not by error."""
        return not self.plan.settings.preset.density


def estimate_integrals(
    problem: Problem, settings: Settings, run: Run, keep: Keep, given: Trained | None = None
) -> Outcome:
    """Estimate the integrals of all points.

    Parameters
    ----------
    keep : Keep
        Which network and checkpoint files to write, and the checkpoint to resume.
    given : Trained, optional
        A network to use instead of training one.
    """
    resumed = keep.resumed
    if resumed is not None:
        plan = Plan(settings.planned(resumed.method), "as it was begun")
        kept = resumed.network
        check_memory(problem, plan.settings, None if kept is None else kept.description)
        before = _resumed(problem, plan.settings, resumed)
    else:
        wanted = given is not None or keep.network is not None
        plan = make_plan(problem, settings, wanted)
        check_memory(problem, plan.settings, _description(problem, plan.settings, given))
        before = _learned(problem, plan.settings, run, given)
    settings = plan.settings
    variate = None
    if before.trained is not None:
        # A resumed render must get the same control variate, whatever time is left.
        untimed = run if resumed is None else replace(run, clock=UNLIMITED)
        save = functools.partial(keep.save_network, guide=before.guide)
        variate = control_variate(problem, settings, untimed, before.trained, save)
    if variate is None:
        keep.note_no_network()
    if problem.carrier is not None:
        problem.carrier.take(settings, variate, before.guide)
    drawn = _drawn(problem, settings, run, keep, before, variate)
    return Outcome(
        plan=plan,
        drawn=drawn,
        before=before.estimate,
        network=variate.folded.network if variate else None,
        integral=variate.integral if variate else None,
        training=before.about or {},
        idle=idle(variate, problem.points.active) if variate else {},
    )


def _description(
    problem: Problem, settings: Settings, given: Trained | None
) -> NetworkDescription | None:
    """Of the network that is given or will be trained; None for plain Monte Carlo."""
    if settings.method == "mc":
        return None
    if given is not None:
        return given.network.description
    return settings.preset.description(settings.integrand, problem.inputs)


def _learned(problem: Problem, settings: Settings, run: Run, given: Trained | None) -> Before:
    """Train a network or draw a pilot, as the method needs."""
    if settings.method == "mc":
        if settings.allocation == "pilot" and problem.points.active:
            return Before(estimate=draw_pilot(problem, settings, run))
        return Before()
    if given is not None:
        given.network.check_fits(settings.integrand.channels, problem.inputs)
        if given.guide is not None and settings.guides:
            problem.paths.use_guide(given.guide)
        return Before(given, guide=given.guide)
    learned = learn(problem, settings, run)
    trained = None
    if learned.network is not None:
        trained = Trained(learned.network, samples=learned.samples)
    return Before(trained, learned.estimate, learned.statistics, learned.guide)


def _resumed(problem: Problem, settings: Settings, resumed: Checkpoint) -> Before:
    """The same from a checkpoint."""
    resumed.check_arrays(settings.integrand.channels, problem.points.active, settings.needs_magnitude)
    if resumed.guide is not None:
        problem.paths.use_guide(resumed.guide)
    trained = None
    if resumed.network is not None:
        trained = Trained(resumed.network, resumed.density_network, resumed.alpha)
    return Before(trained, resumed.before, guide=resumed.guide)


def _direct(
    problem: Problem, settings: Settings, run: Run, resumed: Checkpoint | None
) -> DirectEstimate:
    """Direct light apart, before its first sample or with those of a checkpoint."""
    first = _first_samples(problem, settings)
    found = resumed.direct if resumed is not None else None
    edges = direct_edges(first, settings.spp, None if found is None else found.edges)
    direct = DirectEstimate(problem, settings, run, edges)
    if found is not None:
        found.give_back(direct.image_estimate)
    return direct


def _first_samples(problem: Problem, settings: Settings) -> int:
    """Samples a point of the first pass."""
    return int(edges_of(settings, problem.points.active)[1])


def _drawn(
    problem: Problem,
    settings: Settings,
    run: Run,
    keep: Keep,
    before: Before,
    variate: ControlVariate | None,
) -> Drawn:
    """Draw the passes, from where the checkpoint ended if there is one."""
    resumed, direct = keep.resumed, None
    if problem.apart is not None:
        direct = _direct(problem, settings, run, resumed)
        if problem.carrier is not None:
            problem.carrier.save = _before_image(problem, settings, run, keep, before, variate, direct)
        direct.follow(_first_samples(problem, settings))
    if resumed is not None and resumed.counts is not None:
        allocation = Allocation.of_counts(resumed.counts)
    else:
        allocation = allocation_of(problem, settings, variate, before.estimate, direct)
    done = None if resumed is None else resumed.image.edges
    image_estimate = begin(problem, settings, run, variate, allocation, done)
    if resumed is not None:
        resumed.image.give_back(image_estimate)
    density = variate.density if variate and image_estimate.follows_density else None
    share = 1.0 if density is None else density.uniform_share
    target = ErrorTarget(settings.stopping.target_mse, problem.narrowest, share)

    def after_pass() -> None:
        with run.watch("checkpoint"):
            kept = allocation if settings.allocation == "relative" else None
            keep.write(image_estimate, before.estimate, variate, before.guide, direct, kept)

    if problem.carrier is not None:
        problem.carrier.save = after_pass
    ended_by = draw(problem, settings, run, image_estimate, target, after_pass, direct)
    return finish(image_estimate, allocation, ended_by, direct)


def _before_image(
    problem: Problem,
    settings: Settings,
    run: Run,
    keep: Keep,
    before: Before,
    variate: ControlVariate | None,
    direct: DirectEstimate,
) -> Callable[[], None]:
    """What writes a checkpoint while direct light gets its first samples, and nothing else has any."""
    resumed = keep.resumed

    def save() -> None:
        # Only which points are done twice counts, and that follows from the groups.
        allocation = grouped_allocation(problem, settings, variate is not None, settings.spp)
        if settings.allocation == "relative":
            allocation = Allocation.of_counts(np.full(problem.points.active, settings.spp))
        done = None if resumed is None else resumed.image.edges
        image_estimate = begin(problem, settings, run, variate, allocation, done)
        if resumed is not None:
            resumed.image.give_back(image_estimate)
        keep.write(image_estimate, before.estimate, variate, before.guide, direct)

    return save
