"""What scene files and `build_scene` share: checked parts, merged and placed, become a `Scene`."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..host.reach import Reach
from . import geometry, place
from .geometry import SMALLEST_ROUGHNESS, Mesh
from .glass import GLASS_KEYS, check_glass, read_glass
from .lights.mesh import light_mesh
from .model import Camera, Light, Material, Scene
from .sky.environment import Environment
from .sky.read import read_environment
from .table import Table
from .textures.image_file import ImageFiles
from .textures.keys import read_maps


@dataclass(frozen=True, eq=False)
class _Part:
    """A mesh of one material. One key of a table may describe several.

    Attributes
    ----------
    light : int
        Index of the light that it is, or -1.
    advice : str
        What to do where its coordinates are coarse; empty where that is not asked.
    """

    table: Table
    key: str
    mesh: Mesh
    material: int
    light: int
    advice: str


class Assembly:
    """The scene as it grows.

    Parameters
    ----------
    source : Path or str
        File or function that describes it, for messages.
    camera : Camera
    materials : list of Material
        Those that meshes may name; others may follow.
    """

    def __init__(self, source: Path | str, camera: Camera, materials: list[Material]) -> None:
        self.materials = materials
        self._source = source
        self.camera = camera
        self._material_index = {material.name: i for i, material in enumerate(materials)}
        self._parts: list[_Part] = []
        self._lights: list[Light] = []
        self.environment: Environment | None = None
        # Degenerate and all triangles of what a table's key describes.
        self._dropped: dict[tuple[str, str], tuple[Table, int, int]] = {}
        self.warnings: list[str] = []

    @property
    def is_empty(self) -> bool:
        """Whether there is nothing to see, not even a light."""
        return not self._parts

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

    @staticmethod
    def _names(table: Table) -> list[str]:
        """The name of a table's surface, if it has one."""
        if "name" not in table:
            return []
        name = table.text("name")
        if name.startswith("-"):
            raise table.error(
                "name", f"{name!r} must not begin with -, which means the back of a surface"
            )
        return [name]

    def add(self, table: Table, key: str, mesh: Mesh, material: int, advice: str = "") -> None:
        """Append a mesh that `table` describes, maybe with others; `advice`: see `_Part`."""
        surface = self.materials[material]
        maps = surface.maps
        if maps is None or not maps.textures:
            mesh = replace(mesh, uv=None)
        elif mesh.uv is None:
            raise table.error(
                key,
                f"has no texture coordinates, which the texture of material {surface.name!r} needs: "
                "quads, boxes and spheres have some, and meshes that were exported with them",
            )
        else:
            mesh = replace(mesh, uv=maps.placed(mesh.uv))
        self._parts.append(_Part(table, key, mesh, material, -1, advice))

    def add_light(self, table: Table, light: Light, material: int) -> None:
        """Append a light, in double precision, and its triangles. Lights follow all other meshes."""
        self._parts.append(_Part(table, "", light_mesh(light), material, len(self._lights), ""))
        self._lights.append(light)

    def surroundings(self, position: NDArray[np.float64]) -> tuple[float, float]:
        """Diagonal of the bounds of the surfaces so far, and how far the nearest is from a position."""
        meshes = [part.mesh for part in self._parts if part.light < 0]
        if not meshes:
            return 0.0, 0.0
        corners = np.concatenate([mesh.vertices[mesh.triangles] for mesh in meshes])
        diagonal = np.linalg.norm(np.ptp(corners.reshape(-1, 3), axis=0))
        return float(diagonal), place.nearest_distance(corners, position)

    def _without_degenerate(self, table: Table, key: str, mesh: Mesh) -> Mesh:
        """The mesh without triangles of no area; these are counted under `table`."""
        n_triangles = len(mesh.triangles)
        try:
            mesh, dropped = geometry.drop_degenerate(mesh)
        except ValueError as error:
            raise table.error(key, str(error)) from error
        _, others, total = self._dropped.get((table.where, key), (table, 0, 0))
        self._dropped[table.where, key] = (table, others + dropped, total + n_triangles)
        return mesh

    def _placed(self) -> tuple[NDArray[np.float64], list[Mesh]]:
        """The scene's origin, and the meshes about it, in steps of single precision."""
        surfaces = [part.mesh for part in self._parts if part.light < 0]
        meshes = surfaces or [part.mesh for part in self._parts]
        corners = np.concatenate([mesh.vertices[mesh.triangles] for mesh in meshes])
        origin = place.scene_origin(corners, self.camera)
        placed = []
        camera = place.moved(self.camera, origin)
        for part in self._parts:
            if part.advice and place.is_coarse(part.mesh):
                self.warn(
                    part.table,
                    part.key,
                    "its coordinates are in single precision and so large that they are coarse; "
                    + part.advice,
                )
            mesh = replace(part.mesh, vertices=part.mesh.vertices - origin)
            mesh = place.cut_huge(mesh, camera)
            placed.append(self._without_degenerate(part.table, part.key, mesh))
        self._report_dropped()
        return origin, placed

    def _report_dropped(self) -> None:
        """Say how many degenerate triangles were dropped; raise `SceneError` where nothing is left.

        A mesh without area is an error unless there are others: exporters write such meshes, a line of
        a scene file that describes one is a slip.
        """
        of_meshes = [(d, n) for (where, _), (_, d, n) in self._dropped.items() if _is_mesh(where)]
        others = any(dropped < total for dropped, total in of_meshes)
        for (where, key), (table, dropped, total) in self._dropped.items():
            if dropped == total and not (others and _is_mesh(where)):
                raise table.error(key, "has no area: all its triangles are degenerate")
            if dropped == total:
                self.warn(table, key, "has no area and is left out: all its triangles are degenerate")
            elif dropped:
                message = f"dropped {dropped} degenerate of {total} triangles (they have no area)"
                self.warn(table, key, message)

    def scene(self, name: str, path: Path | None) -> Scene:
        """All of it, moved to where single precision is finest; it must not be empty."""
        origin, meshes = self._placed()
        camera = place.moved(self.camera, origin)
        lights = [light.moved(origin) for light in self._lights]
        vertices = np.concatenate([mesh.vertices for mesh in meshes])
        pixels = place.unresolved_steps(vertices, origin, camera)
        if pixels:
            self.warnings.append(
                f"{self._source}: single precision cannot resolve the scene: what it rounds makes "
                f"{pixels:.2g} pixels of a picture of {place.PIXELS} rows; shadows may be missing "
                "or wrong. Move the camera closer and widen its field of view, or leave out what is far "
                "away"
            )
        around = self.environment
        firsts = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes])
        triangles = [mesh.triangles + first for mesh, first in zip(meshes, firsts[:-1], strict=True)]
        counts = [len(mesh.triangles) for mesh in meshes]
        material, light = np.array([(part.material, part.light) for part in self._parts], np.int32).T
        ends = np.cumsum([0, *counts]).tolist()
        named = [
            (name, range(first, last))
            for part, first, last in zip(self._parts, ends[:-1], ends[1:], strict=True)
            for name in self._names(part.table)
        ]
        scene = Scene(
            name=name,
            path=path,
            camera=camera,
            materials=tuple(self.materials),
            lights=tuple(lights),
            vertices=vertices.astype(np.float32),
            vertex_normals=np.concatenate([mesh.normals for mesh in meshes]).astype(np.float32),
            triangles=np.concatenate(triangles).astype(np.uint32),
            triangle_material=np.repeat(material, counts),
            triangle_light=np.repeat(light, counts),
            warnings=tuple(self.warnings),
            origin=origin,
            named=tuple(named),
            vertex_uv=_joined([mesh.uv for mesh in meshes], meshes, (0.0, 0.0)),
            vertex_colours=_joined([mesh.colours for mesh in meshes], meshes, (1.0, 1.0, 1.0)),
            environment=None if around is None or around.is_black else around,
        )
        for array in vars(scene).values():
            if isinstance(array, np.ndarray):
                array.setflags(write=False)
        return scene


