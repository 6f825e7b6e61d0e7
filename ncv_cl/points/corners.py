"""Points for the vertices of a mesh: one beside each corner of its triangles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

# Points are moved from a corner by this part of the way to the triangle's middle: other surfaces may
# begin at the corner itself.
OFF_CORNERS = 2.0**-6


@dataclass(frozen=True)
class Corners:
    """Points beside the corners of triangles.

    Attributes
    ----------
    vertex : ndarray
        int64 (points,), the vertex that each is for.
    positions, normals : ndarray
        float64 (points, 3), in the world, of unit length.
    weight : ndarray
        float64 (points,), the triangle's angle at the corner.
    """

    vertex: np.ndarray
    positions: np.ndarray
    normals: np.ndarray
    weight: np.ndarray


def find_corners(vertices: np.ndarray, triangles: np.ndarray, normals: np.ndarray | None) -> Corners:
    """The points of a mesh; triangles without area have none.

    Parameters
    ----------
    vertices, normals : ndarray
        float64 (n, 3); normals of any length, or None for the triangles' own.
    triangles : ndarray
        int64 (m, 3).
    """
    corners = vertices[triangles]
    own = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(own, axis=1)
    usable = length > 0
    corners, triangles, own = corners[usable], triangles[usable], own[usable] / length[usable, None]
    forward, backward = np.roll(corners, -1, axis=1) - corners, np.roll(corners, 1, axis=1) - corners
    across = np.linalg.norm(np.cross(forward, backward), axis=2)
    angle = np.arctan2(across, (forward * backward).sum(axis=2))
    positions = corners + OFF_CORNERS * (corners.mean(axis=1, keepdims=True) - corners)
    found = np.repeat(own, 3, axis=0)
    if normals is not None:
        smooth = normals[triangles].reshape(-1, 3)
        smooth = smooth / np.maximum(np.linalg.norm(smooth, axis=1, keepdims=True), 1e-300)
        found = np.where((smooth * found).sum(axis=1, keepdims=True) > 0, smooth, found)
    return Corners(triangles.ravel(), positions.reshape(-1, 3), found, angle.ravel())
