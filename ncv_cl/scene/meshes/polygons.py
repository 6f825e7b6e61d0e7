"""Polygons with any number of corners, convex or not, as triangles."""

from __future__ import annotations

import mapbox_earcut
import numpy as np
from numpy.typing import NDArray

from .common import Indices, Vectors

# Areas below this fraction of a squared diameter count as none.
_NO_AREA = 1e-12
# A triangulation whose area is off by more than this fraction does not fill its outline.
_AREA_ERROR = 1e-6
# A polygon further from its mean plane than this fraction of its size is not flat.
_FLATNESS = 0.01


def triangulate(
    vertices: Vectors, corners: Indices, counts: Indices
) -> tuple[Indices, Indices, Indices]:
    """Cut polygons into triangles of the same area and winding.

    A polygon that its first corner sees whole, as in every convex one, becomes a fan around that
    corner; all others are cut by earcut in the plane of their mean normal.

    Parameters
    ----------
    vertices : float64 (n_vertices, 3)
    corners : int64 (n_corners,)
        Indices into `vertices`, polygon after polygon.
    counts : int64 (n_polygons,)
        Corners of each polygon. Those with less than three become no triangle.

    Returns
    -------
    triangles : int64 (n_triangles, 3)
        Positions in `corners`, in the order of the polygons.
    polygon : int64 (n_triangles,)
        The polygon each triangle is part of.
    crossing : int64 (n_crossing,)
        Polygons whose outline crosses itself or is so far from flat that it does in its mean plane:
        what their triangles should be is a guess.
    """
    if np.all(counts == 3):
        return np.arange(len(corners)).reshape(-1, 3), np.arange(len(counts)), np.zeros(0, np.int64)
    starts = np.cumsum(counts) - counts
    triangles, owners, crossing = [], [], []
    for count in np.unique(counts[counts >= 3]):
        chosen = np.flatnonzero(counts == count)
        places = starts[chosen, None] + np.arange(count)
        cut, owner, bad = _equal_counts(vertices, corners, places)
        triangles.append(cut)
        owners.append(chosen[owner])
        crossing.append(chosen[bad])
    if not triangles:
        return np.zeros((0, 3), np.int64), np.zeros(0, np.int64), np.zeros(0, np.int64)
    owner = np.concatenate(owners)
    order = np.argsort(owner, kind="stable")
    return np.concatenate(triangles)[order], owner[order], np.sort(np.concatenate(crossing))


def strip_triangles(strips: Indices) -> Indices:
    """Triangles (n, 3) of strips that -1 separates; every other one is turned, as strips have it."""
    if len(strips) < 3:
        return np.zeros((0, 3), dtype=np.int64)
    cuts = np.flatnonzero(strips < 0)
    starts = np.concatenate([[0], cuts + 1])
    place = np.arange(len(strips)) - np.repeat(starts, np.diff([*starts, len(strips)]))
    first = np.flatnonzero(np.lib.stride_tricks.sliding_window_view(strips, 3).min(axis=1) >= 0)
    odd = place[first] % 2
    return np.stack([strips[first + odd], strips[first + 1 - odd], strips[first + 2]], axis=1)


def _equal_counts(
    vertices: Vectors, corners: Indices, places: Indices
) -> tuple[Indices, Indices, Indices]:
    """Triangles, owners and crossing rows of polygons (rows of `places`) of equally many corners."""
    n_polygons, count = places.shape
    if count == 3:
        return places, np.arange(n_polygons), np.zeros(0, np.int64)
    local = np.tile(_fan(count), (n_polygons, 1, 1))
    filled = _fan_fills(vertices[corners[places]])
    if count == 4:
        # The other diagonal of a quadrilateral.
        turned = np.flatnonzero(~filled)
        other = turned[_fan_fills(vertices[corners[np.roll(places[turned], -1, axis=1)]])]
        local[other] = (_fan(4) + 1) % 4
        filled[other] = True
    owner = np.repeat(np.flatnonzero(filled), count - 2)
    rest = np.flatnonzero(~filled)
    ears, ear_owner, crossing = _by_ears(vertices[corners[places[rest]]])
    owner = np.concatenate([owner, rest[ear_owner]])
    cuts = np.concatenate([local[filled].reshape(-1, 3), ears])
    return places[owner[:, None], cuts], owner, rest[crossing]