def _joined(
    rows: list[NDArray[np.float64] | None], meshes: list[Mesh], absent: tuple[float, ...]
) -> NDArray[np.float32] | None:
    """What vertices of all meshes carry, `absent` those of some; None if none carries anything."""
    if all(one is None for one in rows):
        return None
    filled = [
        np.tile(absent, (len(mesh.vertices), 1)) if one is None else one
        for one, mesh in zip(rows, meshes, strict=True)
    ]
    return np.concatenate(filled).astype(np.float32)


def _is_mesh(where: str) -> bool:
    """Whether a table's place is that of a mesh, a file's or given as arrays."""
    return where.startswith("meshes[")


def read_camera(root: Table) -> Camera:
    """The table ``camera``, checked."""
    keys = ("position", "target", "up", "vertical_fov")
    table = Table(root.source, "camera", root.raw("camera"), keys)
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
    return Camera(position, target, vertical_fov, up=up)


def read_materials(root: Table, images: ImageFiles) -> list[Material]:
    """The tables of ``materials`` in their order, checked."""
    if "materials" not in root:
        return []
    names = root.raw("materials")
    if not isinstance(names, dict):
        raise root.error("materials", "expected tables [materials.NAME]")
    materials = []
    for name, data in names.items():
        where = f"materials.{name}"
        keys = ("albedo", "reflectance", "roughness", "emission", "opacity", "normal", "maps")
        maps, table = read_maps(Table(root.source, where, data, (*keys, *GLASS_KEYS)), images)
        glass = read_glass(table)
        albedo = table.colour("albedo", default=0.0 if glass else None, high=1.0)
        reflectance = table.colour("reflectance", default=0.0, high=1.0)
        usual = SMALLEST_ROUGHNESS if glass else 1.0
        roughness = table.number("roughness", usual, SMALLEST_ROUGHNESS, 1.0)
        emission = table.colour("emission", default=0.0)
        material = Material(albedo, reflectance, roughness, emission, maps, name=name, **glass)
        check_glass(table, material)
        materials.append(material)
    return materials


def add_environment(root: Table, folder: Path, reach: Reach, assembly: Assembly) -> None:
    """Check the table ``environment``, and take it; files are relative to `folder`."""
    assembly.environment, warnings = read_environment(root, folder, reach)
    assembly.warnings += warnings
