"""Wavefront OBJ: polygons with materials from MTL files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from ...host.reach import Reach
from ..textures.image_file import ImageFiles
from ..textures.texture import linear_from_srgb
from .common import (
    Asked,
    FileGeometry,
    FileMaterial,
    Indices,
    Notes,
    Vectors,
    constant_or_varying,
    three,
)
from .files import find_file, read_text
from .mtl import MaterialReader, read_library
from .obj_text import Statements, check_finite, references_of, resolve, scan, table
from .polygons import triangulate


def read_obj(path: Path, notes: Notes, asked: Asked) -> list[FileGeometry]:
    """Read an OBJ file; every material it uses gives one geometry, or two if only some have normals.

    Raises
    ------
    ValueError
        If the file cannot be read, a number or an index is wrong or a statement would add surfaces
        that are not read; names the line.
    """
    statements = scan(read_text(path), notes)
    positions, colours = _positions(statements, notes)
    normals, _ = table(statements.normals, statements.normal_lines, "vn", (3,))
    references, counts = references_of(statements)
    names, of_face = _material_of_face(statements, len(counts))
    used = [names[i] for i in np.unique(of_face[counts >= 3])]
    materials = _read_materials(path, statements, used, notes, asked.images)
    textured = asked.coordinates or any(one is not None and one.maps for one in materials.values())
    coordinates = _coordinates(statements) if textured else None
    n_coordinates = None if coordinates is None else len(coordinates)
    resolve(references, counts, statements, len(positions), len(normals), n_coordinates)
    check_finite(positions, references[:, 0], statements)
    triangles, owner, crossing = triangulate(positions, references[:, 0], counts)
    for kind, faces in (
        ("faces with less than three corners are left out", np.flatnonzero(counts < 3)),
        ("faces that cross themselves or are far from flat, whose triangles are a guess", crossing),
    ):
        if faces.size:
            first = f"the first in line {statements.face_lines[faces[0]]}"
            notes.shape(kind, first, len(faces))
    corners = references[triangles]
    has_normals = (corners[:, :, 2] >= 0).any(axis=1)
    notes.smoothing = statements.smoothing and not has_normals.all()
    group = 2 * of_face[owner] + has_normals
    order = np.argsort(group, kind="stable")
    groups, firsts = np.unique(group[order], return_index=True)
    geometries: list[FileGeometry] = []
    if not len(groups):
        return geometries
    for g, picked in zip(groups, np.split(order, firsts[1:]), strict=True):
        material = materials[names[g // 2]]
        needed = asked.coordinates or (material is not None and material.maps is not None)
        given = coordinates if needed else None, normals if g % 2 else None
        at, geometry = _geometry(corners[picked], positions, *given)
        geometry = replace(geometry, material=material)
        if colours is not None:
            geometry = _coloured(geometry, colours[at], path.name, notes)
        geometries.append(geometry)
    return geometries


def _geometry(
    corners: Indices, positions: Vectors, coordinates: Vectors | None, normals: Vectors | None
) -> tuple[Indices, FileGeometry]:
    """The geometry of corners (n, 3, 3), indices of v, vt and vn, and the v of each of its vertices."""
    corners = corners.copy()
    for column, values in ((1, coordinates), (2, normals)):
        if values is None:
            corners[:, :, column] = -1
    at, local = _vertices(corners)
    uv = None
    if coordinates is not None and (at[:, 1] >= 0).any():
        uv = _rows(coordinates, at[:, 1])
    own = None if normals is None else np.nan_to_num(_rows(normals, at[:, 2]))
    return at[:, 0], FileGeometry(positions[at[:, 0]], local, own, uv=uv)


def _positions(statements: Statements, notes: Notes) -> tuple[Vectors, Vectors | None]:
    """Positions (n, 3), and linear colours (n, 3) if all vertices have one."""
    rows = statements.positions
    values, lengths = table(rows, statements.position_lines, "v", (3, 4, 6, 7))
    weighted = (lengths == 4) & (values[:, 3] != 1.0)
    if weighted.any():
        notes.shape("weights w of vertices are left out", "", int(weighted.sum()))
    if not rows or lengths.min() < 6:
        if np.any(lengths >= 6):
            notes.look(
                "colours that only some vertices have are left out", "", int((lengths >= 6).sum())
            )
        return values[:, :3], None
    colours = np.clip(np.nan_to_num(values[:, 3:6]), 0.0, None)
    # Some writers count to 255.
    colours = colours / 255.0 if colours.max() > 1.0 else colours
    return values[:, :3], linear_from_srgb(np.minimum(colours, 1.0))


def _material_of_face(statements: Statements, n_faces: int) -> tuple[list[str], Indices]:
    """The names that usemtl gave, with an empty one for none, and each face's index into them."""
    names = [""]
    index = {"": 0}
    firsts, chosen = [0], [0]
    for first, name in statements.materials:
        if name not in index:
            index[name] = len(names)
            names.append(name)
        firsts.append(first)
        chosen.append(index[name])
    lengths = np.diff([*firsts, n_faces])
    return names, np.repeat(np.array(chosen, dtype=np.int64), lengths)


