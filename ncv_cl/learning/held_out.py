"""Held-out samples, at points that no network is trained on: they measure what a network leaves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..network.fold import FoldedNetwork
from ..network.network import Network
from ..opencl.device import Device
from ..opencl.memory import HostArray, Window
from ..points.points import ShadingPoints
from ..sampling.accumulate import Accumulator
from ..sampling.samples import NO_RAY, SEEN
from ..visibility.room import Batch


class HeldOut:
    """Keeps samples of some points, as they are drawn, and measures networks on them.

    Parameters
    ----------
    device
    points : ShadingPoints
        Of the image.
    chosen : ndarray
        uint32, those of them that are held out.
    channels : int
        Of the integrand.
    factor : HostArray, optional
        float32 (channels, points.active), what a demodulated network's output is multiplied by.
    """

    def __init__(
        self,
        device: Device,
        points: ShadingPoints,
        chosen: np.ndarray,
        channels: int,
        factor: HostArray | None = None,
    ) -> None:
        self.device = device
        self.channels = channels
        self._points = _only(points, chosen)
        self._order = HostArray.of(device, np.arange(len(chosen), dtype=np.uint32))
        self._factor = None if factor is None else HostArray.of(device, factor.read()[:, chosen])
        self._batches: list[tuple[Batch, int]] = []

    def store(self, batch: Batch, first_sample: int) -> None:
        """Keep a copy of a batch: samples number `first_sample` and on of the held-out points."""
        device, size = self.device, len(batch.points) * batch.stride
        slot, visible = batch.slot.read(size), batch.visible.read(min(size, *batch.visible.shape))
        answer = visible[np.minimum(slot, len(visible) - 1)] != 0
        seen = (slot == SEEN) | ((slot != NO_RAY) & answer)
        # A plane of exactly these samples a channel, whatever the batch has room for.
        value = batch.value.read(window=Window(0, size, range(self.channels), range(size))).ravel()
        slots = np.where(seen, np.uint32(SEEN), np.uint32(NO_RAY))
        kept = replace(
            batch,
            order=self._order,
            u=HostArray.of(device, batch.u.read(size)),
            v=HostArray.of(device, batch.v.read(size)),
            value=HostArray.of(device, value),
            slot=HostArray.of(device, slots),
            visible=HostArray.of(device, np.zeros(1, np.uint8)),
        )
        self._batches.append((kept, first_sample))

    def variances(self, network: Network) -> tuple[float, float]:
        """Variance of f - g, g being `network`, and of f: of a sample, mean over channels and points."""
        folded = FoldedNetwork(self.device, network, self._points, self._factor)
        accumulator = Accumulator(self.device, self._points, self.channels, folded)
        for batch, first_sample in self._batches:
            accumulator.add(batch, first_sample)
        accumulator.finish_pass(max(first + batch.samples for batch, first in self._batches))
        return float(accumulator.result(1).variance.mean()), float(accumulator.result(0).variance.mean())


def _only(points: ShadingPoints, chosen: np.ndarray) -> ShadingPoints:
    """Points of which there are only the `chosen` ones, all active."""
    cell, light = points.cell[chosen], points.light[chosen]
    return ShadingPoints(points.taken(chosen), cell, light, len(chosen), 0, origin=points.origin)
