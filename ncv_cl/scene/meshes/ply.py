"""PLY (Stanford): polygons and triangle strips, read with plyfile."""

from __future__ import annotations

import codecs
import io
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
from plyfile import PlyData, PlyElement, PlyListProperty, PlyParseError

from ..textures.texture import Maps, linear_from_srgb
from .common import (
    FALLBACK_ALBEDO,
    Asked,
    FileGeometry,
    FileMaterial,
    Indices,
    Notes,
    Vectors,
    check_triangles,
    constant_or_varying,
    three,
)
from .files import find_file
from .polygons import strip_triangles, triangulate
from .textures import MISSING, colour_texture

_INDEX_NAMES = ("vertex_indices", "vertex_index")
_COLOURS = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"))
_COORDINATES = (("u", "v"), ("s", "t"), ("texture_u", "texture_v"), ("texture_s", "texture_t"))
_LONGEST_HEADER = 1 << 16
_NORMALS = ("nx", "ny", "nz")


def read_ply(path: Path, notes: Notes, asked: Asked) -> list[FileGeometry]:
    """Read a PLY file as one geometry.

    Raises
    ------
    ValueError
        If the file cannot be read, holds no surface, or an index or a position is wrong.
    """
    data = _read(path)
    if "vertex" not in data or not {"x", "y", "z"} <= _names(data["vertex"]):
        raise ValueError("the file has no element vertex with x, y and z")
    vertex = data["vertex"]
    vertices = _columns(vertex, ("x", "y", "z"))
    triangles, face = _triangles(data, vertices, notes)
    check_triangles(vertices, triangles, "element face")
    normals = _columns(vertex, _NORMALS) if set(_NORMALS) <= _names(vertex) else None
    if normals is not None:
        normals = np.where(np.isfinite(normals), normals, 0.0)
    geometry = FileGeometry(vertices, triangles, normals, uv=_coordinates(vertex))
    geometry = _coloured(geometry, path.name, data, face)
    geometry = _textured(geometry, path, data, notes, asked)
    for element in data.elements:
        if element.name not in ("vertex", "face", "tristrips") and element.count:
            notes.shape("elements that are left out", element.name, element.count)
    return [geometry]


def _read(path: Path) -> PlyData:
    """Read a file; binary lists of equal lengths, as of triangles alone, are not read one by one."""
    with path.open("rb") as file:
        start = file.read(_LONGEST_HEADER)
    header = start[: start.find(b"end_header")]
    _check_counts(header, path.stat().st_size)
    source: str | io.BytesIO = str(path)
    attempts: tuple[int | None, ...] = (3, 4, None)
    if re.search(rb"^\s*format\s+ascii", header, re.MULTILINE):
        # Blank lines and ends of lines as old Macs have them, which plyfile does not take.
        lines = [line for line in path.read_bytes().splitlines() if line and not line.isspace()]
        source, attempts = io.BytesIO(_plain(b"\n".join(lines) + b"\n")), (None,)
    elif not header.isascii():
        source, attempts = io.BytesIO(_plain(path.read_bytes())), (None,)
    for count in attempts:
        lengths = {} if count is None else {"face": dict.fromkeys(_INDEX_NAMES, count)}
        try:
            return PlyData.read(source, known_list_len=lengths)
        except (PlyParseError, ValueError, KeyError, OverflowError, MemoryError) as error:
            if count is None:
                raise ValueError(f"cannot be read: {error}") from error
    raise AssertionError("the last attempt returns or raises")


def _check_counts(header: bytes, size: int) -> None:
    """Raise `ValueError` if the header announces more entries than the file has bytes."""
    for name, count in re.findall(rb"^\s*element\s+(\S+)\s+(\S+)", header, re.MULTILINE):
        if count.isdigit() and int(count[:20]) > size:
            text = name.decode("latin-1")
            raise ValueError(f"was cut off: it announces {int(count[:20])} of element {text}")


def _plain(data: bytes) -> bytes:
    """A file whose header is ASCII: without byte-order mark, or signs of other encodings in comments."""
    header, end, body = data.removeprefix(codecs.BOM_UTF8).partition(b"end_header")
    return bytes(byte if byte < 128 else ord("?") for byte in header) + end + body


def _names(element: PlyElement) -> set[str]:
    return {p.name for p in element.properties if not isinstance(p, PlyListProperty)}


def _columns(element: PlyElement, names: tuple[str, ...]) -> Vectors:
    return np.stack([np.asarray(element[name], dtype=np.float64) for name in names], axis=1)


