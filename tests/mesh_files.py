"""Mesh files made by hand, loaded through a scene, and what their surface is compared with."""

from __future__ import annotations

import base64
import itertools
import json
import re
import struct
import warnings
import zlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import OpenImageIO as oiio

from ncv_cl.scene.load import Material, Scene, load_scene

SCENE = """
[camera]
position = [0, 1, 5]
target = [0, 0, 0]
vertical_fov = 40
[materials.grey]
albedo = 0.5
"""
SQUARE = np.array([(0, 0, 0), (2, 0, 0), (2, 2, 0), (0, 2, 0)], dtype=np.float32)
SIX = np.array([0, 1, 2, 0, 2, 3], dtype=np.uint16)
# Seen along z: an L, whose first corner does not see it whole.
L_SHAPE = [(0, 2, 0), (0, 0, 0), (2, 0, 0), (2, 1, 0), (1, 1, 0), (1, 2, 0)]
_CODES = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}
_TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}


def load(folder: Path, file: str, keys: str = 'material = "grey"') -> Scene:
    """A scene with one mesh file; its warnings are in `Scene.warnings`."""
    path = folder / "x.toml"
    path.write_text(f'{SCENE}[[meshes]]\nfile = "{file}"\n{keys}\n', encoding="utf-8")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return load_scene(path)


def own_materials(folder: Path, file: str) -> tuple[list[Material], list[str]]:
    """The materials of a mesh file in the order of its triangles, and what was said about the file."""
    scene = load(folder, file, "")
    used, first = np.unique(scene.triangle_material, return_index=True)
    order = used[np.argsort(first)]
    start = re.escape(f"{folder / 'x.toml'}: meshes[0].file: {file}: ")
    assert all(re.match(start, warning) for warning in scene.warnings)
    return [scene.materials[i] for i in order], [re.sub(start, "", w) for w in scene.warnings]


def corners(scene: Scene) -> np.ndarray:
    """Corners (n, 3, 3) of all triangles."""
    return scene.vertices[scene.triangles].astype(np.float64)


def vector_areas(triangles: np.ndarray) -> np.ndarray:
    """Normals (n, 3) as long as the areas of triangles (n, 3, 3)."""
    return 0.5 * np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])


def polygon_vector_area(polygon: Sequence[Sequence[float]]) -> np.ndarray:
    """The same (3,) of a polygon, by Newell's sum."""
    points = np.asarray(polygon, dtype=np.float64)
    return 0.5 * np.cross(points, np.roll(points, -1, axis=0)).sum(axis=0)


def same_surface(scene: Scene, polygons: Sequence[Sequence[Sequence[float]]]) -> bool:
    """Whether the triangles are the flat polygons: each of them is filled, and none twice or beyond.

    Filled exactly: every triangle lies in its polygon's plane with its winding, their areas add up to
    the polygon's and every triangle's centre is inside of it.
    """
    found = corners(scene)
    areas = vector_areas(found)
    left = np.ones(len(found), bool)
    for polygon in polygons:
        points = np.asarray(polygon, dtype=np.float64)
        area = polygon_vector_area(points)
        normal = area / np.linalg.norm(area)
        size = np.ptp(points, axis=0).max()
        flat = np.abs((found - points[0]) @ normal).max(axis=1) < 1e-5 * size
        own = left & flat & (areas @ normal > 0.0) & inside(found.mean(axis=1), points, normal)
        if not np.isclose((areas[own] @ normal).sum(), np.linalg.norm(area), rtol=1e-5):
            return False
        left &= ~own
    return not left.any()


