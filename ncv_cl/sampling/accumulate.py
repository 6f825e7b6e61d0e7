"""Running estimates of every point's integral: Monte Carlo, and the residual of a control variate."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..network.fold import FoldedNetwork
from ..opencl.device import GROUP_SIZE, Device
from ..opencl.layout import Record
from ..opencl.memory import HostArray
from ..opencl.program import build
from ..points.points import ShadingPoints
from .samples import Batch, ray_defines

# Of every point and channel: the mean so far, what rounding took from it, and the sum of squared
# deviations.
STATE = Record("STATE", {"mean": 1, "low": 1, "deviations": 1})


@dataclass(frozen=True)
class Estimate:
    """Means and variances of one quantity, f or f - g, at every point.

    Attributes
    ----------
    mean, variance : ndarray
        float64 (channels, points): the mean, and the variance of a single sample (unbiased; NaN where
        it is not known, for want of two samples).
    samples : ndarray
        float64 (points,), samples of each point.
    calibrated : ndarray, optional
        float64 (channels, points), the variance of `mean` where it is known better than from independent
        samples (`calibrate`).
    """

    mean: np.ndarray
    variance: np.ndarray
    samples: np.ndarray
    calibrated: np.ndarray | None = None

    @property
    def variance_of_mean(self) -> np.ndarray:
        """Variance of `mean`; where not calibrated, as if samples were independent (for Sobol a bound).

        NaN where it is not known.
        """
        if self.calibrated is not None:
            return self.calibrated
        return self.variance / np.maximum(self.samples, 1)

    @property
    def known(self) -> np.ndarray:
        """Where a point has the two samples that a variance needs, bool (points,)."""
        return self.samples > 1


class Accumulator:
    """Accumulates f, and f − g where a network is given, batch after batch.

    Parameters
    ----------
    device, points, channels
    network : FoldedNetwork, optional
        The control variate.
    chosen : ndarray, optional
        uint32, the points that will be given samples; all active ones by default.
    """

    def __init__(
        self,
        device: Device,
        points: ShadingPoints,
        channels: int,
        network: FoldedNetwork | None = None,
        chosen: np.ndarray | None = None,
    ) -> None:
        self._chosen = slice(None) if chosen is None else chosen
        self.points = points
        self.channels = channels
        self.network = network
        self.samples = np.zeros(points.active)
        self._samples_of_all = 0
        self._lanes = device.lanes
        self._group_points = max(1, GROUP_SIZE // device.lanes)
        defines = {
            "CHANNELS": channels,
            "WITH_NETWORK": int(network is not None),
            **STATE.defines(),
            "GROUP_POINTS": self._group_points,
            **ray_defines(),
        }
        files: tuple[str, ...] = ("common", "batch", "accumulate")
        if network is not None:
            files = ("common", "batch", "mlp", "accumulate")
            defines |= network.network.description.defines()
        self._device, self._files, self._defines = device, files, defines
        self.quantities = 1 + (network is not None)
        rows = self.quantities * channels * STATE.size
        self._state = HostArray(device, (rows, points.active), np.float32)
        self._state.fill(0.0)

    def add(self, batch: Batch, previous: int | None = None) -> None:
        """Add a batch, whose points must all have been given `previous` samples before.

        By default the number that the passes finished so far have given every point.
        """
        previous = self._samples_of_all if previous is None else previous
        weighted = batch.weight is not None
        program = build(self._device, self._files, {**self._defines, "WEIGHTED": int(weighted)})
        inputs = {"weight": batch.weight} if weighted else {}
        if self.network is not None:
            inputs |= {"u": batch.u, "v": batch.v, **self.network.arrays}
        program.kernel("accumulate")(
            len(batch.points) * self._lanes,
            first_point=batch.points.start,
            point_count=len(batch.points),
            total_points=self.points.active,
            sample_count=batch.samples,
            stride=batch.stride,
            entries=batch.entries,
            previous_count=float(previous),
            order=batch.order,
            value=batch.value,
            slot=batch.slot,
            visible=batch.visible,
            **inputs,
            state=self._state,
            group=self._group_points * self._lanes,
        )

    def finish_pass(self, samples: int | np.ndarray, chosen: np.ndarray | None = None) -> None:
        """Say that each of the points has been given `samples` more.

        Without `chosen` (indices, with one number each in `samples`) all have been given the same.
        """
        if chosen is None:
            self.samples[self._chosen] += samples
            self._samples_of_all += int(samples)
        else:
            self.samples[chosen] += samples

    def state(self) -> tuple[np.ndarray, np.ndarray]:
        """What `restore` takes: sums (rows, chosen points) and numbers of samples (chosen points,)."""
        return self._state.read()[:, self._chosen], self.samples[self._chosen]

    def restore(self, state: np.ndarray, samples: np.ndarray) -> None:
        """Go on from another accumulator's `state`; ValueError if it is not of as many points."""
        whole = self._state.read()
        expected = whole[:, self._chosen].shape
        if state.shape != expected or samples.shape != expected[1:]:
            raise ValueError(
                f"the checkpoint's state must be {expected}, is {state.shape}: it was tampered with"
            )
        whole[:, self._chosen] = state
        with self._state.mapped(write=True) as view:
            view[...] = whole
        self.samples[self._chosen] = samples

    def means(self) -> np.ndarray:
        """Means so far, float64 (quantities, channels, points)."""
        state = self._state.read().astype(np.float64)
        state = state.reshape(self.quantities, self.channels, STATE.size, -1)
        return (state[:, :, STATE["mean"]] + state[:, :, STATE["low"]])[:, :, 0]

    def result(self, quantity: int = 0) -> Estimate:
        """Means and variances of f (`quantity` 0) or of f − g (1)."""
        rows = self.channels * STATE.size
        with self._state.mapped() as view:
            state = view[quantity * rows : (quantity + 1) * rows]
            state = state.reshape(self.channels, STATE.size, -1)
            high, low, deviations = (state[:, STATE[n]][:, 0] for n in ("mean", "low", "deviations"))
            mean = high.astype(np.float64) + low
            spread = deviations / np.maximum(self.samples - 1, 1)
        variance = np.where(self.samples > 1, spread, np.nan)
        return Estimate(mean, variance, self.samples.copy())
