"""Scene files: TOML becomes one merged triangle mesh, materials, area lights and a camera."""

from __future__ import annotations

import sys
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from trimesh.transformations import identity_matrix, translation_matrix

from . import geometry, meshes, place
from .geometry import SMALLEST_ROUGHNESS, Mesh
from .model import Camera, Material, QuadLight, Scene
from .table import SceneError, Table

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
    root = Table(path, "", _read_toml(path), _SCENE_KEYS)
    camera = _read_camera(root)
    assembly = _Assembly(_read_materials(root))
    _add_primitives(root, assembly)
    _add_mesh_files(root, assembly)
    lights = _add_lights(root, assembly)
    scene = assembly.scene(root.text("name", path.stem), path, camera, lights)
    for warning in scene.warnings:
        warnings.warn(warning, stacklevel=2)
    return scene


class _Assembly:
    """The merged mesh as it grows."""

    def __init__(self, materials: list[Material]) -> None:
        self.materials = materials
        self._material_index = {material.name: i for i, material in enumerate(materials)}
        self._parts: list[tuple[Table, str, Mesh, int, int]] = []
        # Degenerate and all triangles of what a table's key describes.
        self._dropped: dict[tuple[str, str], tuple[Table, int, int]] = {}
        self.warnings: list[str] = []

    def named_material(self, table: Table) -> int:
        name = table.text("material")
        if name not in self._material_index:
            known = ", ".join(self._material_index) or "none"
            raise table.error("material", f"unknown material {name!r}; known materials: {known}")
        return self._material_index[name]

    def new_material(self, material: Material) -> int:
        self.materials.append(material)
        return len(self.materials) - 1

    def warn(self, table: Table, key: str, message: str) -> None:
        self.warnings.append(str(table.error(key, message)))

    def add(self, table: Table, key: str, mesh: Mesh, material: int, light: int = -1) -> None:
        """Append a mesh that `table` describes, maybe with others."""
        self._parts.append((table, key, mesh, material, light))

    def _without_degenerate(self, table: Table, key: str, mesh: Mesh) -> Mesh:
        """The mesh without triangles of no area, which are counted for what `table` describes."""
        n_triangles = len(mesh.triangles)
        try:
            mesh, dropped = geometry.drop_degenerate(mesh)
        except ValueError as error:
            raise table.error(key, str(error)) from error
        _, others, total = self._dropped.get((table.where, key), (table, 0, 0))
        self._dropped[table.where, key] = (table, others + dropped, total + n_triangles)
        return mesh

    def _placed(self, camera: Camera) -> tuple[NDArray[np.float64], list[Mesh]]:
        """The scene's origin, and the meshes about it, in steps of single precision."""
        surfaces = [mesh for *_, mesh, _, light in self._parts if light < 0]
        meshes = surfaces or [mesh for *_, mesh, _, _ in self._parts]
        corners = np.concatenate([mesh.vertices[mesh.triangles] for mesh in meshes])
        origin = place.scene_origin(corners, camera)
        placed = []
        camera = place.moved(camera, origin)
        for table, key, mesh, _, _ in self._parts:
            if key.startswith("file") and place.is_coarse(mesh):
                self.warn(
                    table,
                    key,
                    "its coordinates are in single precision and so large that they are coarse; "
                    "export it about its own origin and move it by translate",
                )
            mesh = replace(mesh, vertices=mesh.vertices - origin)
            placed.append(self._without_degenerate(table, key, place.cut_huge(mesh, camera)))
        self._report_dropped()
        return origin, placed

    def _report_dropped(self) -> None:
        """Say how many degenerate triangles were dropped; raise `SceneError` where nothing is left."""
        for (_, key), (table, dropped, total) in self._dropped.items():
            if dropped == total:
                raise table.error(key, "has no area: all its triangles are degenerate")
            if dropped:
                message = f"dropped {dropped} degenerate of {total} triangles (they have no area)"
                self.warn(table, key, message)

    def scene(self, name: str, path: Path, camera: Camera, lights: list[QuadLight]) -> Scene:
        if not self._parts:
            raise SceneError(f"{path}: the scene is empty: give quads, boxes, spheres or meshes")
        origin, meshes = self._placed(camera)
        camera = place.moved(camera, origin)
        moved = [replace(light, corner=light.corner - origin).single() for light in lights]
        vertices = np.concatenate([mesh.vertices for mesh in meshes])
        pixels = place.unresolved_steps(vertices, origin, camera)
        if pixels:
            self.warnings.append(
                f"{path}: single precision cannot resolve the scene: what it rounds makes {pixels:.2g} "
                f"pixels of a picture of {place.PIXELS} rows; shadows may be missing or wrong. "
                "Move the camera closer and widen its field of view, or leave out what is far away"
            )
        firsts = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes])
        triangles = [mesh.triangles + first for mesh, first in zip(meshes, firsts[:-1], strict=True)]
        counts = [len(mesh.triangles) for mesh in meshes]
        scene = Scene(
            name=name,
            path=path,
            camera=camera,
            materials=tuple(self.materials),
            lights=tuple(moved),
            vertices=vertices.astype(np.float32),
            vertex_normals=np.concatenate([mesh.normals for mesh in meshes]).astype(np.float32),
            triangles=np.concatenate(triangles).astype(np.uint32),
            triangle_material=np.repeat([part[3] for part in self._parts], counts).astype(np.int32),
            triangle_light=np.repeat([part[4] for part in self._parts], counts).astype(np.int32),
            warnings=tuple(self.warnings),
            origin=origin,
        )
        for array in vars(scene).values():
            if isinstance(array, np.ndarray):
                array.setflags(write=False)
        return scene


