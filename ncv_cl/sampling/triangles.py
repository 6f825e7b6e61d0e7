"""What paths read of the triangles that they hit."""

from __future__ import annotations

import numpy as np

from ..opencl.layout import Record
from ..points.points import RELATIVE_OFFSET, triangle_spreads
from ..scene.load import Scene


def triangle_record(specular: bool, emission: bool, smooth: bool) -> Record:
    """What is kept of a triangle, with what only some scenes have.

    `distance` is that of its plane from the scene's origin, `offset` that of ray origins by its spread
    (surface.cl), negative where its corners have normals, and `light` the light it is part of or -1.
    """
    fields = {"normal": 3, "distance": 1, "offset": 1, "light": 1, "albedo": 3}
    if specular:
        fields |= {"reflectance": 3, "roughness": 1}
    if emission:
        fields |= {"emission": 3}
    if smooth:
        fields |= {"normal_0": 3, "normal_1": 3, "normal_2": 3}
    return Record("TRIANGLE", fields)


def triangle_records(scene: Scene) -> tuple[np.ndarray, dict[str, int]]:
    """The records of a scene, float32 (triangles, floats), and the `-D` constants about them."""
    corners = scene.vertices[scene.triangles].astype(np.float64)
    edges = corners[:, 1:] - corners[:, :1]
    # Scaled before the cross product, whose squared length is very small for small triangles.
    scaled = edges / np.abs(edges).max(axis=2, keepdims=True)
    normals = np.cross(scaled[:, 0], scaled[:, 1])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    corner_normals = scene.vertex_normals[scene.triangles]
    offsets = RELATIVE_OFFSET * triangle_spreads(corners, normals)
    offsets[corner_normals.any(axis=(1, 2))] *= -1.0
    of_material = {
        name: np.array([getattr(one, name) for one in scene.materials])
        for name in ("albedo", "reflectance", "roughness", "emission")
    }
    has = {name: bool(of_material[name].any()) for name in ("reflectance", "emission")}
    smooth = bool(scene.vertex_normals.any())
    record = triangle_record(has["reflectance"], has["emission"], smooth)
    values = {
        "normal": normals,
        "distance": np.sum(normals * corners[:, 0], axis=1),
        "offset": offsets,
        "light": scene.triangle_light,
        **{name: values[scene.triangle_material] for name, values in of_material.items()},
        **{f"normal_{corner}": corner_normals[:, corner] for corner in range(3)},
    }
    packed = record.pack(**{name: values[name] for name in record})
    defines = {"HAS_EMISSION": int(has["emission"]), "HAS_NORMALS": int(smooth)}
    return packed, {**defines, **record.defines()}
