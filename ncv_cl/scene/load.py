"""Scene files: a TOML file and the mesh files it names become a `Scene`."""

from __future__ import annotations

import warnings
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from trimesh.transformations import identity_matrix, translation_matrix

from ..host.reach import Reach
from . import geometry, meshes
from .assembly import Assembly, add_environment, read_camera, read_materials
from .build import mesh_of_arrays
from .geometry import Mesh
from .imports import Found, read_tables
from .lights.read import add_lights
from .model import Camera, Material, QuadLight, Scene, TriangleMesh
from .table import SceneError, Table
from .textures.image_file import ImageFiles

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
    "environment",
)
_PLACE_KEYS = ("translate", "scale", "rotate", "transform")
_MESH_KEYS = ("file", "material", "name", "smooth", "lights", *_PLACE_KEYS)
_ARRAY_KEYS = tuple(field.name for field in fields(TriangleMesh))
# What to do about a mesh file whose coordinates are coarse.
_COARSE = "export it about its own origin and move it by translate"


def load_scene(path: str | Path, *, camera: str | None = None, allow_outside: bool = False) -> Scene:
    """Read a scene file.

    Parameters
    ----------
    path : str or Path
        By its suffix: TOML; glTF (.gltf, .glb) with its cameras and lights; a mesh (.obj, .ply, .stl),
        which a suggested camera looks at; or Mitsuba's XML, which takes the extra ``mitsuba``. Files in
        it are relative to its folder.
    camera : str, optional
        Name of the camera, where a file has several; the first by default.
    allow_outside : bool
        Whether it may name files outside of its folder. Links count as what they lead to.

    Returns
    -------
    Scene

    Raises
    ------
    SceneError
        If the file or a mesh file is missing, cannot be read or lies outside, a key is unknown or
        missing, or a value has the wrong type, is not finite or is out of range. Names file, key and
        index.

    Warns
    -----
    UserWarning
        Where triangles without area were dropped, a mesh file has no material or something that is
        left out or replaced, or single precision cannot resolve what the camera sees; also kept in
        `Scene.warnings`.
    """
    scene = read_scene(Path(path), camera, allow_outside)
    for warning in scene.warnings:
        warnings.warn(warning, stacklevel=2)
    return scene


def read_scene(path: Path, camera: str | None = None, allow_outside: bool = False) -> Scene:
    """`load_scene` that warns of nothing, see `Scene.warnings`."""
    images = ImageFiles(Reach(None if allow_outside else path.parent))
    found = read_tables(path, images, camera)
    return scene_from(found, path, images)


def scene_from(found: Found, path: Path, images: ImageFiles) -> Scene:
    """The scene of what a scene file holds.

    Parameters
    ----------
    found : Found
    path : Path
        That file, for messages and mesh files.
    images : ImageFiles
        Its `reach` says which files may be read.

    Raises
    ------
    SceneError
        As `load_scene` does.
    """
    root = Table(path, "", found.tables, _SCENE_KEYS)
    assembly = Assembly(path, read_camera(root), read_materials(root, images))
    assembly.warnings += [f"{path}: {sentence}" for sentence in found.said]
    _add_primitives(root, assembly)
    lights = _add_meshes(root, path.parent, images, assembly, found.mesh)
    add_environment(root, path.parent, images.reach, assembly)
    add_lights(root.replaced({"lights": [*root.entries("lights"), *lights]}), assembly)
    if assembly.is_empty:
        raise SceneError(f"{path}: the scene is empty: give quads, boxes, spheres or meshes")
    return assembly.scene(root.text("name", path.stem), path)


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


def _add_meshes(
    root: Table,
    folder: Path,
    images: ImageFiles,
    assembly: Assembly,
    known: meshes.FileMeshes | None,
) -> list[dict[str, object]]:
    """Add the tables of ``meshes``; the lights that their files have are returned as tables.

    What is `known` is the only file.
    """
    lights: list[dict[str, object]] = []
    for table in root.tables("meshes", {*_MESH_KEYS, *_ARRAY_KEYS}):
        if "file" in table:
            lights += _add_mesh_file(table.only(_MESH_KEYS), folder, images, assembly, known)
        else:
            table = table.only(_ARRAY_KEYS)
            mesh = mesh_of_arrays(table)
            assembly.add(table, "vertices", mesh, assembly.named_material(table))
    return lights


def _add_mesh_file(
    table: Table,
    folder: Path,
    images: ImageFiles,
    assembly: Assembly,
    known: meshes.FileMeshes | None,
) -> list[dict[str, object]]:
    file = folder / table.text("file")
    transform = _read_transform(table)
    material = assembly.named_material(table) if "material" in table else None
    smooth = table.flag("smooth", None)
    dim = table.choice("lights", ("use", "ignore"), "use") == "ignore"
    key = f"file: {file.name}"
    try:
        images.reach.checked(file)
        textured = material is not None and bool(assembly.materials[material].textures)
        found = known or meshes.read_meshes(file, transform, smooth, images, textured)
    except ValueError as error:
        raise table.error(key, str(error)) from error
    if dim and material is not None and not found.lights:
        raise table.error("lights", "has no effect beside material, which replaces what the file emits")
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
    return [] if dim else found.lights


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
        transmission=np.array(found.transmission, dtype=np.float32),
        ior=found.ior,
        thin=found.thin,
    )
