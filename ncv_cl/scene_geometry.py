"""Triangles from primitives and mesh files, in float64 world space.

Functions here know nothing of scene files: they raise `ValueError` with what is wrong, and the
scene reader adds where.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray
from trimesh.transformations import euler_matrix, rotation_matrix
from trimesh.visual.material import PBRMaterial, SimpleMaterial

Vectors = NDArray[np.float64]

# A published polygon need not be planar to the last digit (the Cornell box's red wall is 3 mm out
# of plane over 560 mm); more than this fraction of its diameter is taken for a mistake.
PLANARITY = 0.01
# Coordinates above this have squares and cross products that overflow single precision.
LARGEST_COORDINATE = 1e15
# Base reflectance of a dielectric in glTF's metallic-roughness model.
DIELECTRIC_REFLECTANCE = 0.04
SMALLEST_ROUGHNESS = 0.01


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles with optional shading normals.

    Attributes
    ----------
    vertices : float64 (n_vertices, 3)
    normals : float64 (n_vertices, 3)
        Unit length; all zero where the surface is flat.
    triangles : int64 (n_triangles, 3)
    """

    vertices: Vectors
    normals: Vectors
    triangles: NDArray[np.int64]


@dataclass(frozen=True)
class FileMaterial:
    """A material found in a mesh file, in the renderer's terms; colours are linear RGB."""

    name: str
    albedo: tuple[float, float, float]
    reflectance: tuple[float, float, float]
    roughness: float


@dataclass(frozen=True, eq=False)
class FileMesh:
    """One geometry of a mesh file, placed in the world, with its material if it has one."""

    mesh: Mesh
    material: FileMaterial | None


def flat_mesh(vertices: Vectors, triangles: object) -> Mesh:
    """A mesh that is shaded with its triangles' own normals."""
    vertices = np.asarray(vertices, dtype=np.float64)
    return Mesh(vertices, np.zeros_like(vertices), np.asarray(triangles, dtype=np.int64))


def quad_mesh(corner: Vectors, edge1: Vectors, edge2: Vectors) -> Mesh:
    """A parallelogram as two triangles whose winding gives the normal edge1 x edge2."""
    vertices = np.stack([corner, corner + edge1, corner + edge1 + edge2, corner + edge2])
    return flat_mesh(vertices, [[0, 1, 2], [0, 2, 3]])


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


def box_mesh(centre: Vectors, size: Vectors, rotation: Vectors) -> Mesh:
    """A box of full edge lengths `size`, turned about its centre by `rotation` (4, 4)."""
    box = trimesh.creation.box(extents=size)
    return flat_mesh(box.vertices @ rotation[:3, :3].T + centre, box.faces)


def sphere_mesh(centre: Vectors, radius: float, subdivisions: int) -> Mesh:
    """An icosphere of 20 * 4**subdivisions triangles with the sphere's own normals."""
    sphere = trimesh.creation.icosphere(subdivisions=subdivisions)
    normals = _normalised(np.asarray(sphere.vertices, dtype=np.float64))
    return Mesh(centre + radius * normals, normals, np.asarray(sphere.faces, dtype=np.int64))


def axis_angle(axis: Vectors, degrees: float) -> Vectors:
    """Right-handed rotation (4, 4) by `degrees` about `axis`, which must not be zero."""
    return np.asarray(rotation_matrix(np.radians(degrees), axis))


def euler_angles(degrees: Vectors) -> Vectors:
    """Rotation (4, 4) about the fixed x, then y, then z axis, by three angles in degrees."""
    return np.asarray(euler_matrix(*np.radians(degrees), axes="sxyz"))


def is_invertible(transform: Vectors) -> bool:
    """Whether an affine transform (4, 4) keeps three dimensions, whatever its scale."""
    singular = np.linalg.svd(transform[:3, :3], compute_uv=False)
    return bool(singular[2] > 1e-12 * singular[0])


def read_meshes(path: Path, transform: Vectors, smooth: bool | None) -> list[FileMesh]:
    """Read a mesh file through trimesh and place its geometries in the world.

    Parameters
    ----------
    path : Path
        OBJ, PLY, STL, glTF, GLB or another format that trimesh reads. Node transforms of scene
        formats are honoured; texture images are not.
    transform : float64 (4, 4)
        Affine map from the file's space to the world, for column vectors.
    smooth : bool or None
        False: flat. True: the file's vertex normals, or where it has none angle-weighted averages
        over the triangles that meet in a position. None: the file's normals if any, else flat.

    Returns
    -------
    list of FileMesh
        One for each placed geometry that has triangles.

    Raises
    ------
    ValueError
        If the file cannot be read, has no triangles, has a vertex that is not finite, a vertex
        index out of range or a singular transform.
    """
    if not path.is_file():
        raise ValueError("the mesh file does not exist")
    try:
        loaded = trimesh.load_scene(path, process=False)
    except Exception as error:  # trimesh's readers raise whatever their parsing ran into
        raise ValueError(f"cannot be read as a mesh: {error!r}") from error
    meshes = []
    for node in loaded.graph.nodes_geometry:
        node_transform, name = loaded.graph[node]
        geometry = loaded.geometry[name]
        if isinstance(geometry, trimesh.Trimesh) and len(geometry.faces):
            mesh = _world_mesh(geometry, transform @ node_transform, smooth)
            meshes.append(FileMesh(mesh, _file_material(geometry)))
    if not meshes:
        raise ValueError("the mesh is empty: it has no triangles")
    return meshes


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
    kept = Mesh(vertices[used], mesh.normals[used], triangles.reshape(-1, 3))
    return kept, int(np.count_nonzero(~keep))