def _read_toml(path: Path) -> dict[str, object]:
    try:
        # Notepad and others write a byte-order mark, which TOML does not know.
        return tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise SceneError(f"{path}: cannot read the scene file: {error.strerror}") from error
    except ValueError as error:  # TOML syntax, which carries its line, or text that is not UTF-8
        raise SceneError(f"{path}: not a TOML file: {error}") from error


def _read_camera(root: Table) -> Camera:
    keys = ("position", "target", "up", "vertical_fov")
    table = Table(root.file, "camera", root.raw("camera"), keys)
    position, target = table.vector("position"), table.vector("target")
    up = table.vector("up", (0.0, 1.0, 0.0))
    forward = target - position
    if np.linalg.norm(forward) <= 1e-12 * np.abs(position).max():
        raise table.error("target", "is the same point as camera.position")
    sine = np.linalg.norm(np.cross(forward, up))
    if not sine > 1e-6 * np.linalg.norm(forward) * np.linalg.norm(up):
        raise table.error("up", "is zero or parallel to the view direction")
    vertical_fov = table.number("vertical_fov")
    if not 0.0 < vertical_fov < 180.0:
        message = f"{vertical_fov} is out of range; it must be between 0 and 180 degrees"
        raise table.error("vertical_fov", message)
    return Camera(position, target, up, vertical_fov)


def _read_materials(root: Table) -> list[Material]:
    if "materials" not in root:
        return []
    names = root.raw("materials")
    if not isinstance(names, dict):
        raise root.error("materials", "expected tables [materials.NAME]")
    materials = []
    for name, data in names.items():
        where = f"materials.{name}"
        table = Table(root.file, where, data, ("albedo", "reflectance", "roughness", "emission"))
        albedo = table.colour("albedo", high=1.0)
        reflectance = table.colour("reflectance", default=0.0, high=1.0)
        roughness = table.number("roughness", 1.0, SMALLEST_ROUGHNESS, 1.0)
        emission = table.colour("emission", default=0.0)
        materials.append(Material(name, albedo, reflectance, roughness, emission))
    return materials


def _add_primitives(root: Table, assembly: _Assembly) -> None:
    for table in root.tables("quads", ("corner", "edge1", "edge2", "material")):
        corners = (table.vector(key) for key in ("corner", "edge1", "edge2"))
        mesh = geometry.quad_mesh(*corners)
        assembly.add(table, "", mesh, assembly.named_material(table))
    for table in root.tables("polygons", ("vertices", "material")):
        vertices = table.raw("vertices")
        if not isinstance(vertices, list) or len(vertices) < 3:
            raise table.error("vertices", "expected a list of at least 3 points")
        points = [table.vector_value(f"vertices[{i}]", v) for i, v in enumerate(vertices)]
        try:
            mesh = geometry.polygon_mesh(np.stack(points))
        except ValueError as error:
            raise table.error("vertices", str(error)) from error
        assembly.add(table, "vertices", mesh, assembly.named_material(table))
    for table in root.tables("boxes", ("min", "max", "center", "size", "rotate", "material")):
        assembly.add(table, "", _read_box(table), assembly.named_material(table))
    for table in root.tables("spheres", ("center", "radius", "material", "subdivisions")):
        radius = table.number("radius")
        if not radius > 0.0:
            raise table.error("radius", f"{radius} is out of range; it must be positive")
        subdivisions = table.integer("subdivisions", 3, 0, 7)
        mesh = geometry.sphere_mesh(table.vector("center"), radius, subdivisions)
        assembly.add(table, "", mesh, assembly.named_material(table))


