"""Shading normals that textures bend."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..geometry import normalised
from ..model import Scene


def tangents(scene: Scene, triangle: NDArray) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Unit vectors (n, 3) along which u grows on triangles, and 1 or -1 (n,), the side on which v grows.

    With the normal n of a triangle's winding and the tangent t, v grows along +-(n x t). The vectors are
    zero where a triangle's coordinates lie on a line.
    """
    corners = scene.vertices[scene.triangles[triangle]].astype(np.float64)
    uv = scene.coordinates[scene.triangles[triangle]].astype(np.float64)
    (edge1, edge2), (first, second) = (
        (rows[:, 1] - rows[:, 0], rows[:, 2] - rows[:, 0]) for rows in (corners, uv)
    )
    area = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    side = np.where(area < 0.0, -1.0, 1.0)
    along_u = second[:, 1:] * edge1 - first[:, 1:] * edge2
    return normalised(along_u * np.sign(area)[:, None]), side


def bent(
    scene: Scene, triangle: NDArray, texel: NDArray, scale: float, normal: NDArray, outgoing: NDArray
) -> NDArray[np.float64]:
    """Shading normals that a texture bends, where the viewer would still be above the surface.

    A surface is bent as seen from its triangles' front: seen from behind, hills are dents.

    Parameters
    ----------
    triangle : integers (n,)
    texel : floats (n, 3)
        Of the texture `Maps.normal`, in [0, 1].
    scale : float
    normal, outgoing : floats (n, 3)
        Shading normals on the viewer's side, and directions towards the viewer.

    Returns
    -------
    ndarray
        float64 (n, 3), on the viewer's side.
    """
    corners = scene.vertices[scene.triangles[triangle]].astype(np.float64)
    front = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    facing = np.where(np.sum(front * outgoing, axis=1) < 0.0, -1.0, 1.0)[:, None]
    own = normal * facing
    tangent, side = tangents(scene, triangle)
    tangent = normalised(tangent - np.sum(tangent * own, axis=1, keepdims=True) * own)
    bitangent = np.cross(own, tangent) * side[:, None]
    x, y, z = (2.0 * texel - 1.0).T[:, :, None]
    found = facing * normalised(scale * (x * tangent + y * bitangent) + z * own)
    usable = tangent.any(axis=1) & (np.sum(found * outgoing, axis=1) > 0.0)
    return np.where(usable[:, None], found, normal)
