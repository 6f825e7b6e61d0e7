"""Occluders of each shading point: shadow rays to the lights that need no ray tracer."""

from __future__ import annotations

import numpy as np

from ..integrands import Integrand
from ..integrands.light_sources import light_sources
from ..integrands.lights import LIGHT_FILES
from ..opencl.device import Device
from ..opencl.kernel import Arguments
from ..opencl.memory import HostArray
from ..opencl.program import build
from ..points.points import ShadingPoints, surface_defines
from ..scene.load import Scene
from . import tuning
from .hierarchy import Hierarchy

# Triangles that are tested at most, fewer where all lists together do not fit their memory; points that
# have more in their shafts leave their rays to embree.
MOST_OCCLUDERS = 63
MOST_LIST_WORDS = 1 << 26
TOO_MANY = 0xFFFFFFFF
# Points, at most, whose occluders are counted even if they are too many.
COUNTED_POINTS = 256
# The lists of all points that have too many, and of all that have none.
COMMON_LISTS = 2
# What rounding moves corners, boxes and planes by, of the largest coordinate: six roundings of sums of
# up to 2 * 3^0.5.
TOLERANCE = 24 * 2.0**-24


def shafts_pay(scene: Scene) -> bool:
    """Whether looking for occluders is likely to cost less than the rays that it spares."""
    lights = light_sources(scene).lights
    few = len(lights.strip) <= tuning.MOST_LIGHTS
    return few and not lights.has_balls and not scene.has_gaps and scene.environment is None


class Occluders:
    """The triangles that can stand between each shading point and the lights.

    Parameters
    ----------
    device, scene, points
    integrand : Integrand
        One whose rays end on the lights (`to_lights`).
    most : int
        Longest list that is kept, if memory for all of them suffices.
    hierarchy : Hierarchy, optional
        The scene's, if there is one.
    kept : int, optional
        Longest list that is kept, where it was decided for more points than these.

    Attributes
    ----------
    lists, starts : HostArray
        uint32, the lists one after another as shaft.cl lays them out, and where each point's begins.
    mean_count : float
        Triangles that can shade a point, on average over some points.
    hierarchy : Hierarchy
        Of the triangles that the lists name.
    arguments, walked : dict
        Those of kernels that read lists, and more of those that walk the hierarchy, by name.
    """

    def __init__(
        self,
        device: Device,
        scene: Scene,
        points: ShadingPoints,
        integrand: Integrand,
        most: int = MOST_OCCLUDERS,
        hierarchy: Hierarchy | None = None,
        kept: int | None = None,
    ) -> None:
        self.hierarchy = hierarchy or Hierarchy(device, scene)
        # No triangle is listed twice.
        self._room = most
        self._most = most if kept is None else kept
        words = COMMON_LISTS + points.active * (min(most, len(scene.triangles)) + 1)
        self.lists = HostArray(device, min(words, MOST_LIST_WORDS), np.uint32)
        self.starts = HostArray(device, points.active, np.uint32)
        self.arguments: Arguments = {
            "starts": self.starts,
            "occluders": self.lists,
            "triangles": self.hierarchy.triangles,
        }
        self.walked: Arguments = {
            "levels": self.hierarchy.levels,
            "boxes": self.hierarchy.boxes,
            "tolerance": TOLERANCE * float(np.abs(scene.bounds).max()),
        }
        defines = {**surface_defines(), **self.defines(), **integrand.defines(scene)}
        files = ("common", "surface", *LIGHT_FILES, "shaft")
        find = build(device, files, defines).kernel("find_occluders")
        lights = HostArray.of(device, integrand.data(scene))
        # The same numbers as at the lists' heads: the host wants these without the lists.
        lengths = HostArray(device, points.active, np.uint32)
        step = -(-points.active // COUNTED_POINTS)
        counted = HostArray(device, -(-points.active // step), np.uint32)
        cursor = HostArray(device, 1, np.uint32)
        while True:
            cursor.fill(COMMON_LISTS)
            find(
                points.active,
                point_count=points.active,
                total_points=points.total,
                triangle_count=len(scene.triangles),
                most=self._most,
                capacity=self.lists.shape[0],
                surface=points.surface,
                lights=lights,
                **self.arguments,
                **self.walked,
                counted_step=step,
                lengths=lengths,
                counted=counted,
                cursor=cursor,
            )
            self._lengths = lengths.read()
            fitting = _longest_that_fits(self._lengths, self.lists.shape[0] - COMMON_LISTS)
            if fitting is None:
                self.mean_count = float(counted.read().mean())
                return
            self._most = fitting

    @property
    def longest(self) -> tuple[int, int]:
        """The longest list there is room for, and the longest that is kept."""
        return self._room, self._most

    @property
    def unknown(self) -> int:
        """Points with too many occluders for a list, whose rays are traced."""
        return int(np.count_nonzero(self._lengths == TOO_MANY))

    def counts(self, chosen: np.ndarray) -> np.ndarray:
        """How many triangles can shade each of the points `chosen`; too many count as twice the most."""
        return np.minimum(self._lengths[chosen], 2 * self._most)

    def list_of(self, point: int) -> np.ndarray | None:
        """Triangles that can shade a point, by their numbers in the hierarchy; None: too many."""
        if self._lengths[point] == TOO_MANY:
            return None
        first = int(self.starts.read()[point]) + 1
        return self.lists.read()[first : first + int(self._lengths[point])]

    def defines(self) -> dict[str, int | str]:
        """The `-D` constants of shaft.cl, beside those of surface.cl and the integrand."""
        return {
            **self.hierarchy.defines(),
            "MOST_OCCLUDERS": f"{max(self._room, 1)}u",
            "TOO_MANY": f"{TOO_MANY}u",
            "BLOCKS_A_ITEM": f"{tuning.BLOCKS_A_ITEM}u",
        }


def _longest_that_fits(lengths: np.ndarray, words: int) -> int | None:
    """The longest list, of `lengths` each, that is to be kept if all are to fit; None: they do."""
    known = np.sort(lengths[lengths != TOO_MANY].astype(np.int64))
    ends = np.cumsum(np.where(known > 0, known + 1, 0))
    fit = int(np.searchsorted(ends, words, side="right"))
    return None if fit == len(known) else int(known[fit]) - 1
