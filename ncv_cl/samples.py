"""Samples of an integrand in batches: coordinates, values without shadow, and traced visibility."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from .device import Device, HostArray
from .integrands import Integrand
from .points import ShadingPoints, surface_defines
from .program import build
from .sampler import sampler_defines, seed_words
from .scene import Scene
from .trace import Tracer

NO_RAY = 0xFFFFFFFF
# Samples held at a time: the scratch memory of sampling is fixed whatever the image's size.
SAMPLES_PER_BATCH = 1 << 19


@dataclass
class RayCount:
    """How many rays were traced, how many were not worth tracing, and the seconds it took."""

    traced: int = 0
    skipped: int = 0
    seconds: float = 0.0


@dataclass(frozen=True)
class Batch:
    """Samples of consecutive shading points, as samples.cl lays them out.

    Attributes
    ----------
    points : range
        The shading points.
    samples : int
        Samples of each point; `stride` elements are reserved for each.
    u, v, value, slot, visible : HostArray
        Coordinates, values without shadow, and where in `visible` (uint8) a sample's ray was answered.
    """

    points: range
    samples: int
    stride: int
    u: HostArray
    v: HostArray
    value: HostArray
    slot: HostArray
    visible: HostArray


class SampleSource:
    """Draws samples of one integrand at the shading points of one image.

    Parameters
    ----------
    device, scene, tracer, points, integrand
    sampler : {"independent", "sobol"}
    seed : int
    samples_per_point : int
        The most samples a point that one batch will hold.
    """

    def __init__(
        self,
        device: Device,
        scene: Scene,
        tracer: Tracer,
        points: ShadingPoints,
        integrand: Integrand,
        sampler: str,
        seed: int,
        samples_per_point: int,
    ) -> None:
        self.device = device
        self.points = points
        self.channels = integrand.channels
        self.rays = RayCount()
        self._tracer = tracer
        self._seed = seed_words(seed)
        self._data = HostArray.of(device, integrand.data(scene))
        defines = {
            **surface_defines(),
            **sampler_defines(sampler),
            **integrand.defines(scene),
            "NO_RAY": f"{NO_RAY}u",
        }
        files = ("common", "sampler", "surface", *integrand.files, "samples")
        self._draw = build(device, files, defines).kernel("draw_samples")

        self.stride = -(-samples_per_point // device.vector_width) * device.vector_width
        self.points_per_batch = max(1, min(points.active, SAMPLES_PER_BATCH // self.stride))
        capacity = self.points_per_batch * self.stride
        self._u = HostArray(device, capacity, np.float32)
        self._v = HostArray(device, capacity, np.float32)
        self._value = HostArray(device, (self.channels, capacity), np.float32)
        self._slot = HostArray(device, capacity, np.uint32)
        self._visible = HostArray(device, capacity, np.uint8)
        self._origins = HostArray(device, (capacity, 3), np.float32)
        self._directions = HostArray(device, (capacity, 3), np.float32)
        self._distances = HostArray(device, capacity, np.float32)
        self._ray_count = HostArray(device, 1, np.uint32)

    def point_batches(self) -> list[range]:
        """The active points cut into ranges that fit a batch."""
        step = self.points_per_batch
        return [
            range(first, min(first + step, self.points.active))
            for first in range(0, self.points.active, step)
        ]

    def draw(self, points: range, samples: range, stream: int) -> Batch:
        """Sample `points` (at most `points_per_batch`) and trace the rays that can matter.

        The batch is valid until the next call.
        """
        count = len(samples)
        stride = -(-count // self.device.vector_width) * self.device.vector_width
        self._ray_count.fill(0)
        self._draw(
            len(points) * stride // self.device.vector_width,
            points.start,
            len(points),
            self.points.total,
            samples.start,
            count,
            stride,
            stream,
            *self._seed,
            self.points.surface,
            self._data,
            self._u,
            self._v,
            self._value,
            self._slot,
            self._origins,
            self._directions,
            self._distances,
            self._ray_count,
        )
        rays = int(self._ray_count.read()[0])
        started = time.perf_counter()
        with (
            self._origins.mapped(count=rays) as origins,
            self._directions.mapped(count=rays) as directions,
            self._distances.mapped(count=rays) as distances,
            self._visible.mapped(write=True, count=rays) as visible,
        ):
            self._tracer.visible(origins, directions, distances, visible)
        self.rays.seconds += time.perf_counter() - started
        self.rays.traced += rays
        self.rays.skipped += len(points) * count - rays
        return Batch(points, count, stride, self._u, self._v, self._value, self._slot, self._visible)
