"""Meshes with a place on a map for every vertex, checked, or read from a file."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from .geometry import Mesh, normalised
from .meshes import read_meshes


class BakeError(ValueError):
    """A mesh cannot be baked as it is; the message names array and index."""


@dataclass(frozen=True, eq=False)
class UVMesh:
    """Triangles with a place on a map for every vertex.

    Attributes
    ----------
    vertices : array (n, 3)
        World positions.
    triangles : array of integers (m, 3)
        Rows of `vertices`, counter-clockwise as seen from the side that is baked.
    uv : array (n, 2)
        In [0, 1]; v goes up, so the map's first row has v about 1.
    normals : array (n, 3), optional
        Shading normals of any length, to be interpolated; by default the triangles' own.
    """

    vertices: np.ndarray
    triangles: np.ndarray
    uv: np.ndarray
    normals: np.ndarray | None = None


class Triangles(Protocol):
    """What `checked_triangles` asks of a mesh; it may have `normals` as well."""

    @property
    def vertices(self) -> ArrayLike: ...

    @property
    def triangles(self) -> ArrayLike: ...


class TrianglesOnMap(Triangles, Protocol):
    """What `checked_mesh` asks of one, as `UVMesh` is."""

    @property
    def uv(self) -> ArrayLike: ...


def read_uv_mesh(path: str | Path) -> UVMesh:
    """The mesh of a file of any kind that scenes read, shaded as scenes shade it; its parts are joined.

    Raises
    ------
    BakeError
        If the file cannot be read or a part of it has no UVs.
    """
    try:
        parts = [part.mesh for part in read_meshes(Path(path), np.eye(4), None, coordinates=True).meshes]
    except ValueError as error:
        raise BakeError(f"{path}: {error}") from error
    if any(part.uv is None for part in parts):
        raise BakeError(f"{path}: has no UVs: unwrap the mesh, as Blender and ncv.unwrap do")
    if any(part.normals.any() for part in parts):
        parts = [part if part.normals.any() else _with_own_normals(part) for part in parts]
    firsts = np.cumsum([0] + [len(part.vertices) for part in parts[:-1]])
    vertices, normals, uv = (
        np.concatenate([getattr(part, name) for part in parts]) for name in ("vertices", "normals", "uv")
    )
    triangles = [part.triangles + first for part, first in zip(parts, firsts, strict=True)]
    return UVMesh(vertices, np.concatenate(triangles), uv, normals if normals.any() else None)


def _with_own_normals(mesh: Mesh) -> Mesh:
    """A flat mesh as one whose triangles share no vertex and whose normals are the triangles'."""
    corners = mesh.triangles.ravel()
    a, b, c = np.moveaxis(mesh.vertices[mesh.triangles], 1, 0)
    normals = np.repeat(normalised(np.cross(b - a, c - a)), 3, axis=0)
    apart = mesh.with_rows(lambda rows: rows[corners], np.arange(len(corners)).reshape(-1, 3))
    return replace(apart, normals=normals)


def checked_triangles(mesh: Triangles) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Vertices, triangles and normals, if there are some, of a mesh.

    Raises
    ------
    BakeError
    """
    vertices = _numbers("vertices", mesh.vertices, 3)
    triangles = np.asarray(mesh.triangles)
    if triangles.dtype.kind not in "iu" or triangles.ndim != 2 or triangles.shape[1] != 3:
        shape = f"{triangles.dtype} {triangles.shape}"
        raise BakeError(f"triangles: expected whole numbers (m, 3), got {shape}")
    outside = np.flatnonzero(((triangles < 0) | (triangles >= len(vertices))).any(axis=1))
    if len(outside):
        raise BakeError(f"triangles[{outside[0]}] refers to vertices that there are not")
    normals = getattr(mesh, "normals", None)
    if normals is not None:
        normals = _numbers("normals", normals, 3, len(vertices))
    return vertices, triangles.astype(np.int64), normals


def checked_mesh(mesh: TrianglesOnMap) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray | None]:
    """Vertices, triangles, UVs and normals of a `UVMesh` or of what has its attributes.

    Raises
    ------
    BakeError
    """
    if getattr(mesh, "uv", None) is None:
        raise BakeError("the mesh has no uv: give a UVMesh, with a place on the map for each vertex")
    vertices, triangles, normals = checked_triangles(mesh)
    return vertices, triangles, _numbers("uv", mesh.uv, 2, len(vertices)), normals


def _numbers(name: str, values: object, width: int, rows: int | None = None) -> np.ndarray:
    found = np.asarray(values)
    if found.dtype.kind not in "fiu" or found.ndim != 2 or found.shape[1] != width:
        raise BakeError(f"{name}: expected numbers (n, {width}), got {found.dtype} {found.shape}")
    if rows is not None and len(found) != rows:
        raise BakeError(f"{name}: must be as many as vertices, {rows}, are {len(found)}")
    broken = np.flatnonzero(~np.isfinite(found).all(axis=1))
    if len(broken):
        raise BakeError(f"{name}[{broken[0]}]: {found[broken[0]].tolist()} is not finite")
    return found.astype(np.float64)
