"""Scene files: a TOML file and the mesh files it names become a `Scene`."""

from __future__ import annotations

import sys
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from trimesh.transformations import identity_matrix, translation_matrix

from . import geometry, meshes
from .assembly import Assembly, read_camera, read_materials
from .geometry import Mesh
from .lights.read import add_lights
from .model import Camera, Material, QuadLight, Scene
from .table import SceneError, Table
from .textures.image_file import ImageFiles

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

__all__ = ["Camera", "Material", "QuadLight", "Scene", "SceneError", "load_scene"]

_SCENE_KEYS = (
    "name",
    "camera",
    "materials",
    "quads",
    "polygons",
    "boxes",
    "spheres",
    "meshes",
    "lights",
)
# What to do about a mesh file whose coordinates are coarse.
_COARSE = "export it about its own origin and move it by translate"


def load_scene(path: str | Path) -> Scene:
    """Read a scene file.

    Parameters
    ----------
    path : str or Path
        A TOML file; mesh files in it are relative to its folder.

    Returns
    -------
    Scene

    Raises
    ------
    SceneError
        If the file or a mesh file is missing or cannot be read, a key is unknown or missing, or a
        value has the wrong type, is not finite or is out of range. Names file, key and index.

    Warns
    -----
    UserWarning
        Where triangles without area were dropped, a mesh file has no material or something that is
        left out or replaced, or single precision cannot resolve what the camera sees; also kept in
        `Scene.warnings`.
    """
    path = Path(path)
    scene = scene_from(_read_toml(path), path)
    for warning in scene.warnings:
        warnings.warn(warning, stacklevel=2)
    return scene


def scene_from(tables: dict[str, object], path: Path) -> Scene:
    """The scene of what a scene file holds; `path` is that file, for messages and mesh files.

    Raises `SceneError` as `load_scene` does; warns of nothing, see `Scene.warnings`.
    """
    root = Table(path, "", tables, _SCENE_KEYS)
    images = ImageFiles()
    assembly = Assembly(path, read_camera(root), read_materials(root, images))
    _add_primitives(root, assembly)
    _add_mesh_files(root, path.parent, images, assembly)
    add_lights(root, assembly)
    if assembly.is_empty:
        raise SceneError(f"{path}: the scene is empty: give quads, boxes, spheres or meshes")
    return assembly.scene(root.text("name", path.stem), path)


def _read_toml(path: Path) -> dict[str, object]:
    try:
        # Notepad and others write a byte-order mark, which TOML does not know.
        return tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise SceneError(f"{path}: cannot read the scene file: {error.strerror}") from error
    except ValueError as error:  # TOML syntax, which carries its line, or text that is not UTF-8
        raise SceneError(f"{path}: not a TOML file: {error}") from error


def _add_primitives(root: Table, assembly: Assembly) -> None:
    for table in root.tables("quads", ("corner", "edge1", "edge2", "material", "name")):
        corners = (table.vector(key) for key in ("corner", "edge1", "edge2"))
        mesh = geometry.quad_mesh(*corners)
        assembly.add(table, "", mesh, assembly.named_material(table))
    for table in root.tables("polygons", ("vertices", "material", "name")):
        vertices = table.raw("vertices")
        if not isinstance(vertices, list) or len(vertices) < 3:
            raise table.error("vertices", "expected a list of at least 3 points")
        points = [table.vector_value(f"vertices[{i}]", v) for i, v in enumerate(vertices)]
        try:
            mesh = geometry.polygon_mesh(np.stack(points))
        except ValueError as error:
            raise table.error("vertices", str(error)) from error
        assembly.add(table, "vertices", mesh, assembly.named_material(table))
    for table in root.tables("boxes", ("min", "max", "center", "size", "rotate", "material", "name")):
        material = assembly.named_material(table)
        mesh = _read_box(table, bool(assembly.materials[material].textures))
        assembly.add(table, "", mesh, material)
    for table in root.tables("spheres", ("center", "radius", "material", "subdivisions", "name")):
        radius = table.number("radius")
        if not radius > 0.0:
            raise table.error("radius", f"{radius} is out of range; it must be positive")
        subdivisions = table.integer("subdivisions", 3, 0, 7)
        material = assembly.named_material(table)
        textured = bool(assembly.materials[material].textures)
        mesh = geometry.sphere_mesh(table.vector("center"), radius, subdivisions, textured)
        assembly.add(table, "", mesh, material)


