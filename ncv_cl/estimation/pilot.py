"""A pilot for plain Monte Carlo: its samples tell how to allocate the others."""

from __future__ import annotations

import numpy as np

from ..host.clock import FIRST_SHARE, Run
from ..points.sampler import Stream
from ..sampling.accumulate import Accumulator, Estimate
from ..sampling.problem import Problem
from ..settings.settings import Settings
from . import tuning
from .allocate import Allocation, allocate
from .passes import Passes, Target, short_pass_edges, shortest_pass


def pilot_samples(spp: int) -> int:
    """Samples a point of the pilot of `spp` in all."""
    return max(1, min(tuning.PILOT_SAMPLES, int(spp * tuning.PILOT_SHARE)))


def draw_pilot(problem: Problem, settings: Settings, run: Run) -> Estimate:
    """Estimate f from a stream of samples of its own; a short time limit may end it early."""
    points, samples = problem.points, pilot_samples(settings.spp)
    accumulator = Accumulator(problem.device, points, problem.source.channels)
    everything = Allocation.uniform(np.arange(points.active, dtype=np.uint32), samples)
    targets = [Target(accumulator, everything, Stream.PILOT)]
    edges = [0, samples]
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