def inside(points: np.ndarray, polygon: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Whether points in the plane of a polygon are inside of it: angles around them add up to a turn."""
    one = polygon[None] - points[:, None]
    two = np.roll(polygon, -1, axis=0)[None] - points[:, None]
    angle = np.arctan2(np.cross(one, two) @ normal, np.sum(one * two, axis=2))
    return np.abs(angle.sum(axis=1)) > np.pi


def obj_text(polygons: Sequence[Sequence[Sequence[float]]]) -> str:
    """Polygons with vertices of their own."""
    lines, first = [], 1
    for polygon in polygons:
        lines += ["v {:.9g} {:.9g} {:.9g}".format(*point) for point in polygon]
        lines.append("f " + " ".join(str(first + i) for i in range(len(polygon))))
        first += len(polygon)
    return "\n".join(lines) + "\n"


def ply_bytes(
    polygons: Sequence[Sequence[Sequence[float]]], form: str, index: str = "vertex_indices"
) -> bytes:
    """The same as PLY, `form` one of ascii, binary_little_endian, binary_big_endian."""
    points = [point for polygon in polygons for point in polygon]
    head = (
        f"ply\nformat {form} 1.0\ncomment made by hand\nelement vertex {len(points)}\n"
        "property float x\nproperty float y\nproperty float z\nproperty uchar quality\n"
        f"element face {len(polygons)}\nproperty list uchar int {index}\nend_header\n"
    )
    firsts = np.cumsum([0, *map(len, polygons)])
    faces = [list(range(a, b)) for a, b in itertools.pairwise(firsts)]
    if form == "ascii":
        rows = ["{:.9g} {:.9g} {:.9g} 7".format(*point) for point in points]
        rows += [" ".join(map(str, [len(face), *face])) for face in faces]
        return (head + "\n".join(rows) + "\n").encode()
    order = "<" if form == "binary_little_endian" else ">"
    body = b"".join(struct.pack(f"{order}3fB", *point, 7) for point in points)
    body += b"".join(struct.pack(f"{order}B{len(face)}i", len(face), *face) for face in faces)
    return head.encode() + body


class Gltf:
    """A glTF file as it grows; `tree` may be changed before it is written."""

    def __init__(self) -> None:
        self.blob = b""
        self.tree: dict[str, object] = {
            "asset": {"version": "2.0"},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0}],
            "bufferViews": [],
            "accessors": [],
        }

    def view(self, data: bytes, **more: object) -> int:
        """Append bytes; the index of their buffer view."""
        self.blob += b"\0" * (-len(self.blob) % 4)
        place = {"buffer": 0, "byteOffset": len(self.blob), "byteLength": len(data)}
        self.tree["bufferViews"].append(place | more)
        self.blob += data
        return len(self.tree["bufferViews"]) - 1

    def accessor(self, array: np.ndarray, **more: object) -> int:
        """Append an array (n,) or (n, width), rows aligned to 4 bytes; the index of its accessor."""
        array = np.ascontiguousarray(array)
        rows = array.reshape(len(array), -1)
        more = {
            "componentType": _CODES[array.dtype.str[1:]],
            "count": len(rows),
            "type": _TYPES[rows.shape[1]],
        } | more
        size = rows.itemsize * rows.shape[1]
        if array.ndim == 2 and size % 4:
            padded = b"".join(row.tobytes() + b"\0" * (-size % 4) for row in rows)
            view = self.view(padded, byteStride=size + -size % 4)
        else:
            view = self.view(rows.tobytes())
        self.tree["accessors"].append({"bufferView": view} | more)
        return len(self.tree["accessors"]) - 1

    def square(self, **more: object) -> dict[str, object]:
        """A primitive that is `SQUARE`."""
        attributes = {"POSITION": self.accessor(SQUARE)}
        return {"attributes": attributes, "indices": self.accessor(SIX)} | more

    def write(self, path: Path, uri: str | None = None) -> None:
        """Write .gltf with its buffer inside, or named by `uri`, or .glb."""
        buffer: dict[str, object] = {"byteLength": len(self.blob)}
        if path.suffix == ".gltf":
            data = base64.b64encode(self.blob).decode()
            buffer["uri"] = uri or f"data:application/octet-stream;base64,{data}"
        tree = {"buffers": [buffer]} | self.tree
        text = json.dumps(tree).encode()
        if path.suffix == ".gltf":
            path.write_bytes(text)
            return
        text += b" " * (-len(text) % 4)
        blob = self.blob + b"\0" * (-len(self.blob) % 4)
        parts = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(blob), b"BIN\0")
        path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(parts) + len(blob)) + parts + blob)


def write_and_load(folder: Path, gltf: Gltf, primitives: list[dict], **tree: object) -> Scene:
    """The scene of a file whose only mesh has these primitives."""
    gltf.tree["meshes"] = [{"name": "m", "primitives": primitives}]
    gltf.tree |= tree
    gltf.write(folder / "a.gltf")
    return load(folder, "a.gltf")


def write_image(path: Path, pixels: np.ndarray, kind: str = "uint8") -> None:
    """A file of an array (height, width, channels), the uppermost row first."""
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], kind)
    spec.attribute("oiio:UnassociatedAlpha", 1)
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), spec)
    assert output.write_image(np.ascontiguousarray(pixels)) and output.close()


def read_square(
    folder: Path, material: dict | None, gltf: Gltf | None = None, **attributes: int
) -> tuple[Material, list[str]]:
    """The material `w` of a glTF file with a square, and what was said."""
    gltf = gltf or Gltf()
    primitive = gltf.square()
    primitive["attributes"] |= attributes
    if material is not None:
        primitive["material"] = 0
        gltf.tree["materials"] = [{"name": "w"} | material]
    gltf.tree["meshes"] = [{"name": "m", "primitives": [primitive]}]
    gltf.write(folder / "a.gltf")
    (found,), said = own_materials(folder, "a.gltf")
    return found, said


def pbr(**table: object) -> dict:
    """A material of glTF's metallic-roughness model."""
    return {"pbrMetallicRoughness": table}


def png_bytes(red: int, green: int, blue: int) -> bytes:
    """A PNG of one pixel."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", 1, 1, 8, 2, 0, 0, 0)
    pixel = zlib.compress(bytes([0, red, green, blue]))
    start = b"\x89PNG\r\n\x1a\n"
    return start + chunk(b"IHDR", header) + chunk(b"IDAT", pixel) + chunk(b"IEND", b"")
