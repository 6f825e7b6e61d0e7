"""Wavefront OBJ: polygons with materials from MTL files."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from .common import (
    FileGeometry,
    FileMaterial,
    Indices,
    Notes,
    Vectors,
    linear_from_srgb,
    mean_over_area,
    three,
)
from .files import find_file, read_text
from .mtl import MaterialReader, read_library
from .obj_text import Statements, check_finite, references_of, resolve, scan, table
from .polygons import triangulate


def read_obj(path: Path, notes: Notes) -> list[FileGeometry]:
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
    resolve(references, counts, statements, len(positions), len(normals))
    check_finite(positions, references[:, 0], statements)
    triangles, owner, crossing = triangulate(positions, references[:, 0], counts)
    for kind, faces in (
        ("faces with less than three corners are left out", np.flatnonzero(counts < 3)),
        ("faces that cross themselves or are far from flat, whose triangles are a guess", crossing),
    ):
        if faces.size:
            first = f"the first in line {statements.face_lines[faces[0]]}"
            notes.shape(kind, first, len(faces))
    corners = references[triangles][:, :, [0, 2]]
    has_normals = (corners[:, :, 1] >= 0).any(axis=1)
    notes.smoothing = statements.smoothing and not has_normals.all()
    names, of_face = _material_of_face(statements, len(counts))
    group = 2 * of_face[owner] + has_normals
    materials = _read_materials(path, statements, [names[i] for i in np.unique(of_face[owner])], notes)
    order = np.argsort(group, kind="stable")
    groups, firsts = np.unique(group[order], return_index=True)
    geometries: list[FileGeometry] = []
    if not len(groups):
        return geometries
    for g, picked in zip(groups, np.split(order, firsts[1:]), strict=True):
        chosen = corners[picked]
        vertices, given, local = _compact(chosen, positions, normals if g % 2 else None)
        material = materials[names[g // 2]]
        if colours is not None:
            material = _coloured(material, colours, positions, chosen[:, :, 0], path.name, notes)
        geometries.append(FileGeometry(vertices, local, given, material))
    return geometries


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
    path: Path, statements: Statements, used: list[str], notes: Notes
) -> dict[str, FileMaterial | None]:
    """The materials that faces use, by name; None where the file gives none."""
    library = {}
    for line in statements.libraries:
        for file in _library_files(path.parent, line, notes):
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
            found[name] = MaterialReader(known, keys, folder, notes).material()
        else:
            found[name] = None
            if name:
                notes.look("materials that no library of the file has", name)
    return found


def _library_files(folder: Path, line: str, notes: Notes) -> list[Path]:
    """The files that one mtllib statement names: blanks separate names, and may be in them."""
    words = line.split()
    files = []
    start = 0
    while start < len(words):
        for end in range(len(words), start, -1):
            file = find_file(folder, " ".join(words[start:end]))
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


def _compact(
    corners: Indices, positions: Vectors, normals: Vectors | None
) -> tuple[Vectors, Vectors | None, Indices]:
    """Vertices, normals and triangles of corners (n, 3, 2), indices of positions and of normals."""
    if normals is None:
        used, local = np.unique(corners[:, :, 0], return_inverse=True)
        return positions[used], None, local.reshape(-1, 3)
    pairs = corners[:, :, 0] * (len(normals) + 1) + corners[:, :, 1] + 1
    used, local = np.unique(pairs, return_inverse=True)
    position, normal = np.divmod(used, len(normals) + 1)
    # Index 0 stands for no normal, which zero does as well.
    given = np.concatenate([np.zeros((1, 3)), np.nan_to_num(normals)])[normal]
    return positions[position], given, local.reshape(-1, 3)


def _coloured(
    material: FileMaterial | None,
    colours: Vectors,
    positions: Vectors,
    triangles: Indices,
    name: str,
    notes: Notes,
) -> FileMaterial | None:
    """Note colours of vertices; their mean is the albedo of a surface without a material."""
    if material is not None:
        notes.look("colours of vertices are left out beside a material", material.name)
        return material
    mean = three(mean_over_area(colours, positions, triangles))
    count = len(np.unique(triangles))
    notes.look("colours of vertices are not read, their mean stands for them", "", count)
    return FileMaterial(name, mean, three(0.0), 1.0)
