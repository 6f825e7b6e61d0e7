"""Shadow rays of a batch of samples, and who answers them: the host, or a kernel that runs later."""

from __future__ import annotations

import time
from dataclasses import dataclass, fields

import numpy as np
import pyopencl as cl

from ..opencl.device import Device
from ..opencl.kernel import Arguments
from ..opencl.memory import HostArray
from ..opencl.program import build
from ..points.trace import Tracer
from .trace import DeviceTracer

# Words that draw_samples counts in: rays, samples that are answered without, and those off lines.
COUNTS = 3


@dataclass
class RayCount:
    """How many rays were traced, how many samples needed none, and seconds.

    Attributes
    ----------
    traced, skipped : int
        Traced by embree, or through the scene's boxes on the device.
    on_device : int
        Answered by testing a point's few occluders or a scene's few triangles, or by whole lines or
        slices.
    off_lines : int
        Samples that no line or slice was found for, or one with too much in its way to be kept.
    trace_seconds, sample_seconds : float
        Spent in embree, and in all else that drawing samples takes; where the host does not wait for
        samples, only what it takes to ask for them.
    """

    traced: int = 0
    skipped: int = 0
    on_device: int = 0
    off_lines: int = 0
    trace_seconds: float = 0.0
    sample_seconds: float = 0.0

    def __add__(self, other: RayCount) -> RayCount:
        return RayCount(*(getattr(self, one.name) + getattr(other, one.name) for one in fields(self)))

    def add(self, counted: list[int], samples: int) -> None:
        """Count what draw_samples `counted` (COUNTS numbers) while it drew so many samples."""
        traced, on_device, off_lines = counted
        self.traced += traced
        self.on_device += on_device
        self.off_lines += off_lines
        self.skipped += samples - traced - on_device


class ShadowRays:
    """Memory for a batch's rays, as samples.cl appends them.

    Parameters
    ----------
    device
    capacity : int
        Most rays.

    Attributes
    ----------
    arguments : dict
        Those of draw_samples, by name.
    streams : bool
        Whether the host reads the rays.
    runs_ahead : bool
        Whether it does not wait for them.
    """

    runs_ahead = False
    streams = True

    def __init__(self, device: Device, capacity: int) -> None:
        self.arguments: Arguments = {
            "origins": HostArray(device, (capacity, 3), np.float32, self.streams),
            "directions": HostArray(device, (capacity, 3), np.float32, self.streams),
            "distances": HostArray(device, capacity, np.float32, self.streams),
            "ray_count": HostArray(device, COUNTS, np.uint32, self.streams),
        }

    def begin(self) -> None:
        """Before a batch."""
        self.arguments["ray_count"].fill(0)

    def answer(
        self, samples: int, visible: HostArray, count: RayCount, drawn: cl.Event | None = None
    ) -> np.ndarray | None:
        """Answer the rays of a batch of `samples` into `visible` (uint8), and count them.

        With `drawn`, the event of the kernel that made them, what comes after it is not waited for.
        Returns what panes let through of each, float32 (rays, 3), where rays pass them.
        """
        raise NotImplementedError

    def collect(self, count: RayCount) -> None:
        """Count what `answer` has left for later."""


class HostRays(ShadowRays):
    """Rays that the host answers; `sees_through`: they pass panes, which dim them."""

    def __init__(self, device: Device, tracer: Tracer, capacity: int, sees_through: bool) -> None:
        super().__init__(device, capacity)
        self._tracer, self._sees_through = tracer, sees_through

    def answer(
        self, samples: int, visible: HostArray, count: RayCount, drawn: cl.Event | None = None
    ) -> np.ndarray | None:
        with self.arguments["ray_count"].mapped(after=drawn) as counts:
            counted = counts.tolist()
        rays = counted[0]
        started = time.perf_counter()
        with (
            self.arguments["origins"].mapped(count=rays, after=drawn) as origins,
            self.arguments["directions"].mapped(count=rays, after=drawn) as directions,
            self.arguments["distances"].mapped(count=rays, after=drawn) as distances,
            visible.mapped(write=True, count=rays, after=drawn) as answers,
        ):
            if self._sees_through:
                let_through = np.ones((rays, 3), np.float32)
                self._tracer.visible(origins, directions, distances, answers, let_through)
            else:
                let_through = None
                self._tracer.visible(origins, directions, distances, answers)
        count.trace_seconds += time.perf_counter() - started
        count.add(counted, samples)
        return let_through


class DeviceRays(ShadowRays):
    """Rays that a kernel answers: how many there are stays on the device until somebody asks."""

    runs_ahead = True
    streams = False

    def __init__(self, device: Device, tracer: DeviceTracer, capacity: int) -> None:
        super().__init__(device, capacity)
        self._tracer = tracer
        files = ("common", "trace", "shadow_rays")
        self._program = build(device, files, tracer.defines())
        self._totals = HostArray(device, COUNTS, np.uint64)
        self._totals.fill(0)
        self._samples = 0

    def answer(
        self, samples: int, visible: HostArray, count: RayCount, drawn: cl.Event | None = None
    ) -> None:
        find, add = (self._program.kernel(name) for name in ("find_visible", "add_counts"))
        # There is one ray a sample at most; work-items beyond the last ray end at once.
        find(samples, **self._tracer.arguments, **self.arguments, visible=visible)
        add(1, ray_count=self.arguments["ray_count"], totals=self._totals, group=1)
        self._samples += samples

    def collect(self, count: RayCount) -> None:
        if self._samples:
            count.add(self._totals.read().tolist(), self._samples)
            self._totals.fill(0)
            self._samples = 0


def shadow_rays(
    device: Device, tracer: Tracer | DeviceTracer, capacity: int, sees_through: bool
) -> ShadowRays:
    """Memory for at most `capacity` rays of a batch, whoever traces them."""
    if isinstance(tracer, DeviceTracer):
        return DeviceRays(device, tracer, capacity)
    return HostRays(device, tracer, capacity, sees_through)
