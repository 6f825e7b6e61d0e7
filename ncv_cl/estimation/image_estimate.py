"""The estimates of one image between passes: of all points, and again of some."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..host.clock import Stopwatch
from ..learning.density import Density
from ..learning.triangulate import TriangleWarp
from ..network.fold import FoldedNetwork
from ..opencl.device import Device
from ..opencl.memory import HostArray
from ..points.sampler import Stream
from ..sampling.accumulate import Accumulator, Estimate
from ..sampling.problem import Problem
from ..sampling.warp import TableWarp, Warp
from ..settings.filters import error_factor
from ..settings.settings import Settings
from .allocate import Allocation
from .calibrate import calibrate, halves, local_mean, points_done_twice, steadied
from .passes import Edges, Passes, Target

# Streams of f and of f - g, each with that of a second estimate.
PLAIN = (Stream.PLAIN, Stream.PLAIN_AGAIN)
RESIDUAL = (Stream.RESIDUAL, Stream.RESIDUAL_AGAIN)


class ImageEstimate:
    """Estimators of f and, with a control variate, of f - g, and the passes that fill them.

    Parameters
    ----------
    problem, settings
    allocation : Allocation
        Samples of every point.
    edges : sequence of int
        As `Passes` takes them.
    folded : FoldedNetwork, optional
        The control variate.
    density : Density, optional
        Where its residual is large.
    watch : Stopwatch
    streams : (Stream, Stream), optional
        Of the samples, and of those of a second estimate; by default f's, or the residual's.

    Attributes
    ----------
    passes : Passes
    done : int
        Passes done.
    twice : ndarray
        uint32, the points that are estimated twice.
    """

    def __init__(
        self,
        problem: Problem,
        settings: Settings,
        allocation: Allocation,
        edges: Edges,
        folded: FoldedNetwork | None,
        density: Density | None,
        watch: Stopwatch,
        streams: tuple[Stream, Stream] | None = None,
    ) -> None:
        device, points, channels = problem.device, problem.points, problem.source.channels
        self._problem, self._settings, self._allocation = problem, settings, allocation
        self._points = points
        self._magnitude = density.magnitude if density is not None else None
        elsewhere = problem.carrier is not None
        self._first = Accumulator(device, points, channels, folded, on_host=elsewhere)
        self._second: Accumulator | None = None
        by_default = PLAIN if folded is None else RESIDUAL
        once, again = streams or by_default
        targets = [Target(self._first, allocation, once)]
        self.twice = np.empty(0, np.uint32)
        # The variance of independent samples follows from the samples; stratified ones need points that
        # are estimated twice.
        if points.active and settings.sampling.sampler != "independent":
            self.twice = points_done_twice(points.active, settings.seed, allocation)
            self._second = Accumulator(device, points, channels, folded, self.twice, elsewhere)
            restricted = allocation.restricted(self.twice, points.active)
            targets.append(Target(self._second, restricted, again))
        warp = None
        if density is not None and folded is not None:
            warp = warp_of(device, settings.residual_density, folded, density)
        if problem.carrier is None:
            self.passes = Passes(problem, targets, edges, warp, watch, self._keep_parts)
        else:
            self.passes = problem.carrier.passes(self, problem, targets, edges, watch)
        # The means after the last two pass numbers that are powers of two.
        self.parts: list[np.ndarray] = []
        self.done = 0
        # Of a step of passes that is drawn point by point: which points are done, and up to which pass.
        self.ahead: np.ndarray | None = None
        self.ahead_to = 0
        self._warp = warp
        # Samples that follow a density lie where the residual is large, so their own variance predicts
        # errors well, and halves are not needed. Paths' noise is elsewhere as well.
        by_parts = warp is None or settings.integrand.nested
        self._looks_at_parts = self._second is not None and by_parts

    def results(self) -> list[Estimate]:
        """Estimates so far: of f and, with a control variate, of f - g.

        The image is made of the last one. Only in that one the points that are estimated twice have both
        estimates merged, and variances are calibrated.
        """
        return self._results(False)

    def _results(self, is_last: bool) -> list[Estimate]:
        if self._first.quantities == 1:
            return [self._final(is_last)]
        plain = self._first.result()
        final = self._final(is_last)
        return [replace(plain, samples=final.samples), final]

    def _final(self, is_last: bool = False) -> Estimate:
        """The estimate that the image is made of, with the calibrated variance of its mean.

        For the last time: what samples were added to is let go first.
        """
        quantity = self._first.quantities - 1
        first = self._first.result(quantity)
        if not self._points.active:
            return first
        if self._second is None:
            prior = self._prior(first)
            return replace(first, calibrated=steadied(first, prior) / np.maximum(first.samples, 1))
        # If the last kept mean is that of all samples, the one before it is the part.
        done = self.done if self.ahead is None else self.ahead_to
        parts = self.parts[:-1] if _is_power_of_two(done) else self.parts
        second = self._second.result(quantity, only_chosen=True)
        if parts:
            part = parts[-1][quantity]
            if is_last:
                del self._first, self._second
                self.parts = parts = []
            expected = halves(first.mean, part, *self._grid)
            repeated = expected[:, self.twice]
        else:
            prior = self._prior(first)
            expected, repeated = (
                steadied(each, prior) / np.maximum(each.samples, 1)
                for each in (first, self._second.result(quantity))
            )
            repeated = repeated[:, self.twice]
        return calibrate(first, second, self.twice, expected, repeated)

    def end(self) -> tuple[Estimate, Estimate | None]:
        """The final estimates of f and of f - g, if there is a control variate.

        Frees what only drawing needs, before the memory for the result is taken.
        """
        del self.passes
        self._warp = None
        for accumulator in self.accumulators:
            accumulator.network = None
        results = self._results(True)
        return results[0], results[1] if len(results) > 1 else None

    def _keep_parts(self, done: int) -> None:
        """Keep the means after the last two pass numbers that are powers of two."""
        self.done = done
        if self._looks_at_parts and _is_power_of_two(done):
            self.parts = [*self.parts[-1:], self._first.means()]

    @property
    def accumulators(self) -> list[Accumulator]:
        """Of all points, and of those that are estimated twice."""
        return [one for one in (self._first, self._second) if one is not None]

    def begin_step(self, first: int, last: int) -> list[int]:
        """Let passes from `first` to before `last` be drawn points by points, and given to `keep_tile`.

        Returns the numbers of passes after which the points' means are wanted.
        """
        powers = [1 << k for k in range(last.bit_length()) if first < 1 << k <= last]
        wanted = powers[-2:] if self._looks_at_parts else []
        if self.ahead is None:
            self.ahead, self.ahead_to = np.zeros(self._points.active, bool), last
            # Points that are not reached keep what they had.
            shape = (self._first.quantities, self._first.channels, self._points.active)
            before = self.parts[-1] if self.parts else np.zeros(shape)
            self.parts = [*self.parts, *(before.copy() for _ in wanted)][-2:]
        return wanted

    def keep_tile(
        self, points: range, states: list[tuple[np.ndarray, np.ndarray]], means: list[np.ndarray]
    ) -> None:
        """Take what has come of some points: what `Accumulator.take` takes, and the means wanted."""
        own = slice(points.start, points.stop)
        for accumulator, state in zip(self.accumulators, states, strict=True):
            accumulator.take(points, *state)
        for part, mean in zip(self.parts[len(self.parts) - len(means) :], means, strict=True):
            part[..., own] = mean
        if self.ahead is not None:
            self.ahead[own] = True

    def end_step(self) -> None:
        """All points have come."""
        self.done, self.ahead = self.ahead_to, None

    @property
    def _grid(self) -> tuple[np.ndarray, int, int]:
        """The points' sub-pixels, and columns and rows of these."""
        settings = self._settings
        return self._points.cell[: self._points.active], settings.columns, settings.rows

    def _prior(self, estimate: Estimate) -> np.ndarray:
        """Expected variance of a point's sample, up to a factor that all points share: (points,)."""
        variance = estimate.variance.sum(axis=0)
        prior = local_mean(variance, *self._grid)
        if self._magnitude is None:
            return prior
        predicted = self._magnitude**2
        return prior / max(prior.mean(), 1e-300) + predicted / max(predicted.mean(), 1e-300)

    def warm_up(self) -> None:
        """Compile the kernels of a pass, so that the first pass's seconds say what samples cost."""
        device, source = self._problem.device, self._problem.source
        rays = replace(source.rays)
        accumulator = Accumulator(device, self._points, source.channels, self._first.network)
        order = HostArray.of(device, self._allocation.chosen)
        grouped = self._allocation.grouped
        for first, last in ((0, min(grouped, self._allocation.members)), (grouped, grouped + 1)):
            shared = {"grouped": True} if last <= grouped else {}
            if first < last <= len(self._allocation.chosen):
                batch = source.draw(
                    range(first, last), range(1), Stream.WARM_UP, order, self._warp, **shared
                )
                accumulator.add(batch)
        device.queue.finish()
        source.rays = rays

    @property
    def follows_density(self) -> bool:
        """Whether samples follow a learned density, or else are uniform."""
        return self._warp is not None

    @property
    def samples(self) -> float:
        """Of all points together, so far."""
        return float(self._first.samples.sum())

    def finds_something(self) -> bool:
        """Whether any point's estimate is not zero."""
        return bool(self._first.means().any())

    def image_error(self) -> float:
        """The image's mean square error so far, from its variances; NaN: not known."""
        return error_of(self._final(), self._settings)

    def states(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """What `restore` takes."""
        return [one.state() for one in self.accumulators]

    def restore(
        self,
        states: list[tuple[np.ndarray, np.ndarray]],
        parts: list[np.ndarray],
        done: int,
        ahead: np.ndarray | None = None,
        ahead_to: int = 0,
    ) -> None:
        """Go on from another image_estimate's `states` and `parts` after `done` passes.

        Raises
        ------
        ValueError
            If these are not of the same points, channels and passes.
        """
        accumulators = self.accumulators
        shape = (self._first.quantities, self._first.channels, self._points.active)
        fits = len(states) == len(accumulators) and done <= self.passes.number
        if ahead is not None:
            fits = fits and len(ahead) == shape[2] and done < ahead_to <= self.passes.number
        if not fits or any(part.shape != shape for part in parts):
            raise ValueError("the checkpoint's arrays do not fit this render: it was tampered with")
        self.parts, self.done = parts, done
        self.ahead, self.ahead_to = ahead, ahead_to
        for accumulator, state in zip(accumulators, states, strict=True):
            accumulator.restore(*state)


def error_of(estimate: Estimate, settings: Settings) -> float:
    """The mean square error of an image of this estimate, from its variances; NaN: not known."""
    # Errors of a pixel's points are independent; one channel stands for all three.
    pixels = settings.size[0] * settings.size[1]
    variance = estimate.variance_of_mean.mean(axis=0).sum()
    sampling = settings.sampling
    if sampling.filter == "box":
        return float(variance) / (pixels * sampling.supersample**4)
    # The sum is over k * k points a pixel.
    factor = error_factor(sampling.filter, sampling.supersample) / sampling.supersample**2
    return float(variance) / pixels * factor


def warp_of(device: Device, kind: str, folded: FoldedNetwork, density: Density) -> Warp | None:
    """The `Warp` that draws samples by a density of this kind."""
    if kind == "subdivision":
        return TriangleWarp(device, folded, density)
    return TableWarp(density.table) if kind == "table" else None


def _is_power_of_two(number: int) -> bool:
    return number & (number - 1) == 0
