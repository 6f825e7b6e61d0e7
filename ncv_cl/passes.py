"""Drawing what was allocated, pass after pass."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from tqdm import tqdm

from .allocate import Allocation
from .device import Device, HostArray
from .estimate import Estimator
from .sampler import Stream
from .samples import Batches
from .settings import Stopwatch
from .warp import Warp


class Target(NamedTuple):
    """An estimate, the samples it is to get, and the stream they come from."""

    estimator: Estimator
    allocation: Allocation
    stream: Stream


def pass_edges(samples: int, samples_a_pass: int, first_pass: int | None = None) -> list[int]:
    """Where passes begin and end, in samples a point: all of one length, but for the last.

    There are two at least, where there are samples for it: by how far they differ the error is known.

    Parameters
    ----------
    first_pass : int, optional
        Cuts so many off the first one, and leaves the others where they are.
    """
    edges = [*range(0, samples, samples_a_pass), samples]
    if len(edges) > 2 and edges[-1] - edges[-2] < samples_a_pass / 2:
        del edges[-2]
    if first_pass is not None and first_pass < edges[1]:
        edges.insert(1, first_pass)
    return edges if len(edges) > 2 or samples == 1 else [0, samples // 2, samples]


class Passes:
    """Draws the samples of several estimates side by side.

    A pass takes the same share of every point's samples and is done for all points or not at all, so
    that after any pass there is an estimate of the whole image.

    Parameters
    ----------
    device, source
    targets : sequence of Target
    edges : sequence of int
        Where the passes begin and end, in samples a point on average: 0, ..., all.
    density : Warp, optional
        As `SampleSource.draw` takes it.
    watch : Stopwatch
        Gets the seconds of stage "estimate".
    after_pass : callable
        Told after each pass how many are done.
    """

    def __init__(
        self,
        device: Device,
        source: Batches,
        targets: list[Target],
        edges: Sequence[int],
        density: Warp | None,
        watch: Stopwatch,
        after_pass: Callable[[int], None] = lambda done: None,
    ) -> None:
        self._after_pass = after_pass
        self._device, self._source, self._watch = device, source, watch
        self._targets, self._density = targets, density
        self._orders = [HostArray.of(device, target.allocation.chosen) for target in targets]
        self._edges = edges

    @property
    def number(self) -> int:
        """How many passes there are."""
        return len(self._edges) - 1

    def run(
        self,
        label: str,
        progress: bool = False,
        enough: Callable[[], bool] | None = None,
        first: int = 0,
        last: int | None = None,
    ) -> int:
        """Run passes from `first` to before `last`, or until `enough` says so after one.

        Returns the number of passes done, those before `first` counted.
        """
        last = self.number if last is None else min(last, self.number)
        share = (self._edges[last] - self._edges[first]) / self._edges[-1]
        total = round(share * sum(target.allocation.samples for target in self._targets))
        # tqdm's disable=None draws on terminals only.
        disable = None if progress else True
        with tqdm(total=total, unit="sample", unit_scale=True, desc=label, disable=disable) as bar:
            for number in range(first, last):
                for target, order in zip(self._targets, self._orders, strict=True):
                    self._run_one(target, order, number, bar)
                self._after_pass(number + 1)
                if enough is not None and enough():
                    return number + 1
        return last

    def _run_one(self, target: Target, order: HostArray, number: int, bar: tqdm) -> None:
        estimator, allocation, stream = target
        drawn = np.zeros(len(allocation.counts))
        most_points = self._density.most_points if self._density is not None else None
        for run in allocation.part(self._edges[number], self._edges[number + 1], self._edges[-1]):
            drawn[run.points.start : run.points.stop] = len(run.samples)
            for points, samples in self._source.parts(*run, most_points):
                batch = self._source.draw(points, samples, stream, order, self._density)
                with self._watch("estimate"):
                    estimator.add(batch, samples.start)
                    self._device.queue.finish()
            bar.update(len(run.points) * len(run.samples))
        estimator.finish_pass(drawn, allocation.chosen)
