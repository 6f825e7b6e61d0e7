"""Occluders of each shading point: shadow rays to the lights that need no ray tracer."""

from __future__ import annotations

import numpy as np

from ..integrands import Integrand
from ..opencl.device import Device
from ..opencl.memory import HostArray
from ..opencl.program import build
from ..points.points import ShadingPoints, surface_defines
from ..scene.load import Scene
from . import tuning

# Children of a box.
BRANCH = 16
# Triangles that are tested at most, fewer where all lists together do not fit their memory; points that
# have more in their shafts leave their rays to embree.
MOST_OCCLUDERS = 63
MOST_LIST_WORDS = 1 << 26
TOO_MANY = 0xFFFFFFFF
# The lists of all points that have too many, and of all that have none.
COMMON_LISTS = 2
# What rounding moves corners and planes by, of the largest coordinate.
TOLERANCE = 16 * 2.0**-24


def shafts_pay(scene: Scene) -> bool:
    """Whether looking for occluders is likely to cost less than the rays that it spares."""
    return len(scene.lights) <= tuning.MOST_LIGHTS and not scene.has_holes


class Occluders:
    """The triangles that can stand between each shading point and the lights.

    Parameters
    ----------
    device, scene, points
    integrand : Integrand
        One whose rays end on the lights (`to_lights`).
    most : int
        Longest list that is kept, if memory for all of them suffices.

    Attributes
    ----------
    lists, starts : HostArray
        uint32, the lists one after another as shaft.cl lays them out, and where each point's begins.
    corners : HostArray
        float32 (9, stride), corners of the triangles that the lists name.
    """

    def __init__(
        self,
        device: Device,
        scene: Scene,
        points: ShadingPoints,
        integrand: Integrand,
        most: int = MOST_OCCLUDERS,
    ) -> None:
        corners = scene.vertices[scene.triangles].astype(np.float32)
        corners = corners[_along_curve(corners.mean(axis=1))]
        self.corners = HostArray.of(device, _rows(corners.reshape(-1, 9)))
        levels = [_boxes_of(corners.min(axis=1), corners.max(axis=1))]
        for _ in range(2):
            levels.append(_boxes_of(*levels[-1]))
        counts = [len(lower) for lower, _ in levels]
        firsts = [0, *np.cumsum([-(-count // BRANCH) * BRANCH for count in counts]).tolist()]
        rows = np.concatenate([_rows(np.concatenate(level, axis=1)) for level in levels], axis=1)
        boxes = HostArray.of(device, rows)
        # No triangle is listed twice.
        self._most = self._room = most
        words = COMMON_LISTS + points.active * (min(most, len(corners)) + 1)
        self.lists = HostArray(device, min(words, MOST_LIST_WORDS), np.uint32)
        self.starts = HostArray(device, points.active, np.uint32)
        defines = {**surface_defines(), **self.defines(), **integrand.defines(scene)}
        find = build(device, ("common", "surface", "lights", "shaft"), defines).kernel("find_occluders")
        lights = HostArray.of(device, integrand.data(scene))
        # The same numbers as at the lists' heads: the host wants these without the lists.
        lengths = HostArray(device, points.active, np.uint32)
        cursor = HostArray(device, 1, np.uint32)
        while True:
            cursor.fill(COMMON_LISTS)
            find(
                points.active,
                point_count=points.active,
                total_points=points.total,
                tolerance=TOLERANCE * float(np.abs(scene.bounds).max()),
                triangle_count=len(corners),
                corner_stride=self.stride,
                box_stride=rows.shape[1],
                count_0=counts[0],
                first_1=firsts[1],
                count_1=counts[1],
                first_2=firsts[2],
                count_2=counts[2],
                most=self._most,
                capacity=self.lists.shape[0],
                surface=points.surface,
                lights=lights,
                boxes=boxes,
                corners=self.corners,
                occluders=self.lists,
                starts=self.starts,
                lengths=lengths,
                cursor=cursor,
            )
            self._lengths = lengths.read()
            fitting = _longest_that_fits(self._lengths, self.lists.shape[0] - COMMON_LISTS)
            if fitting is None:
                return
            self._most = fitting

    @property
    def unknown(self) -> int:
        """Points with too many occluders for a list, whose rays are traced."""
        return int(np.count_nonzero(self._lengths == TOO_MANY))

    def counts(self, chosen: np.ndarray) -> np.ndarray:
        """How many triangles can shade each of the points `chosen`; too many count as twice the most."""
        return np.minimum(self._lengths[chosen], 2 * self._most)

    def list_of(self, point: int) -> np.ndarray | None:
        """The triangles, columns of `corners`, that can shade a point, uint32; None: too many."""
        if self._lengths[point] == TOO_MANY:
            return None
        first = int(self.starts.read()[point]) + 1
        return self.lists.read()[first : first + int(self._lengths[point])]

    def defines(self) -> dict[str, int | str]:
        """The `-D` constants of shaft.cl, beside those of surface.cl and the integrand."""
        return {
            "BRANCH": f"{BRANCH}u",
            "MOST_OCCLUDERS": f"{self._room}u",
            "TOO_MANY": f"{TOO_MANY}u",
            "BLOCKS_A_ITEM": f"{tuning.BLOCKS_A_ITEM}u",
        }

    @property
    def stride(self) -> int:
        """Floats of a row of `corners`."""
        return self.corners.shape[1]


def _longest_that_fits(lengths: np.ndarray, words: int) -> int | None:
    """The longest list, of `lengths` each, that is to be kept if all are to fit; None: they do."""
    known = np.sort(lengths[lengths != TOO_MANY].astype(np.int64))
    ends = np.cumsum(np.where(known > 0, known + 1, 0))
    fit = int(np.searchsorted(ends, words, side="right"))
    return None if fit == len(known) else int(known[fit]) - 1


def _along_curve(centres: np.ndarray) -> np.ndarray:
    """Indices in Morton order: neighbours in it are near each other."""
    lower, upper = centres.min(axis=0), centres.max(axis=0)
    cells = ((centres - lower) / np.maximum(upper - lower, 1e-30) * 1023).astype(np.uint64)
    code = np.zeros(len(centres), np.uint64)
    for bit in range(10):
        for axis in range(3):
            code |= (cells[:, axis] >> np.uint64(bit) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return np.argsort(code, kind="stable")


def _boxes_of(lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Bounds of every BRANCH of the boxes, each (boxes, 3)."""
    starts = np.arange(0, len(lower), BRANCH)
    return np.minimum.reduceat(lower, starts), np.maximum.reduceat(upper, starts)


def _rows(values: np.ndarray) -> np.ndarray:
    """Transposed, each row padded with zeros to a whole number of branches; contiguous."""
    padded = np.zeros((values.shape[1], -(-len(values) // BRANCH) * BRANCH), np.float32)
    padded[:, : len(values)] = values.T
    return padded
