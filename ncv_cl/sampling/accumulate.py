"""Running estimates of every point's integral: Monte Carlo, and the residual of a control variate."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from ..network.fold import FoldedNetwork
from ..opencl.device import GROUP_SIZE, Device
from ..opencl.kernel import Arguments
from ..opencl.layout import Record
from ..opencl.memory import HostArray
from ..opencl.program import build
from ..points.points import ShadingPoints
from ..visibility.room import Batch
from .samples import ray_defines

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

    def at(self, points: np.ndarray) -> Estimate:
        """The same of some points only; not calibrated."""
        return Estimate(self.mean[:, points], self.variance[:, points], self.samples[points])

    def among(self, points: np.ndarray, total: int) -> Estimate:
        """The same among so many points, of which the others have no samples."""
        shape = (len(self.mean), total)
        found = Estimate(np.zeros(shape), np.full(shape, np.nan), np.zeros(total))
        found.mean[:, points], found.variance[:, points] = self.mean, self.variance
        found.samples[points] = self.samples
        return found

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


class HostState:
    """An accumulator's state that no kernel adds to: what workers return is put together here.

    Parameters
    ----------
    shape : (int, int)
        Rows and points.
    """

    def __init__(self, shape: tuple[int, int]) -> None:
        self.values = np.zeros(shape, np.float32)

    @contextmanager
    def mapped(self, write: bool = False) -> Iterator[np.ndarray]:
        """As `HostArray.mapped`."""
        yield self.values

    def read(self) -> np.ndarray:
        """A copy."""
        return self.values.copy()


class Accumulator:
    """Accumulates f, and f − g where a network is given, batch after batch.

    Parameters
    ----------
    device, points, channels
    network : FoldedNetwork, optional
        The control variate.
    chosen : ndarray, optional
        uint32, the points that will be given samples; all active ones by default.
    on_host : bool
        Whether samples are drawn elsewhere, and `take` gets what comes of them.
    """

    def __init__(
        self,
        device: Device,
        points: ShadingPoints,
        channels: int,
        network: FoldedNetwork | None = None,
        chosen: np.ndarray | None = None,
        on_host: bool = False,
    ) -> None:
        self._chosen: slice | np.ndarray = slice(None) if chosen is None else chosen
        self.points = points
        self.channels = channels
        self.network = network
        # What is put together here of few points has columns for these alone.
        self._few = chosen if on_host else None
        self._stored = self._chosen if self._few is None else slice(None)
        columns = points.active if self._few is None else len(self._few)
        self.samples = np.zeros(columns)
        self._samples_of_all = 0
        self._lanes = device.lanes
        self._group_points = max(1, GROUP_SIZE // device.lanes)
        defines: dict[str, int | str] = {
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
        self._state: HostArray | HostState
        if on_host:
            self._state = HostState((rows, columns))
            return
        self._state = HostArray(device, (rows, points.active), np.float32)
        self._state.fill(0.0)

    def add(self, batch: Batch, previous: int | None = None) -> None:
        """Add a batch, whose points must all have been given `previous` samples before.

        By default the number that the passes finished so far have given every point.
        """
        previous = self._samples_of_all if previous is None else previous
        weighted = batch.weight is not None
        own: dict[str, int | str] = {"WEIGHTED": int(weighted), "ENTRIES": f"{batch.entries}u"}
        program = build(self._device, self._files, {**self._defines, **own})
        inputs: Arguments = {"weight": batch.weight} if weighted else {}
        if self.network is not None:
            inputs |= {"u": batch.u, "v": batch.v, **self.network.arrays}
        program.kernel("accumulate")(
            len(batch.points) * self._lanes,
            first_point=batch.points.start,
            point_count=len(batch.points),
            total_points=self.points.active,
            sample_count=batch.samples,
            stride=batch.stride,
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
        return self._state.read()[:, self._stored], self.samples[self._stored]

    def restore(self, state: np.ndarray, samples: np.ndarray) -> None:
        """Go on from another accumulator's `state`; ValueError if it is not of as many points."""
        whole = self._state.read()
        expected = whole[:, self._stored].shape
        if state.shape != expected or samples.shape != expected[1:]:
            raise ValueError(
                f"the checkpoint's state must be {expected}, is {state.shape}: it was tampered with"
            )
        whole[:, self._stored] = state
        with self._state.mapped(write=True) as view:
            view[...] = whole
        self.samples[self._stored] = samples

    def take(self, points: range, state: np.ndarray, samples: np.ndarray) -> None:
        """Put in another accumulator's `state`, of those of `points` that are chosen; on the host."""
        own = self._columns(points)
        self._values[:, own] = state
        self.samples[own] = samples

    def part(self, points: range) -> tuple[np.ndarray, np.ndarray]:
        """What `take` takes."""
        own = self._columns(points)
        return self._values[:, own].copy(), self.samples[own]

    @property
    def _values(self) -> np.ndarray:
        """The sums of an accumulator on the host, (rows, columns)."""
        if isinstance(self._state, HostArray):
            raise TypeError("this accumulator adds samples on the device")
        return self._state.values

    def _columns(self, points: range) -> slice:
        """Where those of `points` that are chosen are kept, on the host."""
        if self._few is None:
            return slice(points.start, points.stop)
        return slice(*np.searchsorted(self._few, (points.start, points.stop)))

    def means(self) -> np.ndarray:
        """Means so far, float64 (quantities, channels, points)."""
        state = self._state.read().astype(np.float64)
        state = state.reshape(self.quantities, self.channels, STATE.size, -1)
        return (state[:, :, STATE["mean"]] + state[:, :, STATE["low"]])[:, :, 0]

    def result(self, quantity: int = 0, only_chosen: bool = False) -> Estimate:
        """Means and variances of f (`quantity` 0) or of f − g (1), of all points or only the chosen."""
        if self._few is not None and not only_chosen:
            return self.result(quantity, True).among(self._few, self.points.active)
        chosen = self._stored if only_chosen else slice(None)
        samples = self.samples[chosen].copy()
        rows = self.channels * STATE.size
        with self._state.mapped() as view:
            state = view[quantity * rows : (quantity + 1) * rows]
            state = state.reshape(self.channels, STATE.size, -1)
            high, low, deviations = (
                state[:, STATE[n]][:, 0][:, chosen] for n in ("mean", "low", "deviations")
            )
            mean = high.astype(np.float64)
            mean += low
            variance = deviations / np.maximum(samples - 1, 1)
        variance[:, samples <= 1] = np.nan
        return Estimate(mean, variance, samples)
