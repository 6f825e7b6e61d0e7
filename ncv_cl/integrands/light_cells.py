"""Cells of a scene, by place and by direction of the surface, and what lights can bring to each.

Surfaces of one cell share how the unit square is dealt out to the lights (`lights`): a cell is a box of
a regular grid, and of the surfaces in it those whose normal points along one of six directions most.
What is said of a cell holds for every point of every triangle that reaches into it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..scene.load import Scene
from .light_sources import BALL, Lights

DIRECTIONS = 6
# Points of each cell's surfaces where lights are looked at from.
PLACES = 4
# Where in a triangle's part of the box those are, in multiples of the box's half extent.
_PATTERN = 0.5 * np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
# Boxes reach so far into their neighbours, in multiples of their edge: a kernel's rounding may take a
# point there for one of these.
_OVERLAP = 1e-3
# Components of a normal that differ by so little may be taken for each other.
_TIE = 1e-4
# What rounding moves a height above a plane by, of the coordinates that it is made of.
_ROUNDING = 1e-5
# Points of a light that its irradiance is a mean over; of more lights than so many only the middle.
_ON_LIGHT, _MIDDLE = 0.25 + 0.5 * np.array([[0, 0], [1, 0], [0, 1], [1, 1]]), np.array([[0.5, 0.5]])
_FEW_LIGHTS = 64
# Pairs of cells and lights looked at together: their arrays fit a cache.
_PAIRS_AT_ONCE = 1 << 14


@dataclass(frozen=True)
class Cells:
    """Cells that hold surfaces.

    Attributes
    ----------
    lower, inverse : float32 (3,)
        The grid's lower corner, and one over the extent of a box.
    counts : int64 (3,)
        Boxes along each axis.
    number : int64 (cells,)
        Of each cell: ((z counts[1] + y) counts[0] + x) DIRECTIONS + direction.
    places, normals : float64 (cells, PLACES, 3)
        Points on its surfaces, and their unit normals on the side that the cell is of.
    lowest, highest : float64 (cells, 3)
        A box that holds its surfaces.
    middle, spread : float64 (cells, 3)
        Half the sum and half the difference of its normals' least and largest components.
    depth : float64 (cells,)
        Least distance, along the normal, of its triangles' planes from the middle of the cell's box.
    """

    lower: np.ndarray
    inverse: np.ndarray
    counts: np.ndarray
    number: np.ndarray
    places: np.ndarray
    normals: np.ndarray
    lowest: np.ndarray
    highest: np.ndarray
    middle: np.ndarray
    spread: np.ndarray
    depth: np.ndarray

    def only(self, chosen: np.ndarray | slice) -> Cells:
        """Those of the cells that an index of one dimension chooses."""
        names = "number", "places", "normals", "lowest", "highest", "middle", "spread", "depth"
        return replace(self, **{name: getattr(self, name)[chosen] for name in names})

    @property
    def table_length(self) -> int:
        return int(self.counts.prod()) * DIRECTIONS


def scene_cells(scene: Scene, side: int) -> Cells:
    """The cells of all surfaces but the lights' own.

    Parameters
    ----------
    scene
    side : int
        Boxes along the longest extent.
    """
    corners = scene.vertices[scene.triangles[scene.triangle_light < 0]].astype(np.float64)
    if not len(corners):
        corners = np.zeros((1, 3, 3))
    lower, upper = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    extent = upper - lower
    counts = np.clip(np.ceil(side * extent / max(extent.max(), 1e-30)), 1, side).astype(np.int64)
    with np.errstate(divide="ignore"):
        inverse = np.where(extent > 0, counts / extent, 0.0)
    lower, inverse = lower.astype(np.float32), inverse.astype(np.float32)
    normals = _unit_normals(corners)
    triangle, axis, sign = _axes(normals)
    ends = corners.min(axis=1), corners.max(axis=1)
    first, last = (
        np.clip(np.floor((end - lower) * inverse.astype(np.float64) + slack), 0, counts - 1)
        for end, slack in zip(ends, (-_OVERLAP, _OVERLAP), strict=True)
    )
    item, box = _boxes_of(first[triangle].astype(np.int64), last[triangle].astype(np.int64))
    triangle, axis, normal = triangle[item], axis[item], (normals[triangle] * sign[:, None])[item]
    size = np.where(inverse > 0, 1.0 / np.maximum(inverse.astype(np.float64), 1e-30), 0.0)
    middle = lower + (box + 0.5) * size
    half = (0.5 + _OVERLAP) * size
    # A plane that passes by the box has nothing in it.
    distance = ((corners[triangle, 0] - middle) * normal).sum(axis=1)
    reach = np.abs(normal) @ half + _ROUNDING * np.abs(corners).max()
    number = ((box[:, 2] * counts[1] + box[:, 1]) * counts[0] + box[:, 0]) * 3 + axis
    order = np.flatnonzero(np.abs(distance) <= reach)
    order = order[np.argsort(number[order], kind="stable")]
    triangle, normal, middle, distance, number = (
        array[order] for array in (triangle, normal, middle, distance, number)
    )
    starts = np.flatnonzero(np.diff(number, prepend=-1))
    lowest = np.maximum(ends[0][triangle], middle - half)
    highest = np.minimum(ends[1][triangle], middle + half)
    least, most = np.minimum.reduceat(normal, starts), np.maximum.reduceat(normal, starts)
    places, chosen = _places(starts, len(normal), corners[triangle, 0], normal, lowest, highest)
    # Surfaces have two sides: all but the normals is the same.
    near, far = np.minimum.reduceat(distance, starts), np.maximum.reduceat(distance, starts)
    number = (2 * number[starts] + np.array([[0], [1]])).ravel()
    return Cells(
        lower, inverse, counts, number, _twice(places), np.concatenate([-chosen, chosen]),
        _twice(np.minimum.reduceat(lowest, starts)), _twice(np.maximum.reduceat(highest, starts)),
        np.concatenate([-least - most, least + most]) / 2, _twice(most - least) / 2,
        np.concatenate([-far, near]),
    ).only(np.argsort(number))  # fmt: skip


def may_light(cells: Cells, lights: Lights) -> np.ndarray:
    """Which lights may light which cells, bool (cells, lights): True wherever that is not certain.

    A light must be above the surface, and the surface on a side of the light that shines; both hold
    somewhere if they do at a corner.
    """
    centre = _box_middles(cells)
    above = np.zeros((len(cells.number), len(lights.area)), bool)
    rounding = _ROUNDING * max(
        np.abs(array).max() for array in (cells.lowest, cells.highest, lights.corners)
    )
    # Heights over planes of all normals of a cell at most: n . c = middle . c + (n - middle) . c.
    from_middle = cells.depth + (cells.middle * centre).sum(axis=1)
    spread = np.linalg.norm(cells.spread, axis=1)
    for corner in lights.corners:
        highest = cells.middle @ corner.T - from_middle[:, None]
        if spread.any():
            highest += spread[:, None] * np.sqrt(_squared_distances(centre, corner))
        above |= highest + lights.reach > -rounding
    # The farthest that a cell's box reaches on the emitting side.
    highest = (
        cells.lowest @ np.minimum(lights.normal, 0).T + cells.highest @ np.maximum(lights.normal, 0).T
    )
    shines = highest - (lights.normal * lights.corner).sum(axis=1) > -rounding
    return above & (shines | lights.two_sided)


def mean_irradiance(cells: Cells, lights: Lights) -> np.ndarray:
    """What each light brings to each cell without shadows, float64 (cells, lights), up to one factor.

    Means over the cells' places and a few points of each light, of radiance cos cos area / distance²;
    of lights that are large from a place, over a few directions to them, as lights.cl samples them.
    """
    step = max(1, _PAIRS_AT_ONCE // len(lights.area))
    starts = range(0, len(cells.number), step)
    parts = [_mean_irradiance(cells.only(slice(first, first + step)), lights) for first in starts]
    return np.concatenate([np.zeros((0, len(lights.area))), *parts])


def _mean_irradiance(cells: Cells, lights: Lights) -> np.ndarray:
    corner, edges, normal, area = lights.corner, lights.edges, lights.normal, lights.area
    diagonal2 = (edges**2).sum(axis=(1, 2))
    balls = np.flatnonzero(lights.shape == BALL)
    on_light = _ON_LIGHT if len(area) <= _FEW_LIGHTS else _MIDDLE
    total = np.zeros((len(cells.number), len(area)))
    for place, own in zip(
        cells.places.transpose(1, 0, 2), cells.normals.transpose(1, 0, 2), strict=True
    ):
        height = place @ normal.T - (corner * normal).sum(axis=1)
        emitted = np.where(lights.two_sided, np.abs(height), np.maximum(height, 0))
        # Balls face every place.
        to = place[:, None] - corner[balls]
        away = np.maximum(np.linalg.norm(to, axis=2), 1e-300)
        emitted[:, balls] = away * lights.sent(balls, to / away[..., None])
        found = np.zeros_like(total)
        for u, v in on_light:
            at = lights.at(u, v)
            cosine = np.maximum(own @ at.T - (own * place).sum(axis=1)[:, None], 0)
            found += cosine / _squared_distances(place, at) ** 2
        found *= emitted * area / len(on_light)
        middle = corner + edges.sum(axis=1) / 2
        cell, light = np.nonzero(_squared_distances(place, middle) < diagonal2)
        found[cell, light] = _of_large(
            place[cell], own[cell], corner[light], edges[light], normal[light], lights.tapered[light]
        )
        total += np.where(emitted > 0, found, 0.0)
    radiance = lights.radiance.mean(axis=1)
    # Beyond float64's range, which is refused later, nothing matters.
    return np.nan_to_num(total * (radiance / (PLACES * max(radiance.max(), 1e-300))))


def _of_large(
    place: np.ndarray,
    own: np.ndarray,
    corner: np.ndarray,
    edges: np.ndarray,
    normal: np.ndarray,
    tapered: np.ndarray,
) -> np.ndarray:
    """Irradiance for radiance 1, float64 (pairs,): a light a place, arrays (pairs, ..., 3).

    `tapered`, bool (pairs,), is whether lines along the second edge shorten to nothing, as in triangles.
    """

    def dot(first: np.ndarray, second: np.ndarray) -> np.ndarray:
        return (first * second).sum(axis=1)

    length = np.linalg.norm(edges[:, 1], axis=1)
    along = edges[:, 1] / length[:, None]
    across = np.cross(along, normal)
    begin = corner - place
    z, x0, width = dot(begin, normal), dot(begin, across), dot(edges[:, 0], across)
    first, last = np.arctan2(x0, np.abs(z)), np.arctan2(x0 + width, np.abs(z))
    total = np.zeros(len(place))
    for u, v in _ON_LIGHT:
        x = np.abs(z) * np.tan(first + u * (last - first))
        y = dot(begin, along) + (x - x0) / width * dot(edges[:, 0], along)
        end = y + length * np.where(tapered, 1 - (x - x0) / width, 1.0)
        radius = np.maximum(np.hypot(x, z), 1e-300)
        low, high = y / np.hypot(y, radius), end / np.hypot(end, radius)
        h = low + v * (high - low)
        y = radius * h / np.sqrt(np.maximum(1 - h**2, 1e-30))
        to = x[:, None] * across + y[:, None] * along + z[:, None] * normal
        cosine = dot(to, own) / np.maximum(np.linalg.norm(to, axis=1), 1e-300)
        total += np.maximum(cosine, 0) * (last - first) * (high - low)
    return total / len(_ON_LIGHT)


def cell_of(cells: Cells, position: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Numbers of the cells of points, as lights.cl finds them: int64 (points,), of float (points, 3)."""
    box = np.clip((position - cells.lower) * cells.inverse, 0, cells.counts - 1).astype(np.int64)
    size = np.abs(normal)
    axis = size.argmax(axis=1)
    positive = np.take_along_axis(normal, axis[:, None], axis=1)[:, 0] > 0
    box_number = (box[:, 2] * cells.counts[1] + box[:, 1]) * cells.counts[0] + box[:, 0]
    return box_number * DIRECTIONS + 2 * axis + positive


