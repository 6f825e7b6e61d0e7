"""Memory for the rays of one bounce of all paths, which kernels write and read."""

from __future__ import annotations

import numpy as np

from ...opencl.device import GROUP_SIZE, Device
from ...opencl.layout import Record
from ...opencl.memory import HostArray

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


def knows_counts(device: Device) -> bool:
    """Whether a device's counts are at hand, as where it is the host: asking then costs nothing.

    Elsewhere a device would idle until the answer is there, and then the next kernels.
    """
    return device.is_cpu and device.memory.shared


def items_for(device: Device, rays: int) -> int:
    """Work-items of a kernel that reads at most so many rays of a wave, and goes on where these are few.

    Where their number is known on the device alone, no more than keep it busy: a work-item without a
    ray costs as well.
    """
    if knows_counts(device):
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
        Numbers of path rays and of shadow rays, or most there may be until somebody asks.
    panes : bool
    """

    def __init__(self, device: Device, capacity: int, panes: bool = False) -> None:
        self._device = device
        self._width = device.vector_width
        self.panes = panes
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
        """There are so many rays at most, which kernels count."""
        self.rays, self.shadows = rays, shadows

    def count(self) -> None:
        """Wait for how many rays kernels have appended."""
        with self.words.mapped(count=HEADER) as words:
            self.take_counts(words)

    def take_counts(self, words: np.ndarray) -> None:
        """Take the numbers of rays from `words`, float32, the wave's first."""
        counts = words[: COUNT_STEP + 1 : COUNT_STEP].view(np.uint32)
        self.rays, self.shadows = counts.tolist()

    @property
    def host_planes(self) -> int:
        """Planes, the first so many, that the host reads or writes."""
        return self._planes if self.panes else HOST_PLANES

    def under_way(self) -> tuple[np.ndarray, np.ndarray]:
        """Paths of the rays, uint32, and their throughputs, float32 (3, rays)."""
        with self.words.mapped() as words:
            planes = words[HEADER : HEADER + self._planes * self.plane].reshape(-1, self.plane)
            rays = planes[:, : self.rays]
            path = rays[PLANES["path"].start].copy().view(np.uint32)
            return path, rays[PLANES["throughput"]].copy()