def _world_mesh(geometry: trimesh.Trimesh, transform: Vectors, smooth: bool | None) -> Mesh:
    if not is_invertible(transform):
        raise ValueError("the transform of a node in the file is singular: it flattens the mesh")
    linear = transform[:3, :3]
    vertices = np.asarray(geometry.vertices, dtype=np.float64)
    triangles = np.asarray(geometry.faces, dtype=np.int64)
    if triangles.min() < 0 or triangles.max() >= len(vertices):
        raise ValueError(f"a triangle refers to a vertex that is not among the {len(vertices)}")
    bad = np.flatnonzero(~np.isfinite(vertices).all(axis=1))
    if bad.size:
        raise ValueError(f"vertex {bad[0]} of the mesh is not finite: {vertices[bad[0]]}")
    # trimesh keeps normals it read in its cache and has no public way to tell them from computed.
    file_normals = geometry._cache.cache.get("vertex_normals")
    vertices = vertices @ linear.T + transform[:3, 3]
    if np.linalg.det(linear) < 0.0:
        triangles = triangles[:, ::-1]
    normals = np.zeros_like(vertices)
    if smooth or (smooth is None and file_normals is not None):
        normals = _averaged_normals(vertices, triangles)
        if file_normals is not None:
            mapped = _normalised(np.asarray(file_normals) @ np.linalg.inv(linear))
            given = np.any(mapped, axis=1)
            normals[given] = mapped[given]
    return Mesh(vertices, normals, triangles)


def _averaged_normals(vertices: Vectors, triangles: NDArray[np.int64]) -> Vectors:
    """Angle-weighted vertex normals (Thürmer and Wüthrich 1998), shared by equal positions."""
    # Files split vertices along texture seams, STL at every triangle: join them by position.
    _, position = np.unique(vertices, axis=0, return_inverse=True)
    position = position.reshape(-1)[triangles]
    corners = vertices[triangles]
    forward = _normalised(np.roll(corners, -1, axis=1) - corners)
    backward = _normalised(np.roll(corners, 1, axis=1) - corners)
    cosine = np.clip(np.sum(forward * backward, axis=2), -1.0, 1.0)
    face_normals = _normalised(np.cross(forward[:, 0], backward[:, 0]))
    weighted = np.arccos(cosine)[:, :, None] * face_normals[:, None, :]
    sums = np.zeros_like(vertices)
    np.add.at(sums, position.ravel(), weighted.reshape(-1, 3))
    normals = np.zeros_like(vertices)
    normals[triangles] = _normalised(sums)[position]
    return normals


def _file_material(geometry: trimesh.Trimesh) -> FileMaterial | None:
    """What a file says about a surface, or None; textures are not read, only their factors."""
    material = getattr(geometry.visual, "material", None)
    if isinstance(material, PBRMaterial):
        base = (1.0, 1.0, 1.0)
        if material.baseColorFactor is not None:
            base = tuple(float(c) / 255.0 for c in material.baseColorFactor[:3])
        # glTF's own defaults where a factor is absent.
        metallic = 1.0 if material.metallicFactor is None else float(material.metallicFactor)
        roughness = 1.0 if material.roughnessFactor is None else float(material.roughnessFactor)
        metallic = min(max(metallic, 0.0), 1.0)
        albedo = [c * (1.0 - metallic) for c in base]
        reflectance = [DIELECTRIC_REFLECTANCE * (1.0 - metallic) + c * metallic for c in base]
    elif isinstance(material, SimpleMaterial) and "kd" in material.kwargs:
        # The MTL's own numbers; trimesh's colours are rounded to 8 bits.
        albedo = _rgb(material.kwargs["kd"])
        reflectance = _rgb(material.kwargs.get("ks", 0.0))
        # Blinn-Phong exponent to GGX: alpha = sqrt(2 / (Ns + 2)), roughness = sqrt(alpha).
        exponent = max(float(material.kwargs.get("ns", 0.0)), 0.0)
        roughness = (2.0 / (exponent + 2.0)) ** 0.25
    else:
        return None
    return FileMaterial(
        name=str(material.name),
        albedo=_clamped(albedo),
        reflectance=_clamped(reflectance),
        roughness=min(max(roughness, SMALLEST_ROUGHNESS), 1.0),
    )


def _rgb(value: object) -> list[float]:
    """An MTL colour: one number stands for three."""
    return [float(c) for c in np.resize(np.asarray(value, dtype=np.float64), 3)]


def _clamped(colour: list[float]) -> tuple[float, float, float]:
    red, green, blue = np.clip(np.nan_to_num(colour), 0.0, 1.0).tolist()
    return red, green, blue


def _normalised(vectors: Vectors) -> Vectors:
    """Unit vectors along the last axis; zero where a vector is zero or not finite."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    usable = np.isfinite(length) & (length > 0.0)
    return np.where(usable, vectors, 0.0) / np.where(usable, length, 1.0)
