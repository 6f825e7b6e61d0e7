"""Scene files of Mitsuba's, made by hand."""

from __future__ import annotations

import struct
import warnings
import zlib
from pathlib import Path

import numpy as np
import trimesh

import ncv_cl as ncv

CAMERA = (
    '<sensor type="perspective"><float name="fov" value="40"/><string name="fov_axis" value="y"/>'
    '<transform name="to_world"><lookat origin="0, 0, 5" target="0, 0, 0" up="0, 1, 0"/></transform>'
    "</sensor>"
)


def scene(content: str, version: str = "3.0.0", camera: str = CAMERA) -> str:
    """The text of a scene file."""
    return f'<scene version="{version}">{camera}{content}</scene>'


def rectangle(content: str = "", transform: str = "") -> str:
    placed = f'<transform name="to_world">{transform}</transform>' if transform else ""
    return f'<shape type="rectangle">{placed}{content}</shape>'


def matrix_text(matrix: np.ndarray) -> str:
    return f'<matrix value="{" ".join(map(repr, np.asarray(matrix, float).ravel().tolist()))}"/>'


def load(path: Path) -> ncv.Scene:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return ncv.load_scene(path)


def serialized(*meshes: trimesh.Trimesh) -> bytes:
    """A file of version 4: the even ones in double precision, with texture coordinates."""
    data, places = b"", []
    for i, mesh in enumerate(meshes):
        kind, flags = ("<f4", 0x1002) if i % 2 else ("<f8", 0x2002)
        uv = 0.3 * mesh.vertices[:, :2] + 0.5
        counts = struct.pack("<I5sQQ", flags, b"name\0", len(mesh.vertices), len(mesh.faces))
        arrays = [mesh.vertices.astype(kind), uv.astype(kind), mesh.faces.astype("<u4")]
        places.append(len(data))
        packed = zlib.compress(counts + b"".join(array.tobytes() for array in arrays))
        data += struct.pack("<HH", 0x041C, 4) + packed
    return data + struct.pack(f"<{len(places)}QI", *places, len(places))