def _read_box(table: Table, textured: bool) -> Mesh:
    corners, centred = ("min", "max"), ("center", "size")
    first, second = centred if any(key in table for key in centred) else corners
    for key in corners:
        if first == "center" and key in table:
            raise table.error(key, "give either min and max or center and size, not both")
    if first == "center":
        centre, size = table.vector("center"), table.vector("size")
    else:
        low, high = table.vector("min"), table.vector("max")
        centre, size = 0.5 * (low + high), high - low
    if not size.min() > 0.0:
        raise table.error(second, "the box must have a positive size along every axis")
    return geometry.box_mesh(centre, size, _read_rotation(table), textured)


def _read_rotation(table: Table) -> NDArray[np.float64]:
    """The key ``rotate``: [x, y, z] Euler degrees, or an axis and an angle in degrees."""
    if "rotate" not in table:
        return identity_matrix()
    value = table.raw("rotate")
    if not isinstance(value, dict):
        return geometry.euler_angles(table.vector("rotate"))
    where = f"{table.where}.rotate"
    rotation = Table(table.source, where, value, ("axis", "angle"))
    axis = rotation.vector("axis")
    if not np.any(axis):
        raise rotation.error("axis", "the axis of rotation is zero")
    return geometry.axis_angle(axis, rotation.number("angle"))


def _read_transform(table: Table) -> NDArray[np.float64]:
    """A mesh's placement: ``transform``, or ``scale``, then ``rotate``, then ``translate``."""
    if "transform" in table:
        for key in ("translate", "scale", "rotate"):
            if key in table:
                raise table.error(key, "cannot be combined with transform; give one or the other")
        transform = table.matrix("transform")
        if not geometry.is_invertible(transform):
            raise table.error("transform", "is singular: it would flatten the mesh")
        return transform
    if "scale" in table and isinstance(table.raw("scale"), list):
        factors = table.vector("scale")
    else:
        factors = np.full(3, table.number("scale", 1.0))
    if not np.all(factors):
        raise table.error("scale", "is zero: it would flatten the mesh")
    translation = translation_matrix(table.vector("translate", (0.0, 0.0, 0.0)))
    return np.asarray(translation @ _read_rotation(table) @ np.diag([*factors, 1.0]))


def _add_mesh_files(root: Table, folder: Path, images: ImageFiles, assembly: Assembly) -> None:
    keys = (
        "file", "material", "name", "translate", "scale", "rotate", "transform", "smooth", "lights",
    )  # fmt: skip
    for table in root.tables("meshes", keys):
        file = folder / table.text("file")
        transform = _read_transform(table)
        material = assembly.named_material(table) if "material" in table else None
        smooth = table.flag("smooth", None)
        dim = table.choice("lights", ("use", "ignore"), "use") == "ignore"
        if dim and material is not None:
            raise table.error(
                "lights", "has no effect beside material, which replaces what the file emits"
            )
        key = f"file: {file.name}"
        try:
            textured = material is not None and bool(assembly.materials[material].textures)
            found = meshes.read_meshes(file, transform, smooth, images, textured)
        except ValueError as error:
            raise table.error(key, str(error)) from error
        for sentence in found.notes if material is None else found.shape_notes:
            if not (dim and sentence.startswith(meshes.EMITS)):
                assembly.warn(table, key, sentence)
        from_file: dict[meshes.FileMaterial | None, int] = {}
        for item in found.meshes:
            index = material
            if index is None:
                if item.material not in from_file:
                    read = _material_of_file(table, item.material, file.name, assembly)
                    from_file[item.material] = assembly.new_material(_dark(read) if dim else read)
                index = from_file[item.material]
            # Colours are part of the file's looks.
            mesh = item.mesh if material is None else replace(item.mesh, colours=None)
            assembly.add(table, key, mesh, index, advice=_COARSE)


def _dark(material: Material) -> Material:
    """The same material without its emission."""
    maps = None if material.maps is None else replace(material.maps, emission=None)
    return replace(material, emission=np.zeros(3, np.float32), maps=maps)


def _material_of_file(
    table: Table, found: meshes.FileMaterial | None, file_name: str, assembly: Assembly
) -> Material:
    if found is None:
        message = (
            f"no material could be read; using a grey of albedo {meshes.FALLBACK_ALBEDO:g} "
            "(the key material sets another)"
        )
        assembly.warn(table, f"file: {file_name}", message)
        albedo = np.full(3, meshes.FALLBACK_ALBEDO, dtype=np.float32)
        return Material(albedo, name=file_name)
    return Material(
        name=f"{file_name}:{found.name}",
        albedo=np.array(found.albedo, dtype=np.float32),
        reflectance=np.array(found.reflectance, dtype=np.float32),
        roughness=found.roughness,
        emission=np.array(found.emission, dtype=np.float32),
        maps=found.maps,
    )