def _fan(count: int) -> Indices:
    """The triangles (count - 2, 3) around the first corner."""
    steps = np.arange(1, count - 1)
    return np.stack([np.zeros_like(steps), steps, steps + 1], axis=1)


def _newell(points: Vectors) -> Vectors:
    """Twice the vector areas (..., 3) of polygons (..., n, 3) whose first corner is the origin."""
    return np.cross(points, np.roll(points, -1, axis=-2)).sum(axis=-2)


def _fan_fills(points: Vectors) -> NDArray[np.bool_]:
    """Whether all triangles of the fan around the first corner have the polygon's winding."""
    points = points - points[:, :1]
    normal = _newell(points)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    normal = np.divide(normal, length, out=np.zeros_like(normal), where=length > 0.0)
    heights = np.cross(points[:, 1:-1], points[:, 2:]) @ normal[:, :, None]
    size = np.square(points).sum(axis=2).max(axis=1)
    return heights[:, :, 0].min(axis=1) > _NO_AREA * size


def _by_ears(points: Vectors) -> tuple[Indices, Indices, Indices]:
    """Triangles (n, 3), their owners and crossing rows of polygons (n_polygons, n_corners, 3)."""
    n_polygons, count = points.shape[:2]
    points = points - points[:, :1]
    normal = _newell(points)
    twice_area = np.linalg.norm(normal, axis=1)
    size = np.square(points).sum(axis=2).max(axis=1)
    has_area = twice_area > _NO_AREA * size
    normal[has_area] /= twice_area[has_area, None]
    flat = _in_plane(points, normal)
    cuts = [_fan(count)] * n_polygons
    for row in np.flatnonzero(has_area):
        ends = np.array([count], dtype=np.uint32)
        cuts[row] = mapbox_earcut.triangulate_float64(flat[row], ends).astype(np.int64).reshape(-1, 3)
    owner = np.repeat(np.arange(n_polygons), [len(cut) for cut in cuts])
    cut = np.concatenate([np.zeros((0, 3), np.int64), *cuts])
    corners = flat[owner[:, None], cut]
    one, two = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    signed = one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0]
    cut[signed < 0.0] = cut[signed < 0.0, ::-1]
    covered = np.bincount(owner, np.abs(signed), minlength=n_polygons)
    crossing = has_area & (np.abs(covered - twice_area) > _AREA_ERROR * twice_area)
    # Corners on one line have no area in any cut; others without a normal are no flat polygon.
    parts = np.linalg.norm(np.cross(points[:, 1:-1], points[:, 2:]), axis=2)
    crossing |= ~has_area & (parts.max(axis=1) > _NO_AREA * size)
    # Ears that were cut in the plane may leave out parts of what is not flat; a fan does not.
    height = np.abs(np.einsum("pnk,pk->pn", points, normal)).max(axis=1)
    for_fan = np.flatnonzero(crossing & has_area & (height > _FLATNESS * np.sqrt(size)))
    keep = ~np.isin(owner, for_fan)
    cut = np.concatenate([cut[keep], np.tile(_fan(count), (len(for_fan), 1))])
    owner = np.concatenate([owner[keep], np.repeat(for_fan, count - 2)])
    return cut, owner, np.flatnonzero(crossing)


def _in_plane(points: Vectors, normal: Vectors) -> Vectors:
    """Coordinates (n_polygons, n_corners, 2) of points in the planes of unit normals (n_polygons, 3)."""
    axis = np.eye(3)[np.argmin(np.abs(normal), axis=1)]
    first = np.cross(axis, normal)
    length = np.linalg.norm(first, axis=1, keepdims=True)
    first = np.divide(first, length, out=np.zeros_like(first), where=length > 0.0)
    return np.einsum("pnk,pck->pnc", points, np.stack([first, np.cross(normal, first)], axis=1))
