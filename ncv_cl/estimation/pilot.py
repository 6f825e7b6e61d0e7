"""What is known before the image's samples: a pilot's variances, and the values to be expected."""

from __future__ import annotations

import numpy as np

from ..host.clock import FIRST_SHARE, Run
from ..points.sampler import Stream
from ..sampling.accumulate import Accumulator, Estimate
from ..sampling.problem import Problem
from ..settings.settings import Settings
from . import tuning
from .allocate import Allocation, allocate
from .calibrate import local_mean
from .control_variate import ControlVariate
from .direct import DirectEstimate
from .passes import Edges, Passes, Target, short_pass_edges, shortest_pass

# Errors of pixels are relative to their values plus this part of the image's mean, a convention that
# bench/bench_gi_equal.py measures by as well: without it those of black pixels would be all that counts.
DARK_SHARE = 0.01


def pilot_samples(spp: int) -> int:
    """Samples a point of the pilot of `spp` in all."""
    return max(1, min(tuning.PILOT_SAMPLES, int(spp * tuning.PILOT_SHARE)))


def draw_pilot(problem: Problem, settings: Settings, run: Run) -> Estimate:
    """Estimate f from a stream of samples of its own; a short time limit may end it early."""
    points, samples = problem.points, pilot_samples(settings.spp)
    accumulator = Accumulator(problem.device, points, problem.source.channels)
    everything = Allocation.uniform(np.arange(points.active, dtype=np.uint32), samples)
    targets = [Target(accumulator, everything, Stream.PILOT)]
    edges: Edges = [0, samples]
    if run.clock.limit is not None:
        edges = short_pass_edges(samples, samples, shortest_pass(settings, points.active))
    passes = Passes(problem, targets, edges, None, run.watch)
    passes.run("pilot", enough=lambda done: run.clock.over(FIRST_SHARE))
    return accumulator.result()


def allocate_by_pilot(pilot: Estimate, spp: int) -> Allocation:
    """Allocate the rest of `spp` samples a point, by the standard deviations that the pilot saw."""
    samples = int(pilot.samples.max())
    # The pilot may have missed a point's variance, so no point gets much fewer samples than the average.
    fewest = 1 << (samples.bit_length() - 1)
    # One sample has no deviation: all points get the same.
    deviation = np.sqrt(np.nan_to_num(pilot.variance.sum(axis=0)))
    return Allocation.of_counts(allocate(deviation, max(1, spp - samples), fewest))


def expected(
    problem: Problem,
    settings: Settings,
    variate: ControlVariate,
    before: Estimate | None,
    direct: DirectEstimate | None,
) -> np.ndarray:
    """The value that each point's pixel is expected to have, mean over channels, float64 (points,).

    That is the control variate's integral; where its coefficient is zero, what the training samples near
    it saw; and direct light, if that is estimated apart.
    """
    points = problem.points
    cell = points.cell[: points.active]
    value = variate.integral.astype(np.float64)
    if variate.alpha is not None:
        used = variate.alpha > 0
        value = np.where(used, value / np.where(used, variate.alpha, 1.0), 0.0)
        if before is not None and not used.all():
            seen = np.where(before.samples > 0, before.mean, np.nan)
            near = [local_mean(row, cell, settings.columns, settings.rows) for row in seen]
            value = np.where(used, value, near)
    if direct is not None:
        value = value + direct.result().mean
    if problem.glow is not None:
        value = value + problem.glow
    # A pixel's value is the mean of its points'.
    side = settings.sampling.supersample
    row, column = cell // settings.columns, cell % settings.columns
    pixel = (row // side) * (settings.columns // side) + column // side
    sums = np.bincount(pixel, weights=value.mean(axis=0))
    return np.maximum(sums / side**2, 0.0)[pixel]


def scales(value: np.ndarray) -> np.ndarray:
    """What errors of pixels of such values are divided by to be relative, positive."""
    found = value + DARK_SHARE * value.mean()
    return found if found.any() else np.ones(len(value))
