"""Points of a mesh for the texels of its map: conservative rasterisation of its triangles' UVs."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ..scene.uv_mesh import TrianglesOnMap, checked_mesh

# Pairs of a triangle and a place on the map that are looked at together.
PAIRS_AT_ONCE = 1 << 20
# A place counts as inside a triangle that it misses by this part of the triangle.
EDGE = 1e-9
# Places on a triangle's edge are moved in by this part of its height.
INWARD = 2.0**-12


@dataclass(frozen=True)
class Texels:
    """Places on a map that lie on a mesh, and their points.

    Attributes
    ----------
    cell : ndarray
        int64 (points,), row-major on the grid of `samples` × `samples` places a texel.
    positions, normals : ndarray
        float64 (points, 3): in the world, shading normals of unit length.
    clamped : ndarray
        bool (points,): the texel's middle, moved into a triangle that covers a part of the texel but
        none of its places.
    counts : dict
        Triangles without area on the map and outside of it, and places that several triangles cover.
    """

    cell: np.ndarray
    positions: np.ndarray
    normals: np.ndarray
    clamped: np.ndarray
    counts: dict[str, int]


def find_texels(mesh: TrianglesOnMap, size: tuple[int, int], samples: int) -> Texels:
    """The places of a map of `size`, width and height, that lie on the mesh.

    Where no place of a texel is on a triangle that covers some of it, its middle is moved to the nearest
    point of such a triangle.

    Raises
    ------
    BakeError

    Warns
    -----
    UserWarning
        For triangles that have no area on the map or lie outside of it, and for places that several
        triangles cover: the first of them has it.
    """
    vertices, triangles, uv, normals = checked_mesh(mesh)
    # On the map, in texels, from its upper left corner.
    flat = np.stack([uv[:, 0], 1.0 - uv[:, 1]], axis=1) * size
    corners = flat[triangles]
    edges = corners[:, 1:] - corners[:, :1]
    twice_area = edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0]
    longest = np.abs(edges).max(axis=(1, 2))
    thin = np.abs(twice_area) <= 1e-12 * np.maximum(longest, 1e-300) ** 2
    beside = ((corners.max(axis=1) <= 0) | (corners.min(axis=1) >= size)).any(axis=1)
    usable = np.flatnonzero(~(thin | beside))
    grid = (size[0] * samples, size[1] * samples)
    owner, doubled = _inside(corners[usable] * samples, grid)
    cell = np.flatnonzero(owner >= 0)
    place = np.stack([cell % grid[0] + 0.5, cell // grid[0] + 0.5], axis=1) / samples
    found = owner[cell]
    has_place = np.zeros((size[1], size[0]), bool)
    has_place[cell // grid[0] // samples, cell % grid[0] // samples] = True
    texel, own, moved = _clamped(corners[usable], size, has_place)
    more = (texel // size[0] * samples) * grid[0] + texel % size[0] * samples
    cell, place = np.concatenate([cell, more]), np.concatenate([place, moved])
    triangle = usable[np.concatenate([found, own])]
    beyond = (corners.min(axis=1) < 0) | (corners.max(axis=1) > size)
    counts = {
        "triangles_without_area": int(thin.sum()),
        "triangles_outside": int(beyond.any(axis=1).sum()),
        "places_covered_twice": doubled,
    }
    _warn(counts, len(triangles))
    # Off the edge, beyond which there may be nothing, or another surface.
    weights = np.maximum(_barycentric(corners[triangle], place), INWARD)
    weights /= weights.sum(axis=1, keepdims=True)
    own_corners = triangles[triangle]
    positions = (weights[..., None] * vertices[own_corners]).sum(axis=1)
    clamped = np.arange(len(cell)) >= len(found)
    return Texels(cell, positions, _normals(vertices, own_corners, normals, weights), clamped, counts)


def _warn(counts: dict[str, int], triangles: int) -> None:
    said = {
        "triangles_without_area": f"of {triangles} triangles have no area on the map and are left out",
        "triangles_outside": f"of {triangles} triangles reach beyond the map, where they are cut off",
        "places_covered_twice": "places of the map are covered by several triangles: the first has them",
    }
    for name, text in said.items():
        if counts[name]:
            warnings.warn(f"{counts[name]} {text}", stacklevel=4)


def _inside(corners: np.ndarray, grid: tuple[int, int]) -> tuple[np.ndarray, int]:
    """Of each cell of a grid the first triangle that its middle is in, int64 (cells,), -1: none.

    And how many cells several triangles cover, their edges left aside.
    """
    owner = np.full(grid[0] * grid[1], -1)
    depth = np.zeros(grid[0] * grid[1], np.int64)
    for triangle, column, row in _candidates(corners, grid, 0.0):
        place = np.stack([column + 0.5, row + 0.5], axis=1)
        least = _barycentric(corners[triangle], place).min(axis=1)
        cell = row * grid[0] + column
        np.add.at(depth, cell[least > 1e-6], 1)
        cell, triangle = cell[least >= -EDGE], triangle[least >= -EDGE]
        # In reverse, so that the first triangle stays.
        fresh = owner[cell] < 0
        cell, triangle = cell[fresh], triangle[fresh]
        owner[cell[::-1]] = triangle[::-1]
    return owner, int(np.count_nonzero(depth > 1))


def _candidates(
    corners: np.ndarray, grid: tuple[int, int], slack: float
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Pairs of triangles and cells whose boxes meet, in parts: triangle, column, row, int64 (pairs,)."""
    limit = np.array(grid) - 1
    first = np.clip(np.floor(corners.min(axis=1) - 0.5 - slack), 0, limit).astype(np.int64)
    last = np.clip(np.ceil(corners.max(axis=1) - 0.5 + slack), 0, limit).astype(np.int64)
    spans = last - first + 1
    pairs = spans.prod(axis=1)
    ends = np.cumsum(pairs)
    for start in range(0, int(ends[-1]) if len(ends) else 0, PAIRS_AT_ONCE):
        number = np.arange(start, min(start + PAIRS_AT_ONCE, ends[-1]))
        triangle = np.searchsorted(ends, number, side="right")
        within = number - (ends[triangle] - pairs[triangle])
        width = spans[triangle, 0]
        yield triangle, first[triangle, 0] + within % width, first[triangle, 1] + within // width