def _read_materials(
    path: Path, statements: Statements, used: list[str], notes: Notes, images: ImageFiles
) -> dict[str, FileMaterial | None]:
    """The materials that faces use, by name; None where the file gives none."""
    library: dict[str, tuple[dict[str, str], Path]] = {}
    for line in statements.libraries:
        for file in _library_files(path.parent, line, notes, images.reach):
            for name, keys in read_library(file, notes).items():
                library.setdefault(name, (keys, file.parent))
    found: dict[str, FileMaterial | None] = {}
    for name in used:
        known = name
        while known not in library and "#" in known:
            # Names may hold a # themselves; behind one that is not known it starts a comment.
            known = known.rpartition("#")[0].strip()
        if known in library:
            keys, folder = library[known]
            found[name] = MaterialReader(known, keys, folder, notes, images).material()
        else:
            found[name] = None
            if name:
                notes.look("materials that no library of the file has", name)
    return found


def _library_files(folder: Path, line: str, notes: Notes, reach: Reach) -> list[Path]:
    """The files that one mtllib statement names: blanks separate names, and may be in them."""
    words = line.split()
    files = []
    start = 0
    while start < len(words):
        for end in range(len(words), start, -1):
            file = find_file(folder, " ".join(words[start:end]), reach)
            if file is not None:
                files.append(file)
                start = end
                break
        else:
            if words[start].startswith("#"):
                break
            notes.look("material libraries that do not exist", words[start])
            start += 1
    return files


def _vertices(corners: Indices) -> tuple[Indices, Indices]:
    """Corners (n, 3, 3) of triangles, indices of v, vt and vn, as vertices that differ in one of these.

    Returns
    -------
    vertices : int64 (n_vertices, 3)
    triangles : int64 (n, 3)
    """
    rows = corners.reshape(-1, 3)
    place = rows[:, 0]
    for column in (1, 2):
        # Of the rows so far, those that are alike; -1 stands for none.
        width = int(rows[:, column].max()) + 2
        if width > 1:
            _, place = np.unique(place * width + rows[:, column] + 1, return_inverse=True)
    _, first, local = np.unique(place, return_index=True, return_inverse=True)
    return rows[first], local.reshape(-1, 3)


def _rows(values: Vectors, index: Indices) -> Vectors:
    """Rows of an array, zero where an index is -1."""
    return np.concatenate([values, np.zeros((1, values.shape[1]))])[index]


def _coordinates(statements: Statements) -> Vectors:
    """Texture coordinates (n, 2); v is 0 where a file has none."""
    values, _ = table(statements.coordinates, statements.coordinate_lines, "vt", (1, 2, 3))
    return np.nan_to_num(values[:, :2])


def _coloured(geometry: FileGeometry, colours: Vectors, name: str, notes: Notes) -> FileGeometry:
    """Put in colours of vertices, which are the albedo of a surface without a material."""
    if geometry.material is not None:
        notes.look("colours of vertices are left out beside a material", geometry.material.name)
        return geometry
    albedo, rows = constant_or_varying(colours, geometry.triangles)
    material = FileMaterial(name, albedo or three(1.0), three(0.0), 1.0)
    return replace(geometry, material=material, colours=rows)
