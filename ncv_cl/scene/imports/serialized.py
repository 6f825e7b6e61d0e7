"""Mitsuba's own mesh files (.serialized): compressed arrays, several meshes a file."""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..meshes.common import Indices, Vectors, check_triangles

_MAGIC, _VERSIONS = 0x041C, (3, 4)
_NORMALS, _COORDINATES, _COLOURS, _FLAT, _DOUBLE = 0x1, 0x2, 0x8, 0x10, 0x2000
# Compressed by zlib, nothing becomes smaller than by this.
_DENSEST = 1100
_LONGEST_NAME = 1 << 12


@dataclass(frozen=True, eq=False)
class SerializedMesh:
    """A mesh of a file.

    Attributes
    ----------
    vertices : float64 (n, 3)
    triangles : int64 (n, 3)
    normals : float64 (n, 3) or None
    uv : float64 (n, 2) or None
        As in the file.
    flat : bool
        Whether it asks for the triangles' own normals.
    """

    vertices: Vectors
    triangles: Indices
    normals: Vectors | None
    uv: Vectors | None
    flat: bool


def read_serialized(path: Path, index: int) -> SerializedMesh:
    """Mesh `index` of a file, counted from 0.

    Raises
    ------
    ValueError
        If the file cannot be read, has no such mesh, was cut off or has a wrong index.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ValueError(f"{path.name} cannot be read: {error.strerror}") from error
    start = _start(data, index, path.name)
    magic, version = (int.from_bytes(data[start + i : start + i + 2], "little") for i in (0, 2))
    if magic != _MAGIC or version not in _VERSIONS:
        raise ValueError(f"{path.name} is no serialized mesh of version 3 or 4")
    stream = _Stream(data[start + 4 :], path.name)
    flags = int(stream.array("<u4", 1)[0])
    for _ in range(_LONGEST_NAME if version == 4 else 0):
        if stream.array("<u1", 1)[0] == 0:
            break
    n_vertices, n_triangles = (int(n) for n in stream.array("<u8", 2))
    kind = "<f8" if flags & _DOUBLE else "<f4"
    vertices = stream.array(kind, 3 * n_vertices).reshape(-1, 3).astype(np.float64)
    normals = stream.array(kind, 3 * n_vertices).reshape(-1, 3) if flags & _NORMALS else None
    uv = stream.array(kind, 2 * n_vertices).reshape(-1, 2) if flags & _COORDINATES else None
    if flags & _COLOURS:
        stream.array(kind, 3 * n_vertices)
    triangles = stream.array("<u4", 3 * n_triangles).reshape(-1, 3).astype(np.int64)
    check_triangles(vertices, triangles, path.name)
    normals, uv = (None if rows is None else _finite(rows) for rows in (normals, uv))
    return SerializedMesh(_finite(vertices), triangles, normals, uv, bool(flags & _FLAT))


def _finite(rows: np.ndarray) -> np.ndarray:
    return np.nan_to_num(rows.astype(np.float64), posinf=0.0, neginf=0.0)


def _start(data: bytes, index: int, name: str) -> int:
    """Where mesh `index` begins, by the table at the file's end."""
    count = int.from_bytes(data[-4:], "little")
    size = 8 if int.from_bytes(data[2:4], "little") == 4 else 4
    table = len(data) - 4 - count * size
    if len(data) < 8 or table < 0 or not 0 <= index < count:
        raise ValueError(f"{name} has no mesh {index}")
    place = table + index * size
    return int.from_bytes(data[place : place + size], "little")


class _Stream:
    """Arrays from compressed bytes, of which no more are decompressed than there can be."""

    def __init__(self, data: bytes, name: str) -> None:
        self._reader = zlib.decompressobj()
        self._left, self._rest, self._name = _DENSEST * len(data), data, name

    def array(self, kind: str, count: int) -> np.ndarray:
        size = np.dtype(kind).itemsize * count
        if size > self._left:
            raise ValueError(f"{self._name} was cut off: it announces more than it can hold")
        self._left -= size
        found = b""
        try:
            while len(found) < size:
                part = self._reader.decompress(self._rest, size - len(found))
                self._rest = self._reader.unconsumed_tail
                if not part and not self._rest:
                    raise ValueError(f"{self._name} was cut off")
                found += part
        except zlib.error as error:
            raise ValueError(f"{self._name} cannot be decompressed: {error}") from error
        return np.frombuffer(found, kind, count)