def _triangles(data: PlyData, vertices: Vectors, notes: Notes) -> tuple[Indices, Indices]:
    """Triangles (n, 3) as indices of vertices, and the face of each; -1 for strips."""
    found, owners = [], []
    if "face" in data and data["face"].count:
        corners, counts = _faces(data["face"])
        bad = np.flatnonzero((corners < 0) | (corners >= len(vertices)))
        if bad.size:
            face = int(np.searchsorted(np.cumsum(counts), bad[0], side="right"))
            raise ValueError(
                f"face {face} refers to vertex {corners[bad[0]]}, but there are {len(vertices)}, "
                "counted from 0"
            )
        cut, owner, crossing = triangulate(vertices, corners, counts)
        for kind, faces in (
            ("faces with less than three corners are left out", np.flatnonzero(counts < 3)),
            ("faces that cross themselves or are far from flat, whose triangles are a guess", crossing),
        ):
            if faces.size:
                notes.shape(kind, f"the first is face {faces[0]}", len(faces))
        found.append(corners[cut])
        owners.append(owner)
    if "tristrips" in data and data["tristrips"].count:
        strips, _ = _faces(data["tristrips"])
        found.append(strip_triangles(strips))
        owners.append(np.full(len(found[-1]), -1))
    if not found:
        others = ", ".join(f"{e.name} ({e.count})" for e in data.elements if e.name != "face")
        raise ValueError(f"the mesh is empty: the file has no faces, but {others}")
    return np.concatenate(found), np.concatenate(owners)


def _faces(element: PlyElement) -> tuple[Indices, Indices]:
    """All indices of an element's lists, one after another, and the length of each list."""
    lists = {p.name for p in element.properties if isinstance(p, PlyListProperty)}
    name = next((name for name in _INDEX_NAMES if name in lists), None)
    if name is None:
        raise ValueError(f"element {element.name} has no list vertex_indices or vertex_index")
    column = element[name]
    if column.dtype != object:
        return column.astype(np.int64).reshape(-1), np.full(len(column), column.shape[1])
    counts = np.fromiter(map(len, column), dtype=np.int64, count=len(column))
    return np.concatenate(column).astype(np.int64), counts


def _coordinates(vertex: PlyElement) -> Vectors | None:
    """Texture coordinates (n, 2) of vertices; None if they have none."""
    for names in _COORDINATES:
        if set(names) <= _names(vertex):
            return np.nan_to_num(_columns(vertex, names))
    return None


def _coloured(geometry: FileGeometry, name: str, data: PlyData, face: Indices) -> FileGeometry:
    """A geometry with the colours of its vertices or faces, if they have any, as its material."""
    colours = _colours(data["vertex"])
    if colours is None and "face" in data and np.all(face >= 0):
        of_face = _colours(data["face"])
        if of_face is not None:
            # Every triangle gets three vertices of its own.
            colours = np.repeat(of_face[face], 3, axis=0)
            corners = geometry.triangles.reshape(-1)
            vertices, triangles = geometry.vertices[corners], np.arange(len(corners)).reshape(-1, 3)
            normals, uv = (
                None if rows is None else rows[corners] for rows in (geometry.normals, geometry.uv)
            )
            geometry = replace(geometry, vertices=vertices, triangles=triangles, normals=normals, uv=uv)
    if colours is None:
        return geometry
    albedo, varying = constant_or_varying(colours, geometry.triangles)
    material = FileMaterial(name, albedo or three(1.0), three(0.0), 1.0)
    return replace(geometry, material=material, colours=varying)


def _textured(
    geometry: FileGeometry, path: Path, data: PlyData, notes: Notes, asked: Asked
) -> FileGeometry:
    """A geometry with the image that a comment names, where its vertices have coordinates."""
    comments = [c for c in data.comments if c.lower().startswith("texturefile")]
    for comment in comments[1:] if geometry.uv is not None else comments:
        notes.look("textures are not read, the surface is as without them", comment)
    if not comments or geometry.uv is None:
        return geometry
    file = find_file(path.parent, comments[0][len("texturefile") :], asked.images.reach)
    texture = colour_texture(asked.images, file, comments[0], notes)
    if texture is None:
        notes.look(MISSING.format(f"{FALLBACK_ALBEDO:g}"), comments[0])
        return geometry
    material = geometry.material or FileMaterial(path.name, three(1.0), three(0.0), 1.0)
    return replace(geometry, material=replace(material, maps=Maps(texture)))


def _colours(element: PlyElement) -> Vectors | None:
    """Linear colours (n, 3) of an element's entries: sRGB of 8 or 16 bits, or in [0, 1]."""
    for names in _COLOURS:
        if set(names) <= _names(element):
            kind = element[names[0]].dtype
            scale = np.iinfo(kind).max if kind.kind in "iu" else 1.0
            values = np.nan_to_num(_columns(element, names) / scale)
            return linear_from_srgb(np.clip(values, 0.0, 1.0))
    return None
