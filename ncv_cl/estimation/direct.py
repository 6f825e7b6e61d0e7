"""Direct light that is estimated apart: its samples, which follow those of the rest in number."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from ..host.clock import Run
from ..points.sampler import Stream
from ..sampling.accumulate import Estimate
from ..sampling.problem import Problem
from ..settings.options import MOST_SAMPLES
from ..settings.settings import Settings
from . import tuning
from .allocate import Allocation
from .image_estimate import ImageEstimate, error_of
from .passes import Edges


def direct_samples(samples: int) -> int:
    """Samples a point of direct light beside `samples` a point of the rest, a power of two.

    Their number goes as the square root of the rest's. Along lines the mean square error falls like
    n^-2.8, that of paths like 1 / n: so direct light's stays the smaller, for ever less of the time.
    """
    return 1 << max(1, round(math.log2(tuning.DIRECT_SAMPLES * math.sqrt(samples))))


def direct_edges(first: int, samples: int, done: Edges | None = None) -> list[int]:
    """Where passes of direct light begin and end, in samples a point; each doubles what there is.

    Parameters
    ----------
    first, samples : int
        Samples a point of the rest in its first pass, and in all.
    done : sequence of int, optional
        The edges of the passes that a checkpoint holds.
    """
    # Two passes at least, because the difference between parts of the samples tells the error.
    begin = direct_samples(first)
    edges = [0, begin // 2] if done is None or len(done) < 2 else list(done)
    most = min(MOST_SAMPLES, max(direct_samples(samples), round(tuning.MOST_DIRECT * samples)))
    while edges[-1] < begin or 2 * edges[-1] <= most:
        edges.append(2 * edges[-1])
    return edges


class DirectEstimate:
    """The estimate of direct light, by plain Monte Carlo.

    Parameters
    ----------
    problem : Problem
        Has direct light `apart`.
    settings, run
    edges : sequence of int
        As `direct_edges` gives them.

    Attributes
    ----------
    image_estimate : ImageEstimate
        Its own, between passes.
    """

    def __init__(self, problem: Problem, settings: Settings, run: Run, edges: Edges) -> None:
        apart = problem.apart
        if apart is None:
            raise ValueError("the problem has no direct light apart")
        self._lit = np.zeros(problem.points.active, bool)
        self._lit[apart.lit] = True
        self._settings = settings
        own = replace(problem, source=apart.source, apart=None)
        allocation = Allocation.uniform(apart.lit, edges[-1])
        streams = (Stream.DIRECT, Stream.DIRECT_AGAIN)
        self.image_estimate = ImageEstimate(
            own, settings, allocation, edges, None, None, run.watch, streams
        )

    def follow(self, samples: int, rest: ImageEstimate | None = None) -> None:
        """Draw what there is to be beside `samples` a point of the rest.

        That is at least `direct_samples`. With `rest`, which has so many samples, it is drawn until the
        error is `DIRECT_ERROR` of the rest's, or there are `MOST_DIRECT` times as many samples. Errors
        are those of the whole image, so what a point is given hardly depends on its own samples.
        """
        estimate = self.image_estimate
        edges, passes = estimate.passes.edges, estimate.passes
        last = int(np.searchsorted(edges, direct_samples(samples)))
        if last > estimate.done:
            passes.run("direct", first=estimate.done, last=last)
        if rest is None or passes.stopped:
            return
        enough = tuning.DIRECT_ERROR * rest.image_error()
        most = tuning.MOST_DIRECT * samples
        while estimate.done < passes.number and edges[estimate.done + 1] <= most:
            # Errors that are not known, NaN, are not told apart.
            if not self.image_error() > enough:
                return
            passes.run("direct", first=estimate.done, last=estimate.done + 1)
            if passes.stopped:
                return

    @property
    def samples(self) -> float:
        """Of all points together, so far."""
        return self.image_estimate.samples

    def result(self) -> Estimate:
        """Means and the variances of these so far; both are zero where no light can be."""
        final = self.image_estimate.results()[-1]
        mean = np.where(self._lit, final.mean, 0.0)
        return replace(final, mean=mean, calibrated=np.where(self._lit, final.variance_of_mean, 0.0))

    def image_error(self) -> float:
        """As `ImageEstimate.image_error`."""
        return error_of(self.result(), self._settings)
