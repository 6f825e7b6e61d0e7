"""A scene file's tables as what `mitsuba.load_dict` takes, written anew from Mitsuba's documentation.

Quads, spheres and mesh files; materials that both have; lights of every kind; a constant environment.
"""

from __future__ import annotations

from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from ncv_cl.scene.imports.mitsuba_materials import inner_reflection

Table = dict[str, Any]


def scene_dict(mi: ModuleType, tables: Table, folder: Path, size: tuple[int, int] = (16, 12)) -> Table:
    """The dictionary; `mi` is Mitsuba with a scalar variant chosen."""
    found: Table = {"type": "scene", "camera": _camera(mi, tables["camera"], size)}
    for name, table in tables["materials"].items():
        found[f"m_{name}"] = _material(table) | {"id": f"m_{name}"}
    for key in ("quads", "spheres", "meshes"):
        for i, table in enumerate(tables.get(key, [])):
            shape = {"quads": _quad, "spheres": _sphere, "meshes": _mesh}[key](mi, table, folder)
            found[f"{key}{i:02}"] = shape | {"bsdf": {"type": "ref", "id": f"m_{table['material']}"}}
    for i, table in enumerate(tables.get("lights", [])):
        found[f"light{i:02}"] = _light(mi, table)
    if "environment" in tables:
        found["sky"] = {"type": "constant", "radiance": _rgb(tables["environment"]["radiance"])}
    return found


def _camera(mi: ModuleType, table: Table, size: tuple[int, int]) -> Table:
    look = mi.ScalarTransform4f().look_at(table["position"], table["target"], table["up"])
    film = {"type": "hdrfilm", "width": size[0], "height": size[1], "rfilter": {"type": "box"}}
    fov = {"fov": table["vertical_fov"], "fov_axis": "y"}
    return {"type": "perspective", "to_world": look, "film": film} | fov


def _rgb(colour: Any) -> Table:
    return {"type": "rgb", "value": [float(x) for x in np.broadcast_to(colour, 3)]}


def _material(table: Table) -> Table:
    roughness = table.get("roughness", 0.01 if "transmission" in table else 1.0)
    lobe: Table = {}
    if roughness > 0.01:
        lobe = {"alpha": roughness**2, "distribution": "ggx"}
    if "transmission" in table:
        tint, ior = {"specular_transmittance": _rgb(table["transmission"])}, table.get("ior", 1.5)
        kind = "thindielectric" if table.get("thin") else "roughdielectric" if lobe else "dielectric"
        return {"type": kind, "int_ior": ior, "ext_ior": 1.0} | tint | lobe
    albedo = np.broadcast_to(table["albedo"], 3)
    reflectance = np.broadcast_to(table.get("reflectance", 0.0), 3)
    if not reflectance.any():
        return {"type": "twosided", "material": {"type": "diffuse", "reflectance": _rgb(albedo)}}
    root = np.sqrt(reflectance)
    eta = (1 + root) / (1 - root)
    if not albedo.any():
        metal = {"eta": _rgb(eta), "k": _rgb(0.0)}
        kind = "roughconductor" if lobe else "conductor"
        return {"type": "twosided", "material": {"type": kind} | metal | lobe}
    # What comes out of Mitsuba's plastic is diffuse / (η² (1 − inner)).
    diffuse = albedo * eta[0] ** 2 * (1 - inner_reflection(eta[0]))
    plastic = {"diffuse_reflectance": _rgb(diffuse), "int_ior": eta[0], "ext_ior": 1.0}
    kind = "roughplastic" if lobe else "plastic"
    return {"type": "twosided", "material": {"type": kind} | plastic | lobe}


def _quad(mi: ModuleType, table: Table, _: Path) -> Table:
    corner, edge1, edge2 = (np.array(table[key], float) for key in ("corner", "edge1", "edge2"))
    normal = np.cross(edge1, edge2)
    columns = [edge1 / 2, edge2 / 2, normal / np.linalg.norm(normal), corner + edge1 / 2 + edge2 / 2]
    matrix = np.vstack([np.stack(columns, axis=1), [0, 0, 0, 1]])
    return {"type": "rectangle", "to_world": mi.ScalarTransform4f(matrix)}


def _sphere(mi: ModuleType, table: Table, _: Path) -> Table:
    return {"type": "sphere", "center": table["center"], "radius": table["radius"]}


def _mesh(mi: ModuleType, table: Table, folder: Path) -> Table:
    name, suffix = str(folder / table["file"]), Path(table["file"]).suffix[1:]
    matrix = mi.ScalarTransform4f(np.array(table["transform"], float))
    return {"type": suffix, "filename": name, "face_normals": not table["smooth"], "to_world": matrix}


def _light(mi: ModuleType, table: Table) -> Table:
    kind = table.get("kind", "quad")
    black = {"type": "diffuse", "reflectance": _rgb(0.0)}
    move = mi.ScalarTransform4f
    if kind in ("quad", "disc", "sphere"):
        if kind == "quad":
            shape = _quad(mi, table, Path())
        elif kind == "sphere":
            shape = {"type": "sphere", "center": table["centre"], "radius": table["radius"]}
        else:
            normal = np.array(table["normal"], float)
            up = np.eye(3)[np.argmin(np.abs(normal))]
            target = (np.array(table["centre"]) + normal).tolist()
            place = move().look_at(table["centre"], target, up.tolist())
            shape = {"type": "disk", "to_world": place @ move().scale(table["radius"])}
        return shape | {"bsdf": black, "emitter": {"type": "area", "radiance": _rgb(table["radiance"])}}
    if kind == "directional":
        return {"type": kind, "direction": table["direction"], "irradiance": _rgb(table["irradiance"])}
    point = {"type": kind, "intensity": _rgb(table["intensity"])}
    if kind == "point":
        return point | {"position": table["position"]}
    direction = np.array(table["direction"], float)
    target = (np.array(table["position"]) + direction).tolist()
    up = np.eye(3)[np.argmin(np.abs(direction))].tolist()
    cone = {"cutoff_angle": table["outer_angle"], "beam_width": table["inner_angle"]}
    return point | {"to_world": move().look_at(table["position"], target, up)} | cone
