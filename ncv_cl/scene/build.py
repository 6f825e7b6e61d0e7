"""Scenes built in Python: arrays become what a scene file would."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import fields

import numpy as np
from numpy.typing import NDArray

from .assembly import Assembly, read_camera, read_materials
from .geometry import Mesh, normalised
from .lights.kinds import DiscLight, PointLight, SphereLight, SpotLight
from .lights.read import add_lights
from .model import Camera, Material, QuadLight, Scene, TriangleMesh
from .sky.environment import Environment
from .sky.read import checked
from .table import SceneError, Table
from .textures.image_file import ImageFiles

# Begins every message, as a scene file's path begins its messages.
_SOURCE = "build_scene"
# What to do about vertices that are coarse.
_COARSE = "give them in double precision"
_KEYS = ("name", "camera", "materials", "meshes", "lights")
_LIGHTS = {
    QuadLight: "quad",
    DiscLight: "disc",
    SphereLight: "sphere",
    PointLight: "point",
    SpotLight: "spot",
}


def build_scene(
    camera: Camera,
    materials: Mapping[str, Material],
    meshes: Sequence[TriangleMesh],
    lights: Sequence[QuadLight | DiscLight | SphereLight | PointLight | SpotLight] = (),
    name: str = "scene",
    environment: Environment | None = None,
) -> Scene:
    """Build a scene from arrays, without a file.

    It is checked, moved and cut as `load_scene` does it: the same scene written as a file gives the same
    bits. Arrays are copied, of whatever precision; double precision counts where coordinates are large.

    Parameters
    ----------
    camera : Camera
    materials : dict of str to Material
        Keys are the names that meshes give; a `Material.name` is not looked at.
    meshes : list of TriangleMesh
    lights : list of QuadLight, DiscLight, SphereLight, PointLight or SpotLight
    name : str
        For messages and metadata.
    environment : Environment, optional
        What surrounds the scene, with its suns.

    Returns
    -------
    Scene

    Raises
    ------
    SceneError
        If an argument is of another type, an array of another shape, a number not finite or out of
        range, a vertex's index or a material's name unknown, or a mesh without area. Names argument and
        index, such as ``meshes[1].triangles[7]``.

    Warns
    -----
    UserWarning
        Where triangles without area were dropped, or single precision cannot resolve what the camera
        sees; also kept in `Scene.warnings`.
    """
    if not isinstance(materials, Mapping):
        raise SceneError(f"{_SOURCE}: materials: expected a dict of name to Material, got {materials!r}")
    data = {
        "name": name,
        "camera": _table("camera", camera, Camera),
        "materials": {k: _table(f"materials.{k}", one, Material) for k, one in materials.items()},
        "meshes": _tables("meshes", meshes, TriangleMesh),
        "lights": [
            {"kind": next(name for kind, name in _LIGHTS.items() if isinstance(one, kind)), **table}
            for table, one in zip(_tables("lights", lights, *_LIGHTS), lights, strict=True)
        ],
    }
    root = Table(_SOURCE, "", data, _KEYS)
    assembly = Assembly(_SOURCE, read_camera(root), read_materials(root, ImageFiles()))
    for table in root.tables("meshes", [field.name for field in fields(TriangleMesh)]):
        mesh, material = mesh_of_arrays(table), assembly.named_material(table)
        dtype = np.asarray(table.raw("vertices")).dtype
        is_single = dtype.kind == "f" and dtype.itemsize <= np.dtype(np.float32).itemsize
        assembly.add(table, "vertices", mesh, material, _COARSE if is_single else "")
    if environment is not None:
        assembly.environment, sentences = checked(_SOURCE, environment)
        assembly.warnings += sentences
    add_lights(root, assembly)
    if assembly.is_empty:
        raise SceneError(f"{_SOURCE}: the scene is empty: give meshes")
    scene = assembly.scene(root.text("name"), None)
    for warning in scene.warnings:
        warnings.warn(warning, stacklevel=2)
    return scene


def _table(where: str, value: object, *kinds: type) -> dict[str, object]:
    """The keys of a scene file's table for an object of one of some types."""
    kind = next((kind for kind in kinds if isinstance(value, kind)), None)
    if kind is None:
        names = " or ".join(kind.__name__ for kind in kinds)
        raise SceneError(f"{_SOURCE}: {where}: expected a {names}, got {_short(value)}")
    # A material's name is its key; a mesh's normals and name may be left out.
    given = {field.name: getattr(value, field.name) for field in fields(kind)}
    return {
        key: one
        for key, one in given.items()
        if one is not None and (kind is not Material or key != "name")
    }


def _tables(where: str, values: object, *kinds: type) -> list[dict[str, object]]:
    if not isinstance(values, (list, tuple)):
        names = " or ".join(kind.__name__ for kind in kinds)
        raise SceneError(f"{_SOURCE}: {where}: expected a list of {names}, got {_short(values)}")
    return [_table(f"{where}[{index}]", value, *kinds) for index, value in enumerate(values)]


def _short(value: object) -> str:
    return f"an array {value.shape}" if isinstance(value, np.ndarray) else repr(value)[:100]


def mesh_of_arrays(table: Table) -> Mesh:
    """A mesh of a table with the keys of `TriangleMesh`, checked."""
    vertices = table.points("vertices")
    triangles = table.indices("triangles", len(vertices))
    given = _of_vertices(table, "normals", 3, len(vertices))
    normals = np.zeros_like(vertices) if given is None else normalised(given)
    uv, colours = (
        _of_vertices(table, key, width, len(vertices)) for key, width in (("uv", 2), ("colours", 3))
    )
    if colours is not None and not (colours.min() >= 0.0 and colours.max() <= 1.0):
        raise table.error("colours", "are outside [0, 1]")
    return Mesh(vertices, normals, triangles, uv, colours)


def _of_vertices(table: Table, key: str, width: int, count: int) -> NDArray[np.float64] | None:
    """Numbers (count, width) that a mesh may have."""
    if key not in table:
        return None
    found = table.points(key, width)
    if len(found) != count:
        raise table.error(key, f"must be as many as vertices, {count}, are {len(found)}")
    return found
