"""What paths read of the triangles that they hit."""

from __future__ import annotations

import numpy as np

from ..integrands.light_sources import hidden_materials, light_sources, sampled_materials
from ..opencl.layout import Record
from ..points.points import RELATIVE_OFFSET, triangle_spreads
from ..points.textures import NO_TEXTURE, texture_index
from ..scene.load import Scene
from ..scene.textures.normals import tangents
from ..scene.textures.texture import Maps


def triangle_record(
    specular: bool,
    emission: bool,
    smooth: bool,
    textured: bool,
    coloured: bool,
    bent: bool,
    glass: bool = False,
) -> Record:
    """What is kept of a triangle, with what only some scenes have.

    `distance` is that of its plane from the scene's origin, `offset` that of ray origins by its spread
    (surface.cl), negative where its corners have normals, and `light` the light it is part of or -1, or
    -2 less the light's number where the surface reflects as well.
    `texture` and other textures are indices of textures.cl or -1, `metallic` and `normal_scale` are as
    in `Maps`, `tangent` and `side` as `normals.tangents` finds them, `ior` is `Material.signed_ior`.
    """
    fields = {"normal": 3, "distance": 1, "offset": 1, "light": 1, "albedo": 3}
    if specular:
        fields |= {"reflectance": 3, "roughness": 1}
    if emission:
        fields |= {"emission": 3}
    if smooth:
        fields |= {"normal_0": 3, "normal_1": 3, "normal_2": 3}
    if textured:
        fields |= {"texture": 1, "uv_0": 2, "uv_1": 2, "uv_2": 2}
    if bent:
        fields |= {"normal_texture": 1, "normal_scale": 1, "tangent": 3, "side": 1}
    if textured and emission:
        fields |= {"emission_texture": 1}
    if coloured:
        fields |= {"colour_0": 3, "colour_1": 3, "colour_2": 3}
    if specular and (textured or coloured):
        fields |= {"metallic": 1, "surface_texture": 1}
    if glass:
        fields |= {"ior": 1}
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
    of_material = _of_materials(scene)
    has = {
        "specular": any(one.has_lobe for one in scene.materials),
        "emission": bool(of_material["emission"].any()),
        "smooth": bool(scene.vertex_normals.any()),
        "textured": scene.vertex_uv is not None,
        "coloured": scene.vertex_colours is not None,
        "bent": bool(np.any(of_material["normal_texture"] != NO_TEXTURE)),
        "glass": scene.has_glass,
    }
    record = triangle_record(**has)
    values = {
        "normal": normals,
        "distance": np.sum(normals * corners[:, 0], axis=1),
        "offset": offsets,
        "light": _lights_of(scene),
        **{name: values[scene.triangle_material] for name, values in of_material.items()},
        **_of_corners("normal", scene.vertex_normals, scene),
        **_of_corners("uv", scene.vertex_uv, scene),
        **_of_corners("colour", scene.vertex_colours, scene),
    }
    if has["bent"]:
        values["tangent"], values["side"] = tangents(scene, np.arange(len(scene.triangles)))
    packed = record.pack(**{name: values[name] for name in record})
    defines = {
        "HAS_EMISSION": int(has["emission"]),
        "HAS_SAMPLED_EMISSION": int(sampled_materials(scene).any()),
        "HAS_HIDDEN_EMISSION": int(hidden_materials(scene).any()),
        "HAS_NORMALS": int(has["smooth"]),
        "HAS_TEXTURES": int(has["textured"]),
        "HAS_COLOURS": int(has["coloured"]),
        "HAS_NORMAL_MAPS": int(has["bent"]),
    }
    return packed, {**defines, **record.defines()}


def _lights_of(scene: Scene) -> np.ndarray:
    """The records' `light`, int32 (triangles,)."""
    number = light_sources(scene).of_triangle
    return np.where((scene.triangle_light < 0) & (number >= 0), -2 - number, number)


def _of_materials(scene: Scene) -> dict[str, np.ndarray]:
    """What triangles have of their materials, (materials, ...), by the names of the record's fields."""
    maps = [one.maps or Maps() for one in scene.materials]
    return {
        **{
            name: np.array([getattr(one, attribute) for one in scene.materials])
            for name, attribute in (
                ("albedo", "tint"),
                ("reflectance", "facing"),
                ("roughness", "roughness"),
                ("emission", "emission"),
                ("ior", "signed_ior"),
            )
        },
        **{
            name: np.array([getattr(one, name) for one in maps]) for name in ("metallic", "normal_scale")
        },
        "texture": texture_index(scene, "colour"),
        **{f"{kind}_texture": texture_index(scene, kind) for kind in ("surface", "emission", "normal")},
    }


def _of_corners(name: str, rows: np.ndarray | None, scene: Scene) -> dict[str, np.ndarray]:
    """What the vertices of triangles' corners carry, by the names of the record's fields."""
    if rows is None:
        return {}
    return {f"{name}_{corner}": rows[scene.triangles[:, corner]] for corner in range(3)}
