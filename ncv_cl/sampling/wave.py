"""Waves: memory for the rays of one bounce of all paths, which kernels and the host share."""

from __future__ import annotations

import time

import numpy as np

from ..opencl.device import Device
from ..opencl.layout import Record
from ..opencl.memory import HostArray
from ..opencl.program import build
from ..points.points import surface_defines
from ..points.trace import Hits, Tracer
from ..visibility.trace import DeviceTracer

# Words before the planes of a wave, and between the two counts there: a cache line each.
HEADER, COUNT_STEP = 32, 16
# What is kept of a ray that goes on and of a shadow ray, a plane each number. The host reads rays, and
# writes what they hit (a triangle's number or -1, barycentric coordinates, the distance in multiples of
# the direction) and, in bytes, which shadow rays are lit. The rest is the kernels' own: `density` is
# that of the direction, 0 where a light that the ray hits was sampled otherwise, and `strips` where
# those of the surface that it left begin.
PLANES = Record(
    "WAVE",
    {
        "origin": 3,
        "direction": 3,
        "shadow_origin": 3,
        "shadow_direction": 3,
        "triangle": 1,
        "u": 1,
        "v": 1,
        "distance": 1,
        "lit": 1,
        "throughput": 3,
        "density": 1,
        "path": 1,
        "strips": 1,
        "shadow_throughput": 3,
        "shadow_path": 1,
        "behind": 1,
        "passed": 1,
    },
)
# What only scenes with panes have: how far before a ray's origin it began, and how many it went through.
PANES_ONLY = PLANES["behind"].start
# Planes that the host maps: the first so many.
HOST_PLANES = PLANES["lit"].stop


def wave_defines() -> dict[str, int | str]:
    """The `-D` constants of wave.cl."""
    return {"HEADER": f"{HEADER}u", "COUNT_STEP": f"{COUNT_STEP}u", **PLANES.defines()}


class Wave:
    """Memory for the rays of one bounce and their hits, as wave.cl lays it out.

    Parameters
    ----------
    device
    capacity : int
        Most rays of each kind.
    panes : bool
        Whether rays may go through thin panes.

    Attributes
    ----------
    words : HostArray
        float32; some planes hold integers.
    plane : int
        Elements of a plane.
    rays, shadows, tested : int
        Numbers of path rays, of shadow rays to be traced, and of rays of both kinds that kernels answer.
    """

    def __init__(self, device: Device, capacity: int, panes: bool = False) -> None:
        self._device = device
        self._width = device.vector_width
        self._panes = panes
        self._planes = PLANES.size if panes else PANES_ONLY
        self.words = HostArray(device, HEADER + self._planes * self._plane_of(capacity), np.float32)
        self.words.fill(0)
        self.plane = self.rays = self.shadows = self.tested = 0

    def make_room(self, count: int) -> None:
        """For at most `count` rays of each kind."""
        self.plane = self._plane_of(count)

    def _plane_of(self, count: int) -> int:
        # Whole vectors; and one line more than what may be a power of two, or all planes would share a
        # few sets of the cache.
        return -(-count // self._width) * self._width + COUNT_STEP

    def trace(self, tracer: Tracer | DeviceTracer) -> float:
        """Trace what kernels have appended, and leave the counts at zero; the seconds of embree."""
        if isinstance(tracer, DeviceTracer):
            self._trace_on_device(tracer)
            return 0.0
        mapped = self._planes if self._panes else HOST_PLANES
        with self.words.mapped(count=HEADER + mapped * self.plane, update=True) as words:
            started = time.perf_counter()
            counts = words[: 2 * COUNT_STEP : COUNT_STEP].view(np.uint32)
            self.rays, self.shadows = counts.tolist()
            counts[:] = 0
            planes = words[HEADER:].reshape(mapped, self.plane)
            rays, shadows = planes[:, : self.rays], planes[:, : self.shadows]
            triangle, u, v, distance = (
                rays[PLANES[name].start] for name in ("triangle", "u", "v", "distance")
            )
            tracer.closest_and_visible(
                rays[PLANES["origin"]].T,
                rays[PLANES["direction"]].T,
                Hits(triangle.view(np.int32), u, v, distance),
                shadows[PLANES["shadow_origin"]].T,
                shadows[PLANES["shadow_direction"]].T,
                planes[PLANES["lit"].start].view(np.uint8)[: self.shadows],
                *([planes[PLANES["shadow_throughput"], : self.shadows].T] if self._panes else []),
            )
            return time.perf_counter() - started

    def _trace_on_device(self, tracer: DeviceTracer) -> None:
        """Have kernels trace what others have appended; nobody waits for the answers."""
        self.rays, self.shadows = self._take_counts()
        files = ("common", "surface", "wave", "trace", "wave_rays")
        # What only lights need is left out.
        defines = {
            **surface_defines(),
            **wave_defines(),
            "HAS_ROWS": 0,
            "HAS_PANES": 0,
            **tracer.defines(),
        }
        program = build(self._device, files, defines)
        arguments = {**tracer.arguments, "plane": self.plane, "wave": self.words}
        hits = program.kernel("find_hits")
        hits(self.rays, count=self.rays, numbers=tracer.numbers, **arguments)
        program.kernel("find_lit")(self.shadows, count=self.shadows, **arguments)

    def count(self) -> None:
        """Count what kernels have appended and answer themselves, and leave the counts at zero."""
        self.rays, tested = self._take_counts()
        self.tested = self.rays + tested

    def _take_counts(self) -> list[int]:
        """How many rays and shadow rays kernels have appended; counts are left at zero."""
        with self.words.mapped(count=HEADER, update=True) as words:
            counts = words[: 2 * COUNT_STEP : COUNT_STEP].view(np.uint32)
            found = counts.tolist()
            counts[:] = 0
        return found

    def under_way(self) -> tuple[np.ndarray, np.ndarray]:
        """Paths of the rays, uint32, and their throughputs, float32 (3, rays)."""
        with self.words.mapped() as words:
            planes = words[HEADER : HEADER + self._planes * self.plane].reshape(-1, self.plane)
            rays = planes[:, : self.rays]
            path = rays[PLANES["path"].start].copy().view(np.uint32)
            return path, rays[PLANES["throughput"]].copy()
