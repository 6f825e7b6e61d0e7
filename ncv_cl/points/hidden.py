"""Points of a texel that must not count: inside of things, and behind a wall from the others."""

from __future__ import annotations

import numpy as np

from ..scene.load import Scene
from .trace import Tracer

# Rays of the hemisphere; more than this part of them must meet backs for a point to be inside.
HIDING_RAYS, INSIDE = 32, 0.5
# Between points of a texel is looked at this part of their distance above the surface.
LIFT = 0.25
# Rays start off the surface by this part of the coordinates.
OFFSET = 2.0**-17


def inside(scene: Scene, tracer: Tracer, positions: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Which points are inside of something, bool (n,): most of what they see is the backs of triangles.

    Parameters
    ----------
    positions, normals : ndarray
        float64 (n, 3), in the scene's frame, unit normals.
    """
    corners = scene.vertices[scene.triangles].astype(np.float64)
    planes = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    backs = np.zeros(len(positions), np.int64)
    origins = _lifted(scene, positions, normals, 0.0)
    tangent, other = frames(normals)
    for ray in range(HIDING_RAYS):
        # A spiral of even cosine-weighted shares.
        height = np.sqrt((ray + 0.5) / HIDING_RAYS)
        angle, across = ray * np.pi * (3 - np.sqrt(5)), np.sqrt((HIDING_RAYS - ray - 0.5) / HIDING_RAYS)
        directions = across * (np.cos(angle) * tangent + np.sin(angle) * other) + height * normals
        hits = tracer.closest(origins, directions.astype(np.float32))
        back = (planes[hits.triangle] * directions).sum(axis=1) > 0
        backs += (hits.triangle >= 0) & back
    return backs > INSIDE * HIDING_RAYS


def apart(
    scene: Scene,
    tracer: Tracer,
    positions: np.ndarray,
    normals: np.ndarray,
    texel: np.ndarray,
    from_middle: np.ndarray,
) -> np.ndarray:
    """Which points something separates from the texel's point that is nearest to its middle, bool (n,).

    Parameters
    ----------
    positions, normals
        As `inside` takes them.
    texel : ndarray
        int64 (n,), the texel of each.
    from_middle : ndarray
        float64 (n,), how far each is from it on the map.
    """
    order = np.lexsort((from_middle, texel))
    first = np.flatnonzero(np.diff(texel[order], prepend=-1))
    anchor = np.empty(len(texel), np.int64)
    anchor[order] = np.repeat(order[first], np.diff(np.append(first, len(order))))
    others = np.flatnonzero(anchor != np.arange(len(anchor)))
    anchor = anchor[others]
    lift = LIFT * np.linalg.norm(positions[others] - positions[anchor], axis=1)
    origins = _lifted(scene, positions[others], normals[others], lift)
    ends = _lifted(scene, positions[anchor], normals[anchor], lift)
    seen = np.empty(len(others), np.uint8)
    tracer.visible(origins, ends - origins, np.ones(len(others), np.float32), seen)
    found = np.zeros(len(texel), bool)
    found[others] = seen == 0
    return found


def _lifted(
    scene: Scene, positions: np.ndarray, normals: np.ndarray, lift: np.ndarray | float
) -> np.ndarray:
    """Above the surface by `lift` and more than rounding, float32 (n, 3)."""
    offset = OFFSET * np.abs(positions).max(axis=1) + 2.0**-3 * OFFSET * np.abs(scene.bounds).max()
    return (positions + (lift + offset)[:, None] * normals).astype(np.float32)


def frames(normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors beside each normal, float64 (n, 3)."""
    axis = np.eye(3)[np.abs(normals).argmin(axis=1)]
    tangent = np.cross(normals, axis)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    return tangent, np.cross(normals, tangent)