def _barycentric(corners: np.ndarray, place: np.ndarray) -> np.ndarray:
    """float64 (n, 3) of places (n, 2) in triangles (n, 3, 2)."""
    edges, apart = corners[:, 1:] - corners[:, :1], place - corners[:, 0]
    area = edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0]
    second = (apart[:, 0] * edges[:, 1, 1] - apart[:, 1] * edges[:, 1, 0]) / area
    third = (edges[:, 0, 0] * apart[:, 1] - edges[:, 0, 1] * apart[:, 0]) / area
    return np.stack([1.0 - second - third, second, third], axis=1)


def _clamped(
    corners: np.ndarray, size: tuple[int, int], has_place: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Texels of which triangles cover a part but no place: their numbers, triangles, places in these."""
    nearest = np.full(size[0] * size[1], np.inf)
    owner = np.full(size[0] * size[1], -1)
    where = np.zeros((size[0] * size[1], 2))
    for triangle, column, row in _candidates(corners, size, 0.5):
        empty = ~has_place[row, column]
        triangle, column, row = triangle[empty], column[empty], row[empty]
        middle = np.stack([column + 0.5, row + 0.5], axis=1)
        point, distance = _meeting(corners[triangle], middle)
        texel = row * size[0] + column
        order = np.argsort(-distance, kind="stable")
        order = order[distance[order] < nearest[texel[order]]]
        nearest[texel[order]], owner[texel[order]] = distance[order], triangle[order]
        where[texel[order]] = point[order]
    texel = np.flatnonzero(owner >= 0)
    return texel, owner[texel], where[texel]


def _meeting(corners: np.ndarray, middle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A point of each triangle in the texel about a middle, (n, 2), and how far it is; infinite: none.

    The middle itself, or else the middle of what lies in the texel of some edge: if neither is there,
    triangle and texel do not meet.
    """
    edges = np.roll(corners, -1, axis=1) - corners
    apart = middle[:, None] - corners
    # An edge is in the texel from the last of its entries, along both axes, to the first of its exits.
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = np.stack([(apart - 0.5) / edges, (apart + 0.5) / edges])
    beside = (edges == 0) & (np.abs(apart) > 0.5)
    enters = np.where(edges == 0, np.where(beside, np.inf, -np.inf), ends.min(axis=0)).max(axis=2)
    leaves = np.where(edges == 0, np.inf, ends.max(axis=0)).min(axis=2)
    enters, leaves = np.maximum(enters, 0.0), np.minimum(leaves, 1.0)
    meets = enters <= leaves
    along = np.where(meets, 0.5 * (enters + leaves), 0.0)
    points = corners + along[..., None] * edges
    distance = np.where(meets, np.abs(points - middle[:, None]).max(axis=2), np.inf)
    best, each = distance.argmin(axis=1), np.arange(len(corners))
    is_in = _barycentric(corners, middle).min(axis=1) >= 0
    point = np.where(is_in[:, None], middle, points[each, best])
    return point, np.where(is_in, 0.0, distance[each, best])


def _normals(
    vertices: np.ndarray, corners: np.ndarray, normals: np.ndarray | None, weights: np.ndarray
) -> np.ndarray:
    """Shading normals on the triangles' front side, of unit length, float64 (n, 3)."""
    first, second, third = vertices[corners].transpose(1, 0, 2)
    own = np.cross(second - first, third - first)
    own /= np.maximum(np.linalg.norm(own, axis=1, keepdims=True), 1e-300)
    if normals is None:
        return own
    smooth = (weights[..., None] * normals[corners]).sum(axis=1)
    smooth /= np.maximum(np.linalg.norm(smooth, axis=1, keepdims=True), 1e-300)
    return np.where((smooth * own).sum(axis=1, keepdims=True) > 0, smooth, own)
