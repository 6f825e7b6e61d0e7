"""Memory for a batch of samples and its shadow rays, of which there may be two: one is computed on the
device while the host answers the rays of the other."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pyopencl as cl

from ..opencl.device import Device
from ..opencl.memory import HostArray, Window
from .rays import RayCount, ShadowRays

# Samples of a batch for each of a GPU's compute units: eight samples share a path, and four times as
# many paths as are resident at once keep a unit busy. By docs/gpu_model.md smaller batches of paths take
# the time of their launches above all: python bench/gpu_model.py.
SAMPLES_A_UNIT = 1 << 16
# Blocks of VEC rays of one point that one of a GPU's lanes draws and tests, `BLOCKS_A_ITEM` of a CPU's:
# with more, what is kept of each takes the registers of a quarter of the warps, or of lines, whose free
# parts lie in memory, more of it than an L1 cache has for the warps that are resident: python
# tests/test_gpu_static.py.
LANE_BLOCKS = 2


@dataclass(frozen=True)
class Batch:
    """Samples of consecutive shading points, as samples.cl lays them out.

    Attributes
    ----------
    points : range
        Where in `order` the batch's shading points are.
    order : HostArray
        uint32, indices of shading points.
    samples : int
        Samples of each point; `stride` elements are reserved for each.
    u, v, value, slot, visible : HostArray
        Coordinates, values without shadow, and where in `visible` (uint8) a sample's ray was answered.
    weight : HostArray, optional
        One over the density that the samples were drawn with; None: uniform.
    entries : int
        Weighted values that each sample is the mean of, `stride` elements apart; more than one where
        points share paths.
    """

    points: range
    order: HostArray
    samples: int
    stride: int
    u: HostArray
    v: HostArray
    value: HostArray
    slot: HostArray
    visible: HostArray
    weight: HostArray | None = None
    entries: int = 1


# Bytes that a sample takes in `Room` and `ShadowRays`, but its values; and what paths take at most: two
# waves of two branches, what each brings, and where points share paths their hits and entries.
SAMPLE_BYTES, PATH_BYTES = 17 + 28, 1 << 10


def samples_held(device: Device, samples: int, size: int) -> int:
    """How many samples of `size` bytes each are held at a time; `samples` on CPUs with room enough."""
    if device.is_gpu:
        samples = max(samples, device.cl_device.max_compute_units * SAMPLES_A_UNIT)
    return device.memory.fitting(samples, size)


def sample_bytes(channels: int, nested: bool) -> int:
    """Bytes of the memory of two batches, or of one of paths, for each of their samples, at most."""
    return 2 * (SAMPLE_BYTES + 4 * channels) + (PATH_BYTES if nested else 0)


class Room:
    """Memory for one batch: arrays as in `Batch`."""

    def __init__(self, device: Device, channels: int, capacity: int) -> None:
        self.u = HostArray(device, capacity, np.float32)
        self.v = HostArray(device, capacity, np.float32)
        self.value = HostArray(device, (channels, capacity), np.float32)
        self.weight = HostArray(device, capacity, np.float32)
        self.slot = HostArray(device, capacity, np.uint32)
        self.visible = HostArray(device, capacity, np.uint8, streams=True)


class Asked(NamedTuple):
    """A batch that the device computes, before its rays are answered.

    Attributes
    ----------
    drawn : Event, optional
        Of its kernel, where more may be asked of the device before its rays are answered.
    points, order, samples, stride, weight
        As in `Batch`.
    """

    room: Room
    rays: ShadowRays
    drawn: cl.Event | None
    points: range
    order: HostArray
    samples: int
    stride: int
    weight: HostArray | None

    def answer(self, count: RayCount) -> None:
        """Have the rays answered and counted."""
        samples, visible = len(self.points) * self.samples, self.room.visible
        let_through = self.rays.answer(samples, visible, count, self.drawn)
        if let_through is not None:
            self._tint(let_through)

    def _tint(self, let_through: np.ndarray) -> None:
        """Multiply values by what panes let through of each ray, float32 (rays, 3)."""
        elements, channels = len(self.points) * self.stride, self.room.value.shape[0]
        with self.room.slot.mapped(count=elements, after=self.drawn) as slot:
            traced = np.flatnonzero(slot < len(let_through))
            factors = let_through[slot[traced], :channels]
        own = Window(0, elements, range(channels), range(elements))
        with self.room.value.mapped(update=True, window=own, after=self.drawn) as planes:
            planes[:, traced] *= factors.T
