"""Triangles from primitives, in float64 world space, and what all meshes need.

Functions here know nothing of scene files: they raise `ValueError` with what is wrong, and the
scene reader adds where.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import trimesh
from numpy.typing import NDArray
from trimesh.transformations import euler_matrix, rotation_matrix

Vectors = NDArray[np.float64]

# A published polygon need not be planar to the last digit (the Cornell box's red wall is 3 mm out of
# plane over 560 mm); more than this fraction of its diameter is an error.
PLANARITY = 0.01
# Coordinates above this have squares and cross products that overflow single precision.
LARGEST_COORDINATE = 1e15
SMALLEST_ROUGHNESS = 0.01
# Rightwards and upwards along each side of a box as it is seen from outside.
_BOX_SIDES = np.array(
    [
        [[0, 0, -1], [0, 1, 0]], [[0, 0, 1], [0, 1, 0]], [[1, 0, 0], [0, 1, 0]],
        [[-1, 0, 0], [0, 1, 0]], [[1, 0, 0], [0, 0, -1]], [[1, 0, 0], [0, 0, 1]],
    ],
    dtype=np.float64,
)  # fmt: skip
# Texture coordinates of a parallelogram: u along its first edge, v along its second.
UNIT_SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles, and what is interpolated between their corners.

    Attributes
    ----------
    vertices : float64 (n_vertices, 3)
    normals : float64 (n_vertices, 3)
        Unit length; all zero where the surface is flat.
    triangles : int64 (n_triangles, 3)
    uv : float64 (n_vertices, 2), optional
        Texture coordinates, see texture.py.
    colours : float64 (n_vertices, 3), optional
        Linear RGB in [0, 1] that multiplies the material's albedo.
    """

    vertices: Vectors
    normals: Vectors
    triangles: NDArray[np.int64]
    uv: Vectors | None = None
    colours: Vectors | None = None

    def with_rows(self, change: Callable[[Vectors], Vectors], triangles: NDArray[np.int64]) -> Mesh:
        """A mesh of other `triangles` whose vertices, and all they carry, are changed alike."""
        uv, colours = (None if rows is None else change(rows) for rows in (self.uv, self.colours))
        return Mesh(change(self.vertices), change(self.normals), triangles, uv, colours)


def flat_mesh(vertices: Vectors, triangles: object) -> Mesh:
    """A mesh that is shaded with its triangles' own normals."""
    vertices = np.asarray(vertices, dtype=np.float64)
    return Mesh(vertices, np.zeros_like(vertices), np.asarray(triangles, dtype=np.int64))


def quad_mesh(
    corner: NDArray[np.floating], edge1: NDArray[np.floating], edge2: NDArray[np.floating]
) -> Mesh:
    """A parallelogram as two triangles whose winding gives the normal edge1 x edge2."""
    vertices = np.stack([corner, corner + edge1, corner + edge1 + edge2, corner + edge2])
    return replace(flat_mesh(vertices, [[0, 1, 2], [0, 2, 3]]), uv=UNIT_SQUARE)


def polygon_mesh(vertices: Vectors) -> Mesh:
    """A convex, nearly planar polygon as a fan of triangles around its first vertex.

    Parameters
    ----------
    vertices : float64 (n, 3)
        In order around the polygon, n >= 3.

    Raises
    ------
    ValueError
        If the polygon has no area, is further from planar than `PLANARITY` times its diameter,
        or is not convex.
    """
    centre = vertices.mean(axis=0)
    diameter = 2.0 * np.linalg.norm(vertices - centre, axis=1).max()
    following = np.roll(vertices, -1, axis=0)
    # Newell's normal: the sum is twice the vector area, whatever the origin.
    normal = np.cross(vertices - centre, following - centre).sum(axis=0)
    length = np.linalg.norm(normal)
    if length <= 1e-12 * diameter**2:
        raise ValueError("the polygon has no area")
    normal /= length
    if np.abs((vertices - centre) @ normal).max() > PLANARITY * diameter:
        raise ValueError("the polygon is not planar; split it into triangles")
    fan = np.array([[0, i, i + 1] for i in range(1, len(vertices) - 1)])
    corners = np.roll(vertices, 1, axis=0), vertices, following
    for first, second, third in (corners, np.moveaxis(vertices[fan], 1, 0)):
        if (np.cross(second - first, third - second) @ normal).min() < -1e-9 * diameter**2:
            raise ValueError("the polygon is not convex; split it into convex parts")
    return flat_mesh(vertices, fan)


def box_mesh(centre: Vectors, size: Vectors, rotation: Vectors, textured: bool = False) -> Mesh:
    """A box of full edge lengths `size`, turned about its centre by `rotation` (4, 4).

    Where it is `textured` each side is a unit square of texture coordinates, upright as seen from
    outside.
    """
    if not textured:
        box = trimesh.creation.box(extents=size)
        return flat_mesh(box.vertices @ rotation[:3, :3].T + centre, box.faces)
    sides = [quad_mesh(-0.5 * (right + up - np.cross(right, up)), right, up) for right, up in _BOX_SIDES]
    vertices = np.concatenate([side.vertices for side in sides]) * size
    triangles = np.concatenate([side.triangles + 4 * i for i, side in enumerate(sides)])
    mesh = flat_mesh(vertices @ rotation[:3, :3].T + centre, triangles)
    return replace(mesh, uv=np.tile(UNIT_SQUARE, (6, 1)))


