"""Passes: each draws the same share of every point's allocated samples."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
from tqdm import tqdm

from ..host.clock import Stopwatch
from ..opencl.memory import HostArray
from ..points.sampler import Stream
from ..sampling.accumulate import Accumulator
from ..sampling.problem import Problem
from ..sampling.samples import SAMPLES_A_PASS
from ..sampling.warp import Warp
from ..settings.settings import Settings
from .allocate import Allocation

# Samples in all of a short pass: it takes a small part of a second, and still keeps a device busy.
SHORT_PASS, SHORT_NESTED_PASS = 1 << 17, 1 << 15
# Where passes begin and end, in samples a point on average.
Edges: TypeAlias = Sequence[int] | np.ndarray


class Target(NamedTuple):
    """An estimate, the samples it is to get, and the stream they come from."""

    accumulator: Accumulator
    allocation: Allocation
    stream: Stream


def pass_edges(samples: int, samples_a_pass: int) -> list[int]:
    """Where passes begin and end, in samples a point: all of the same length but the last.

    There are at least two passes if there are two samples a point, because the difference between parts
    of the samples tells the error.
    """
    edges = [*range(0, samples, samples_a_pass), samples]
    if len(edges) > 2 and edges[-1] - edges[-2] < samples_a_pass / 2:
        del edges[-2]
    return edges if len(edges) > 2 or samples == 1 else [0, samples // 2, samples]


def shortest_pass(settings: Settings, points: int) -> int:
    """Samples a point of the first passes of a render of `points` points that must end in time."""
    samples = SHORT_NESTED_PASS if settings.integrand.nested else SHORT_PASS
    return max(1, samples // max(points, 1))


def short_pass_edges(samples: int, samples_a_pass: int, shortest: int) -> np.ndarray:
    """As `pass_edges`, int64, for renders that must end in time: short passes at first.

    No pass is longer than a sixteenth of all before it, or than `shortest` if that is more. So the
    seconds of the pass before predict those of the next, and little of the time limit is left unused.
    """
    head = [0]
    while head[-1] < samples:
        length = max(shortest, head[-1] // 16)
        if length >= samples_a_pass:
            break
        head.append(min(head[-1] + length, samples))
    regular = np.arange(head[-1] + samples_a_pass, samples, samples_a_pass, dtype=np.int64)
    end = [samples] if head[-1] < samples else []
    return np.concatenate([head, regular, end]).astype(np.int64)


def edges_of(settings: Settings, points: int, done: Edges | None = None) -> Edges:
    """Where the passes of a render of `points` points begin and end.

    Parameters
    ----------
    done : sequence of int, optional
        The edges of the passes that a checkpoint holds.
    """
    if settings.stopping.time_limit is None:
        edges: Edges = pass_edges(settings.spp, SAMPLES_A_PASS)
    else:
        edges = short_pass_edges(settings.spp, SAMPLES_A_PASS, shortest_pass(settings, points))
    if done is None:
        return edges
    return [*done, *edges[int(np.searchsorted(edges, done[-1], side="right")) :]]


class Passes:
    """Draws the samples of several estimates side by side.

    A pass takes the same share of every point's samples and is done for all points or not at all, so
    that after any pass there is an estimate of the whole image.

    Parameters
    ----------
    problem : Problem
    targets : sequence of Target
    edges : sequence of int
        Where the passes begin and end, in samples a point on average: 0, ..., all.
    density : Warp, optional
        As `SampleSource.draw` takes it.
    watch : Stopwatch
        Gets the seconds of stage "estimate"; where drawing runs ahead, all that the device takes.
    after_pass : callable
        Told after each pass how many are done.
    """

    def __init__(
        self,
        problem: Problem,
        targets: list[Target],
        edges: Edges,
        density: Warp | None,
        watch: Stopwatch,
        after_pass: Callable[[int], None] = lambda done: None,
    ) -> None:
        self._after_pass = after_pass
        self._problem, self._watch = problem, watch
        self._targets, self._density = targets, density
        self._orders = [HostArray.of(problem.device, target.allocation.chosen) for target in targets]
        self.edges = edges

    stopped = False
    """Whether the last `run` was asked to end in the middle of a pass."""

    @property
    def number(self) -> int:
        """How many passes there are."""
        return len(self.edges) - 1

    def length(self, number: int) -> int:
        """Samples a point of one pass."""
        return int(self.edges[number + 1] - self.edges[number])

    def run(
        self,
        label: str,
        progress: bool = False,
        enough: Callable[[int], bool] | None = None,
        first: int = 0,
        last: int | None = None,
    ) -> int:
        """Run passes from `first` to before `last`, or until `enough` of those done says so after one.

        Returns the number of passes done, those before `first` counted.
        """
        last = self.number if last is None else min(last, self.number)
        share = (self.edges[last] - self.edges[first]) / self.edges[-1]
        total = round(share * sum(target.allocation.samples for target in self._targets))
        # tqdm's disable=None draws on terminals only.
        disable = None if progress else True
        with tqdm(total=total, unit="sample", unit_scale=True, desc=label, disable=disable) as bar:
            for number in range(first, last):
                for target, order in zip(self._targets, self._orders, strict=True):
                    self._run_one(target, order, number, bar)
                if self._problem.source.runs_ahead:
                    with self._watch("estimate"):
                        self._problem.device.queue.finish()
                self._after_pass(number + 1)
                if enough is not None and enough(number + 1):
                    return number + 1
        return last

    def _run_one(self, target: Target, order: HostArray, number: int, bar: tqdm) -> None:
        accumulator, allocation, stream = target
        drawn = np.zeros(len(allocation.counts))
        source = self._problem.source
        most_points = self._density.most_points if self._density is not None else None
        parts = []
        for run in allocation.part(*(int(self.edges[k]) for k in (number, number + 1, -1))):
            drawn[run.points.start : run.points.stop] = len(run.samples)
            parts += source.parts(*run, most_points, allocation.grouped)
        batches = source.drawn(parts, stream, order, self._density, allocation.grouped)
        for (points, samples), batch in zip(parts, batches, strict=True):
            with self._watch("estimate"):
                accumulator.add(batch, samples.start)
                if not source.runs_ahead:
                    self._problem.device.queue.finish()
            bar.update(len(points) * len(samples))
        accumulator.finish_pass(drawn, allocation.chosen)
