"""STL, binary and ASCII."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from .common import Asked, FileGeometry, Notes, Vectors, check_triangles
from .files import decode

_RECORD = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_HEADER_BYTES = 84
_VERTEX = re.compile(r"^[ \t]*vertex[ \t]+([^\n]*)$", re.MULTILINE | re.IGNORECASE)
_FACET = re.compile(r"^[ \t]*facet\b", re.MULTILINE | re.IGNORECASE)
_END = re.compile(r"^[ \t]*endsolid\b", re.MULTILINE | re.IGNORECASE)


def read_stl(path: Path, notes: Notes, asked: Asked) -> list[FileGeometry]:
    """Read an STL file; all its solids are one geometry. It has no texture coordinates.

    Normals are those of the triangles, whatever the file says.

    Raises
    ------
    ValueError
        If the file is neither form of STL, was cut off or has a vertex that is not finite.
    """
    data = path.read_bytes()
    announced = int.from_bytes(data[80:_HEADER_BYTES], "little")
    expected = _HEADER_BYTES + announced * _RECORD.itemsize
    # Binary files may begin with "solid" too, so the size decides first.
    is_text = data.lstrip(b"\xef\xbb\xbf \t\r\n")[:5].lower() == b"solid"
    if len(data) >= _HEADER_BYTES and (len(data) == expected or not is_text):
        corners = _binary_corners(data, announced, notes)
    elif is_text:
        corners = _text_corners(decode(data))
    else:
        raise ValueError("cannot be read: it is neither binary nor ASCII STL")
    triangles = np.arange(3 * len(corners)).reshape(-1, 3)
    vertices = corners.reshape(-1, 3)
    check_triangles(vertices, triangles, "the mesh")
    return [FileGeometry(vertices, triangles)]


def _binary_corners(data: bytes, announced: int, notes: Notes) -> Vectors:
    """Corners (n, 3, 3) of the triangles of a binary file."""
    there, left_over = divmod(len(data) - _HEADER_BYTES, _RECORD.itemsize)
    if there < announced:
        raise ValueError(f"cannot be read: it was cut off after {there} of {announced} triangles")
    if there > announced or left_over:
        rest = len(data) - _HEADER_BYTES - announced * _RECORD.itemsize
        notes.shape("bytes behind the announced triangles are left out", "", rest)
    records = np.frombuffer(data, _RECORD, count=announced, offset=_HEADER_BYTES)
    coloured = int(np.count_nonzero(records["attribute"]))
    if coloured:
        notes.look("colours or attributes of triangles are left out", "", coloured)
    return records["corners"].astype(np.float64)


def _text_corners(text: str) -> Vectors:
    """Corners (n, 3, 3) of the triangles of an ASCII file."""
    text = text.replace("\r\n", "\n").replace("\r", "\n")
    rows = _VERTEX.findall(text)
    n_facets = len(_FACET.findall(text))
    if len(rows) != 3 * n_facets:
        raise ValueError(
            f"cannot be read: it has {len(rows)} vertices for {n_facets} facets, not 3 each"
        )
    if not _END.search(text):
        raise ValueError("cannot be read: it was cut off, for there is no endsolid")
    try:
        values = np.array([row.split() for row in rows], dtype=np.float64)
    except ValueError as error:
        raise ValueError(f"cannot be read: a vertex is not three numbers: {error}") from error
    return values.reshape(-1, 3, 3)