def _unit_normals(corners: np.ndarray) -> np.ndarray:
    edges = corners[:, 1:] - corners[:, :1]
    # Scaled before the cross product, whose squared length is very small for small triangles.
    scaled = edges / np.maximum(np.abs(edges).max(axis=2, keepdims=True), 1e-300)
    normals = np.cross(scaled[:, 0], scaled[:, 1])
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)


def _axes(normals: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """All triangles: which, an axis that it may count as facing, and the sign of its normal along it."""
    size = np.abs(normals)
    triangle, axis = np.nonzero(size >= size.max(axis=1, keepdims=True) - _TIE)
    return triangle, axis, np.where(normals[triangle, axis] > 0, 1.0, -1.0)


def _twice(array: np.ndarray) -> np.ndarray:
    return np.concatenate([array, array])


def _boxes_of(first: np.ndarray, last: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """All boxes from `first` to `last` (items, 3): the items' numbers, and the boxes (boxes, 3)."""
    spans = last - first + 1
    number = spans.prod(axis=1)
    item = np.repeat(np.arange(len(first)), number)
    within = np.arange(len(item)) - np.repeat(np.cumsum(number) - number, number)
    x = within % spans[item, 0]
    rest = within // spans[item, 0]
    y = rest % spans[item, 1]
    return item, first[item] + np.stack([x, y, rest // spans[item, 1]], axis=1)


def _places(
    starts: np.ndarray,
    length: int,
    corner: np.ndarray,
    normal: np.ndarray,
    lowest: np.ndarray,
    highest: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Points of each cell's surfaces, of evenly chosen triangles, and their normals."""
    number = np.diff(np.append(starts, length))
    chosen = starts[:, None] + number[:, None] * np.arange(PLACES) // PLACES
    places = (lowest[chosen] + highest[chosen]) / 2 + _PATTERN * (highest[chosen] - lowest[chosen]) / 2
    above = ((places - corner[chosen]) * normal[chosen]).sum(axis=2, keepdims=True)
    return places - above * normal[chosen], normal[chosen]


def _box_middles(cells: Cells) -> np.ndarray:
    number = cells.number // DIRECTIONS
    x, rest = number % cells.counts[0], number // cells.counts[0]
    box = np.stack([x, rest % cells.counts[1], rest // cells.counts[1]], axis=1)
    inverse = cells.inverse.astype(np.float64)
    size = np.where(inverse > 0, 1.0 / np.maximum(inverse, 1e-30), 0.0)
    return cells.lower + (box + 0.5) * size


def _squared_distances(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """float64 (first, second) of points (first, 3) and (second, 3)."""
    squared = (first**2).sum(axis=1)[:, None] + (second**2).sum(axis=1) - 2 * first @ second.T
    return np.maximum(squared, 1e-30)
