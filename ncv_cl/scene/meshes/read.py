"""A mesh file of any kind, read and placed in the world."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..geometry import (
    SMALLEST_ROUGHNESS,
    Mesh,
    averaged_normals,
    is_invertible,
    normalised,
)
from ..textures.image_file import ImageFiles
from .common import Asked, Colour, FileGeometry, FileMaterial, Notes, Vectors, sentences, three
from .gltf import read_gltf
from .gltf_lights import placed
from .obj import read_obj
from .ply import read_ply
from .stl import read_stl
from .textures import without_textures

_READERS: dict[str, Callable[[Path, Notes, Asked], list[FileGeometry]]] = {
    ".obj": read_obj,
    ".ply": read_ply,
    ".stl": read_stl,
    ".gltf": read_gltf,
    ".glb": read_gltf,
}
# Instances multiply what a small file holds; so many fill some gigabytes.
MOST_TRIANGLES = 1 << 26
# Suffixes of the files that are read.
KINDS = tuple(_READERS)
# What is said of materials that emit.
EMITS = "materials that emit, which light the scene"


@dataclass(frozen=True, eq=False)
class FileMesh:
    """Triangles of one material of a mesh file, placed in the world."""

    mesh: Mesh
    material: FileMaterial | None


@dataclass(frozen=True, eq=False)
class FileMeshes:
    """What a mesh file holds.

    Attributes
    ----------
    meshes : list of FileMesh
    shape_notes : list of str
        What was left out of the geometry or replaced, one sentence a kind.
    notes : list of str
        The same, and what was left out of the file's materials.
    lights : list of dict
        The file's punctual lights, as tables of a scene's ``lights``, placed in the world.
    """

    meshes: list[FileMesh]
    shape_notes: list[str]
    notes: list[str]
    lights: list[dict[str, Any]]


def read_meshes(
    path: Path,
    transform: Vectors,
    smooth: bool | None,
    images: ImageFiles | None = None,
    coordinates: bool = False,
) -> FileMeshes:
    """Read a mesh file and place its geometries in the world.

    Parameters
    ----------
    path : Path
        OBJ, PLY, STL, glTF or GLB. Transforms of nodes in the file are honoured.
    transform : float64 (4, 4)
        Affine map from the file's space to the world, for column vectors.
    smooth : bool or None
        False: flat. True: the file's vertex normals, or where it has none angle-weighted averages
        over the triangles that meet in a position. None: the file's normals if any, else flat.
    images, coordinates
        As in `Asked`.

    Returns
    -------
    FileMeshes

    Raises
    ------
    ValueError
        If the file is of another kind, cannot be read, has no triangles, a wrong index, a vertex in
        use that is not finite or nothing but singular transforms. Says where in the file.
    """
    if not path.is_file():
        raise ValueError("the mesh file does not exist")
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        kinds = ", ".join(_READERS)
        raise ValueError(f"cannot be read as a mesh: {path.suffix or 'its kind'} is none of {kinds}")
    notes = Notes()
    try:
        geometries = reader(path, notes, Asked(images or ImageFiles(), coordinates))
    except OSError as error:
        raise ValueError(f"cannot be read: {error.strerror or error}") from error
    except MemoryError as error:
        raise ValueError("cannot be read: it announces more than fits in memory") from error
    except RecursionError as error:
        raise ValueError("cannot be read: it is nested too deeply") from error
    except (KeyError, TypeError, AttributeError, IndexError, ArithmeticError) as error:
        # Errors of a file that lacks a part, or has one of another type than its format says.
        raise ValueError(f"cannot be read, for it is malformed: {error!r}") from error
    geometries = [geometry for geometry in geometries if len(geometry.triangles)]
    if not geometries:
        left_out = "; ".join(sentences(notes.geometry))
        raise ValueError(f"the mesh is empty: it has no triangles{left_out and f' ({left_out})'}")
    count = sum(len(geometry.triangles) for geometry in geometries)
    if count > MOST_TRIANGLES:
        raise ValueError(f"has {count:,} triangles with its instances; {MOST_TRIANGLES:,} are read")
    meshes = _placed(geometries, transform, smooth, notes)
    if notes.smoothing and smooth is None:
        notes.shape("smoothing groups are not read, and faces without normals are flat", "smooth = true")
    shape = sentences(notes.geometry)
    lights = [placed(light, transform) for light in notes.lights]
    return FileMeshes(meshes, shape, shape + sentences(notes.looks), lights)


def _placed(
    geometries: list[FileGeometry], transform: Vectors, smooth: bool | None, notes: Notes
) -> list[FileMesh]:
    materials: dict[FileMaterial | None, FileMaterial | None] = {None: None}
    # What one node holds is one surface, whatever its materials: normals are averaged over all of it.
    nodes: dict[bytes, list[int]] = {}
    meshes: list[FileMesh] = []
    for geometry in geometries:
        own = geometry.material
        if own is not None and own not in materials:
            materials[own] = _usable(own, notes)
        material = materials[own]
        if material is not None and material.maps is not None and geometry.uv is None:
            material = without_textures(material, notes)
        whole = transform @ geometry.transform
        if is_invertible(whole):
            if smooth or (smooth is None and geometry.normals is not None):
                nodes.setdefault(whole.tobytes(), []).append(len(meshes))
            mesh = _world_mesh(geometry, whole, smooth)
            meshes.append(FileMesh(mesh, material))
        else:
            notes.shape("meshes that their node flattens are left out", geometry.name)
    if not meshes:
        raise ValueError("the transform of a node in the file is singular: it flattens the mesh")
    for members in nodes.values():
        _fill_in_normals([meshes[i].mesh for i in members])
    return meshes


def _world_mesh(geometry: FileGeometry, transform: Vectors, smooth: bool | None) -> Mesh:
    """A geometry with the file's normals, zero where it has none."""
    linear = transform[:3, :3]
    vertices = geometry.vertices @ linear.T + transform[:3, 3]
    triangles = geometry.triangles
    if not np.isfinite(vertices).all():
        # Readers have checked the vertices in use.
        vertices = np.where(np.isfinite(vertices), vertices, 0.0)
    if np.linalg.det(linear) < 0.0:
        triangles = triangles[:, ::-1]
    normals = np.zeros_like(vertices)
    if geometry.normals is not None and smooth is not False:
        normals = normalised(geometry.normals @ np.linalg.inv(linear))
    return Mesh(vertices, normals, triangles, geometry.uv, geometry.colours)