def _read_box(table: Table) -> Mesh:
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
    return geometry.box_mesh(centre, size, _read_rotation(table))


def _read_rotation(table: Table) -> NDArray[np.float64]:
    """The key ``rotate``: [x, y, z] Euler degrees, or an axis and an angle in degrees."""
    if "rotate" not in table:
        return identity_matrix()
    value = table.raw("rotate")
    if not isinstance(value, dict):
        return geometry.euler_angles(table.vector("rotate"))
    where = f"{table.where}.rotate"
    rotation = Table(table.file, where, value, ("axis", "angle"))
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


def _add_mesh_files(root: Table, assembly: _Assembly) -> None:
    keys = ("file", "material", "translate", "scale", "rotate", "transform", "smooth")
    for table in root.tables("meshes", keys):
        file = root.file.parent / table.text("file")
        transform = _read_transform(table)
        material = assembly.named_material(table) if "material" in table else None
        smooth = table.flag("smooth", None)
        key = f"file: {file.name}"
        try:
            found = meshes.read_meshes(file, transform, smooth)
        except ValueError as error:
            raise table.error(key, str(error)) from error
        for sentence in found.notes if material is None else found.shape_notes:
            assembly.warn(table, key, sentence)
        from_file: dict[meshes.FileMaterial | None, int] = {}
        for item in found.meshes:
            index = material
            if index is None:
                if item.material not in from_file:
                    from_file[item.material] = assembly.new_material(
                        _material_of_file(table, item.material, file.name, assembly)
                    )
                index = from_file[item.material]
            assembly.add(table, key, item.mesh, index)


def _material_of_file(
    table: Table, found: meshes.FileMaterial | None, file_name: str, assembly: _Assembly
) -> Material:
    if found is None:
        message = (
            f"no material could be read; using a grey of albedo {meshes.FALLBACK_ALBEDO:g} "
            "(the key material sets another)"
        )
        assembly.warn(table, f"file: {file_name}", message)
        albedo = np.full(3, meshes.FALLBACK_ALBEDO, dtype=np.float32)
        return Material(file_name, albedo, np.zeros(3, dtype=np.float32), 1.0)
    return Material(
        name=f"{file_name}:{found.name}",
        albedo=np.array(found.albedo, dtype=np.float32),
        reflectance=np.array(found.reflectance, dtype=np.float32),
        roughness=found.roughness,
        emission=np.array(found.emission, dtype=np.float32),
    )


def _add_lights(root: Table, assembly: _Assembly) -> list[QuadLight]:
    """Read the lights and append their triangles, in the order of the lights, to the mesh."""
    lights = []
    tables = root.tables("lights", ("corner", "edge1", "edge2", "radiance", "two_sided"))
    black = np.zeros(3, dtype=np.float32)
    material = assembly.new_material(Material("light", black, black, 1.0)) if tables else -1
    for index, table in enumerate(tables):
        corner, edge1, edge2 = (table.vector(key) for key in ("corner", "edge1", "edge2"))
        for key, edge in (("edge1", edge1), ("edge2", edge2)):
            if not np.any(edge):
                raise table.error(key, "light has no area (the edge has no length)")
        area = np.linalg.norm(np.cross(edge1, edge2))
        if area <= 1e-6 * np.linalg.norm(edge1) * np.linalg.norm(edge2):
            raise table.error("edge2", "light has no area (edge1 and edge2 are parallel)")
        mesh = geometry.quad_mesh(corner, edge1, edge2)
        assembly.add(table, "", mesh, material, light=index)
        two_sided = bool(table.flag("two_sided", False))
        lights.append(QuadLight(corner, edge1, edge2, table.colour("radiance"), two_sided))
    return lights
