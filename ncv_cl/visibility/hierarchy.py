"""Boxes of boxes of triangles, for walks on the device."""

from __future__ import annotations

import numpy as np

from ..opencl.device import Device
from ..opencl.memory import HostArray
from ..scene.load import Scene
from . import tuning

# Children of a box; a whole number of vectors on every device.
CHILDREN = 16
# Bounds of what fills up a node: no plane crosses a box that is inside out.
EMPTY_LOWER, EMPTY_UPPER = np.float32(1e30), np.float32(-1e30)
# Triangles that are looked at together while an order is made: what is known of them fits caches.
TRIANGLES_IN_CACHE = 1 << 15


class Hierarchy:
    """A scene's triangles in boxes of boxes, as shaft.cl and walk.cl read them.

    Parameters
    ----------
    device, scene

    Attributes
    ----------
    levels : HostArray
        uint32, each level's first node, lowest first.
    boxes : HostArray
        float32 (nodes, 6, CHILDREN).
    triangles : HostArray
        float32 (leaves, 9, CHILDREN): x, y, z of corner 0, then 1, then 2.
    numbers : ndarray
        uint32 (triangles,), the scene's number of the triangle at each place.
    extent : float
        The largest coordinate.
    """

    def __init__(self, device: Device, scene: Scene) -> None:
        corners = scene.vertices[scene.triangles].astype(np.float32)
        # Corner by corner: along an axis of three numpy takes ten times as long.
        a, b, c = corners.transpose(1, 0, 2)
        lower, upper = (limit(limit(a, b), c) for limit in (np.minimum, np.maximum))
        order = packed_order(lower, upper)
        self.numbers = order.astype(np.uint32)
        self.extent = float(np.abs(corners).max())
        levels = box_levels(lower[order], upper[order])
        firsts = np.cumsum([0, *(len(level) for level in levels[:-1])])
        self.levels = HostArray.of(device, firsts.astype(np.uint32))
        self.boxes = HostArray.of(device, np.concatenate(levels))
        # What fills up a leaf is without extent: nothing is behind it.
        self.triangles = HostArray.of(device, in_nodes(padded(corners[order].reshape(-1, 9), 0.0)))

    def defines(self) -> dict[str, str]:
        """The `-D` constants of kernels that walk it."""
        return {"CHILDREN": f"{CHILDREN}u", "BOX_LEVELS": f"{self.levels.shape[0]}u"}


def packed_order(lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """An order of triangles of which every CHILDREN, CHILDREN², ... in a row lie close together.

    Triangles are halved again and again by the middles of their boxes, along the axis that makes the
    sum of surfaces least (the surface-area heuristic), at a multiple of the largest power of CHILDREN
    that both halves can hold. So every node but the last of a level is full, and needs no address.

    Parameters
    ----------
    lower, upper : ndarray
        float32 (triangles, 3), boxes of the triangles.

    Returns
    -------
    ndarray
        int64 (triangles,).
    """
    # All that is asked of bounds is the least; those of a triangle are side by side in memory.
    bounds = np.concatenate([lower, -upper], axis=1)
    centres = np.ascontiguousarray((lower + upper).T)
    return _arranged(np.arange(len(lower))[None], bounds, centres).ravel()


def _arranged(rows: np.ndarray, bounds: np.ndarray, centres: np.ndarray) -> np.ndarray:
    """Each of `rows`, indices (sets, triangles of a set), in the order of `packed_order`."""
    size = rows.shape[1]
    if size <= CHILDREN:
        return rows
    unit = CHILDREN
    while unit * CHILDREN < size:
        unit *= CHILDREN
    first = (-(-size // unit) + 1) // 2 * unit
    rows = _halved(rows, first, bounds, centres)
    if 2 * first == size:
        return _arranged(rows.reshape(-1, first), bounds, centres).reshape(-1, size)
    parts = rows[:, :first], rows[:, first:]
    return np.concatenate([_arranged(part, bounds, centres) for part in parts], axis=1)


def _halved(rows: np.ndarray, first: int, bounds: np.ndarray, centres: np.ndarray) -> np.ndarray:
    """`rows` with the `first` elements before the others along the best axis of each row."""
    best = np.concatenate([_best_axes(part, first, bounds) for part in _in_cache(rows)])
    halved = np.empty_like(rows)
    for axis in range(3):
        chosen = np.flatnonzero(best == axis)
        for part in _in_cache(chosen[:, None], rows.shape[1]):
            own = rows[part[:, 0]]
            order = np.argpartition(centres[axis].take(own), first - 1, axis=1)
            halved[part[:, 0]] = own.take(order + own.shape[1] * np.arange(len(own))[:, None])
    return halved


def _in_cache(rows: np.ndarray, size: int | None = None) -> list[np.ndarray]:
    """`rows`, of `size` triangles each (its columns by default), in parts of `TRIANGLES_IN_CACHE`."""
    step = max(1, TRIANGLES_IN_CACHE // (size or rows.shape[1]))
    return [rows[at : at + step] for at in range(0, len(rows), step)]


def _best_axes(rows: np.ndarray, first: int, bounds: np.ndarray) -> np.ndarray:
    """Along which axis to cut each of `rows`, (sets,).

    Some of a row's triangles tell; not all need be looked at.
    """
    some = rows[:, :: max(1, rows.shape[1] // tuning.SAMPLED_TRIANGLES)]
    count, size = some.shape
    share = min(max(round(first / rows.shape[1] * size), 1), size - 1)
    own = bounds.take(some.ravel(), axis=0)
    centres = (own[:, :3] - own[:, 3:]).T.reshape(3, count, size)
    costs = []
    for axis in range(3):
        order = np.argsort(centres[axis], axis=1) + size * np.arange(count)[:, None]
        cut = own.take(order.T, axis=0)
        first_part, rest = cut[:share], cut[share:]
        costs.append(len(first_part) * _surface(first_part) + len(rest) * _surface(rest))
    return np.argmin(costs, axis=0)


def _surface(bounds: np.ndarray) -> np.ndarray:
    """Half the surface of the box about each set of boxes, whose bounds are (boxes, sets, 6)."""
    least = bounds.min(axis=0).astype(np.float64)
    x, y, z = -(least[:, :3] + least[:, 3:]).T
    return x * y + y * z + z * x


def box_levels(lower: np.ndarray, upper: np.ndarray) -> list[np.ndarray]:
    """Nodes of each level, float32 (nodes, 6, CHILDREN) as slices.cl lays them out, lowest first.

    Parameters
    ----------
    lower, upper : ndarray
        float32 (triangles, 3), boxes of the triangles in their order.
    """
    levels: list[np.ndarray] = []
    while not levels or len(levels[-1]) > 1:
        starts = np.arange(0, len(lower), CHILDREN)
        lower, upper = np.minimum.reduceat(lower, starts), np.maximum.reduceat(upper, starts)
        filled = [padded(lower, EMPTY_LOWER), padded(upper, EMPTY_UPPER)]
        levels.append(in_nodes(np.concatenate(filled, axis=1)))
    return levels


def padded(rows: np.ndarray, value: float | np.floating) -> np.ndarray:
    """`rows`, and more of `value` up to a whole number of nodes."""
    missing = -len(rows) % CHILDREN
    return np.concatenate([rows, np.full((missing, rows.shape[1]), value, rows.dtype)])


def in_nodes(rows: np.ndarray) -> np.ndarray:
    """(nodes * CHILDREN, numbers) as (nodes, numbers, CHILDREN), contiguous."""
    return np.ascontiguousarray(rows.reshape(-1, CHILDREN, rows.shape[1]).transpose(0, 2, 1))