def sphere_mesh(centre: Vectors, radius: float, subdivisions: int, textured: bool = False) -> Mesh:
    """An icosphere of 20 * 4**subdivisions triangles with the sphere's own normals.

    Where it is `textured`, u goes with the longitude about y, from z over x, and v with the latitude.
    """
    sphere = trimesh.creation.icosphere(subdivisions=subdivisions)
    normals = normalised(np.asarray(sphere.vertices, dtype=np.float64))
    triangles = np.asarray(sphere.faces, dtype=np.int64)
    mesh = Mesh(centre + radius * normals, normals, triangles)
    if not textured:
        return mesh
    corners = normals[triangles]
    longitude = np.arctan2(corners[..., 0], corners[..., 2]) / (2.0 * np.pi)
    at_pole = np.abs(corners[..., 1]) > 1.0 - 1e-9
    # Over the seam a triangle reaches beyond 1; a pole is where its triangle's other corners are.
    known = np.where(at_pole, np.nan, longitude)
    longitude = known + ((known < 0.0) & (np.nanmax(known, axis=1, keepdims=True) - known > 0.5))
    longitude = np.where(at_pole, np.nanmean(longitude, axis=1, keepdims=True), longitude)
    latitude = np.arcsin(np.clip(corners[..., 1], -1.0, 1.0)) / np.pi + 0.5
    rows = triangles.reshape(-1)
    split = mesh.with_rows(lambda values: values[rows], np.arange(len(rows)).reshape(-1, 3))
    return replace(split, uv=np.stack([longitude + 0.5, latitude], axis=2).reshape(-1, 2))


def axis_angle(axis: Vectors, degrees: float) -> Vectors:
    """Right-handed rotation (4, 4) by `degrees` about `axis`, which must not be zero."""
    return np.asarray(rotation_matrix(np.radians(degrees), axis))


def euler_angles(degrees: Vectors) -> Vectors:
    """Rotation (4, 4) about the fixed x, then y, then z axis, by three angles in degrees."""
    about_x, about_y, about_z = np.radians(degrees)
    return np.asarray(euler_matrix(about_x, about_y, about_z, axes="sxyz"))


def is_invertible(transform: Vectors) -> bool:
    """Whether an affine transform (4, 4) keeps three dimensions, whatever its scale."""
    singular = np.linalg.svd(transform[:3, :3], compute_uv=False)
    return bool(singular[2] > 1e-12 * singular[0])


def drop_degenerate(mesh: Mesh) -> tuple[Mesh, int]:
    """Round to single precision; drop triangles without area and vertices without triangle.

    A triangle has no area when its height over the longest edge is below the resolution that
    float32 has at its coordinates: a test that scale and offset of the scene do not change.

    Returns
    -------
    mesh : Mesh
        Its vertices are representable in float32.
    dropped : int
        Number of triangles dropped.

    Raises
    ------
    ValueError
        If a coordinate is beyond `LARGEST_COORDINATE`.
    """
    if not np.abs(mesh.vertices).max() <= LARGEST_COORDINATE:
        raise ValueError(f"a coordinate is beyond {LARGEST_COORDINATE:g}, too large for float32")
    vertices = mesh.vertices.astype(np.float32).astype(np.float64)
    corners = vertices[mesh.triangles]
    edges = np.roll(corners, -1, axis=1) - corners
    longest = np.linalg.norm(edges, axis=2).max(axis=1)
    twice_area = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    resolution = 2.0 * np.finfo(np.float32).eps * np.abs(corners).max(axis=(1, 2))
    keep = twice_area > resolution * longest
    used, triangles = np.unique(mesh.triangles[keep], return_inverse=True)
    mesh = replace(mesh, vertices=vertices)
    kept = mesh.with_rows(lambda rows: rows[used], triangles.reshape(-1, 3))
    return kept, int(np.count_nonzero(~keep))


def averaged_normals(vertices: Vectors, triangles: NDArray[np.int64]) -> Vectors:
    """Angle-weighted vertex normals (Thürmer and Wüthrich 1998), shared by equal positions."""
    # Files split vertices along texture seams, STL at every triangle: join them by position.
    _, position = np.unique(vertices, axis=0, return_inverse=True)
    position = position.reshape(-1)[triangles]
    corners = vertices[triangles]
    forward = normalised(np.roll(corners, -1, axis=1) - corners)
    backward = normalised(np.roll(corners, 1, axis=1) - corners)
    cosine = np.clip(np.sum(forward * backward, axis=2), -1.0, 1.0)
    face_normals = normalised(np.cross(forward[:, 0], backward[:, 0]))
    weighted = np.arccos(cosine)[:, :, None] * face_normals[:, None, :]
    sums = np.zeros_like(vertices)
    np.add.at(sums, position.ravel(), weighted.reshape(-1, 3))
    normals = np.zeros_like(vertices)
    normals[triangles] = normalised(sums)[position]
    return normals


def normalised(vectors: Vectors) -> Vectors:
    """Unit vectors along the last axis; zero where a vector is zero or not finite."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    usable = np.isfinite(length) & (length > 0.0)
    return np.where(usable, vectors, 0.0) / np.where(usable, length, 1.0)
