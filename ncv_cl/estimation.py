"""The estimates of one image under way: of all points, and once more of some, for the variance."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .allocate import Allocation
from .calibrate import calibrate, points_done_twice
from .density import Density
from .device import Device
from .estimate import Estimate, Estimator
from .network import FoldedNetwork
from .passes import Passes, Target
from .sampler import Stream
from .samples import SampleSource
from .settings import RenderSettings, Stopwatch


class Estimation:
    """Estimators of f and, with a control variate, of f - g, and the passes that fill them.

    Parameters
    ----------
    device, source, settings
    allocation : Allocation
        Samples of every point.
    edges : sequence of int
        As `Passes` takes them.
    folded : FoldedNetwork, optional
        The control variate.
    density : Density, optional
        Where its residual is.
    watch : Stopwatch

    Attributes
    ----------
    passes : Passes
    twice : ndarray
        uint32, the points that are estimated twice.
    """

    def __init__(
        self,
        device: Device,
        source: SampleSource,
        settings: RenderSettings,
        allocation: Allocation,
        edges: Sequence[int],
        folded: FoldedNetwork | None,
        density: Density | None,
        watch: Stopwatch,
    ) -> None:
        points, channels = source.points, settings.integrand.channels
        self._settings = settings
        self._prior = density.magnitude**2 if density is not None else None
        self._first = Estimator(device, points, channels, folded)
        self._second: Estimator | None = None
        targets = [Target(self._first, allocation, Stream.RESIDUAL)]
        self.twice = np.empty(0, np.uint32)
        # Independent samples tell their variance themselves; others need points that are done twice.
        if points.active and settings.sampler != "independent":
            self.twice = points_done_twice(points.active, settings.seed)
            self._second = Estimator(device, points, channels, folded, self.twice)
            restricted = allocation.restricted(self.twice, points.active)
            targets.append(Target(self._second, restricted, Stream.CALIBRATION))
        table = density.table if density is not None and settings.uses_density else None
        self.passes = Passes(device, source, targets, edges, table, watch)

    def results(self) -> list[Estimate]:
        """Estimates so far: of f and, with a control variate, of f - g."""
        quantities = range(self._first.quantities)
        if self._second is None:
            return [self._first.result(quantity) for quantity in quantities]
        return [
            calibrate(
                self._first.result(quantity), self._second.result(quantity), self.twice, self._prior
            )
            for quantity in quantities
        ]

    def first_estimate(self) -> Estimate:
        """Of f, without what is done twice."""
        return self._first.result()

    def differences(self) -> np.ndarray | None:
        """Between the estimates of f of the points done twice, (channels, points), if there are any."""
        if self._second is None:
            return None
        return (self._first.result().mean - self._second.result().mean)[:, self.twice]

    def image_error(self) -> float:
        """The mean square error of the image's pixels so far, as its variances say."""
        variance = self.results()[-1].variance_of_mean
        settings = self._settings
        # Errors of a pixel's points are independent; one channel stands for all three.
        pixels = settings.size[0] * settings.size[1]
        return float(variance.mean(axis=0).sum()) / (pixels * settings.supersample**4)

    def states(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """What `restore` takes."""
        return [one.state() for one in (self._first, self._second) if one is not None]

    def restore(self, states: list[tuple[np.ndarray, np.ndarray]]) -> None:
        """Go on from another estimation's `states`."""
        estimators = [one for one in (self._first, self._second) if one is not None]
        for estimator, state in zip(estimators, states, strict=True):
            estimator.restore(*state)
