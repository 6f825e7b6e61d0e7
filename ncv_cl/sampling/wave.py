"""Waves: memory for the rays of one bounce of all paths, which kernels and the host share."""

from __future__ import annotations

import time

import numpy as np

from ..opencl.device import GROUP_SIZE, Device
from ..opencl.layout import Record
from ..opencl.memory import HostArray
from ..opencl.program import build
from ..points.points import surface_defines
from ..points.trace import Hits, Tracer
from ..visibility.trace import DeviceTracer

# Words before the planes of a wave, and between the two counts there: a cache line each.
HEADER, COUNT_STEP = 32, 16
# Groups of a kernel over a wave that a GPU's compute unit has at once: with these it holds 2048
# work-items, as many as any does.
GROUPS_A_UNIT = 2048 // GROUP_SIZE
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


def items_for(device: Device, rays: int) -> int:
    """Work-items of a kernel that reads at most so many rays of a wave, and goes on where these are few.

    On a GPU no more than what keeps it busy: how many rays there are is known there alone, and a
    work-item without a ray costs as well.
    """
    if device.is_cpu:
        return rays
    return min(rays, device.cl_device.max_compute_units * GROUPS_A_UNIT * GROUP_SIZE)


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
    rays, shadows : int
        Numbers of path rays and of shadow rays; where the host does not wait for them, most there are.
    """

    def __init__(self, device: Device, capacity: int, panes: bool = False) -> None:
        self._device = device
        self._width = device.vector_width
        self._panes = panes
        self._planes = PLANES.size if panes else PANES_ONLY
        self.words = HostArray(device, HEADER + self._planes * self._plane_of(capacity), np.float32)
        self.words.fill(0)
        self.plane = self.rays = self.shadows = 0

    def make_room(self, count: int) -> None:
        """For at most `count` rays of each kind."""
        self.plane = self._plane_of(count)

    def _plane_of(self, count: int) -> int:
        # Whole vectors; and one line more than what may be a power of two, or all planes would share a
        # few sets of the cache.
        return -(-count // self._width) * self._width + COUNT_STEP

    def expect(self, rays: int, shadows: int) -> None:
        """There are so many rays at most, which kernels count, and nobody waits for their numbers."""
        self.rays, self.shadows = rays, shadows

    def count(self) -> None:
        """Wait for how many rays kernels have appended."""
        with self.words.mapped(count=HEADER) as words:
            self.rays, self.shadows = self._counts(words)

    @staticmethod
    def _counts(words: np.ndarray) -> list[int]:
        return words[: 2 * COUNT_STEP : COUNT_STEP].view(np.uint32).tolist()

    def trace(self, tracer: Tracer) -> float:
        """Have embree trace what kernels have appended; its seconds."""
        mapped = self._planes if self._panes else HOST_PLANES
        with self.words.mapped(count=HEADER + mapped * self.plane, update=True) as words:
            started = time.perf_counter()
            self.rays, self.shadows = self._counts(words)
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

    def trace_on_device(self, tracer: DeviceTracer, hits: bool = True) -> None:
        """Have kernels trace what others have appended, or with `hits` False its shadow rays alone."""
        files = ("common", "surface", "wave", "trace", "wave_rays")
        # What only lights need is left out.
        defines = {
            **surface_defines(),
            **wave_defines(),
            "HAS_ROWS": 0,
            "HAS_PANES": 0,
            "FOLLOWED": 0,
            **tracer.defines(),
        }
        program = build(self._device, files, defines)
        arguments = {**tracer.arguments, "plane": self.plane, "wave": self.words}
        if hits:
            find_hits = program.kernel("find_hits")
            find_hits(items_for(self._device, self.rays), numbers=tracer.numbers, **arguments)
        program.kernel("find_lit")(items_for(self._device, self.shadows), **arguments)

    def under_way(self) -> tuple[np.ndarray, np.ndarray]:
        """Paths of the rays, uint32, and their throughputs, float32 (3, rays)."""
        with self.words.mapped() as words:
            planes = words[HEADER : HEADER + self._planes * self.plane].reshape(-1, self.plane)
            rays = planes[:, : self.rays]
            path = rays[PLANES["path"].start].copy().view(np.uint32)
            return path, rays[PLANES["throughput"]].copy()