def _fill_in_normals(meshes: list[Mesh]) -> None:
    """Give vertices without a normal, in place, the average over the triangles of all meshes there."""
    missing = [~np.any(mesh.normals, axis=1) for mesh in meshes]
    if not any(rows.any() for rows in missing):
        return
    firsts = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes])
    triangles = [mesh.triangles + first for mesh, first in zip(meshes, firsts[:-1], strict=True)]
    vertices = np.concatenate([mesh.vertices for mesh in meshes])
    averages = averaged_normals(vertices, np.concatenate(triangles))
    for mesh, rows, own in zip(meshes, missing, np.split(averages, firsts[1:-1]), strict=True):
        mesh.normals[rows] = own[rows]


def _usable(material: FileMaterial, notes: Notes) -> FileMaterial:
    """A material within the renderer's limits; notes what had to be changed."""
    colours = (material.albedo, material.reflectance, material.transmission)
    clamped = tuple(_clamped(colour, 1.0) for colour in colours)
    emission = _clamped(material.emission, np.inf)
    if clamped != colours or emission != material.emission:
        notes.look("materials with colours outside [0, 1], which are clamped", material.name)
    if any(emission):
        notes.look(EMITS, material.name)
    roughness = min(max(float(np.nan_to_num(material.roughness)), SMALLEST_ROUGHNESS), 1.0)
    albedo, reflectance, transmission = clamped
    return replace(
        material,
        albedo=albedo,
        reflectance=reflectance,
        transmission=transmission,
        roughness=roughness,
        emission=emission,
    )


def _clamped(colour: Colour, most: float) -> Colour:
    return three(np.clip(np.nan_to_num(colour), 0.0, most))
