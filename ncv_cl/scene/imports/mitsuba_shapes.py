"""Shapes of Mitsuba as a scene file's quads, spheres and meshes, and their area lights."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ..geometry import averaged_normals, sphere_mesh
from ..meshes.common import Notes
from .mitsuba_materials import Materials
from .mitsuba_texture import Textures
from .mitsuba_xml import Plugin
from .serialized import read_serialized

# A circle of so many sides, and a sphere of 20 · 4⁴ triangles, are nowhere off by a thousandth of their
# radius.
_SIDES, _SUBDIVISIONS = 72, 4
# Instances of instances end here.
_DEEPEST = 16
# The corners of a cube's sides as Mitsuba has them: (u, v) = (0, 1), (1, 1), (1, 0), (0, 0).
_CUBE = np.array(
    [
        [[1, -1, -1], [1, -1, 1], [-1, -1, 1], [-1, -1, -1]],
        [[1, 1, -1], [-1, 1, -1], [-1, 1, 1], [1, 1, 1]],
        [[1, -1, -1], [1, 1, -1], [1, 1, 1], [1, -1, 1]],
        [[1, -1, 1], [1, 1, 1], [-1, 1, 1], [-1, -1, 1]],
        [[-1, -1, 1], [-1, 1, 1], [-1, 1, -1], [-1, -1, -1]],
        [[1, 1, -1], [1, -1, -1], [-1, -1, -1], [-1, 1, -1]],
    ],
    dtype=np.float64,
)
_EMITS_BOTH = "meshes that emit do so from both sides"
_BLACK = "surfaces of lights reflect nothing"
Entry = dict[str, Any]


class Shapes:
    """Collects shapes.

    Attributes
    ----------
    tables : dict of str to list of dict
        A scene file's ``quads``, ``spheres`` and ``meshes``.
    lights : list of dict
        Its ``lights``.
    """

    def __init__(self, textures: Textures, materials: Materials, notes: Notes) -> None:
        self.tables: dict[str, list[Entry]] = {"quads": [], "spheres": [], "meshes": []}
        self.lights: list[Entry] = []
        self._textures = textures
        self._materials = materials
        self._notes = notes

    def add(self, shape: Plugin, placement: np.ndarray, depth: int = 0) -> None:
        """Add a shape that `placement` (4, 4) moves once it has its own place."""
        if shape.kind == "shapegroup":
            return
        matrix = placement @ np.asarray(shape.values.get("to_world", np.eye(4)), dtype=np.float64)
        self._check(matrix, shape)
        if shape.kind == "instance":
            self._instance(shape, matrix, depth)
            return
        read = getattr(self, f"_{shape.kind}", None)
        if read is None or shape.kind in ("instance", "shape"):
            self._notes.shape(f"shapes of the kind {shape.kind} are left out", shape.name)
            return
        emitters = shape.parts("emitter")
        emission = self._emission(emitters[0]) if emitters else None
        bsdf = next(iter(shape.parts("bsdf")), None)
        read(shape, matrix, bsdf, emission)

    @staticmethod
    def _check(matrix: np.ndarray, shape: Plugin) -> None:
        if not np.isfinite(matrix).all():
            raise ValueError(f"the transform of the shape {shape.name or shape.kind} is not finite")

    def _instance(self, shape: Plugin, matrix: np.ndarray, depth: int) -> None:
        if depth > _DEEPEST:
            raise ValueError("shapes are instances of each other")
        for group in shape.parts("shape"):
            for child in group.parts("shape"):
                self.add(child, matrix, depth + 1)

    def _emission(self, emitter: Plugin) -> tuple[float, ...]:
        if emitter.kind != "area":
            raise ValueError(f"a shape emits as {emitter.kind}, and area is read")
        radiance = emitter.values.get("radiance", 1.0)
        if isinstance(radiance, Plugin) and radiance.kind == "bitmap":
            self._notes.look("images of lights are not read, their mean stands for them", emitter.name)
        return tuple(float(x) for x in np.broadcast_to(self._textures.mean(radiance), 3))

    def _material(
        self, bsdf: Plugin | None, emission: tuple[float, ...] | None, downwards: bool = True
    ) -> str | None:
        if emission is not None and any(emission):
            self._notes.look(_EMITS_BOTH, "" if bsdf is None else bsdf.name)
        name = self._materials.name_of(bsdf, downwards, emission)
        if name is None and emission is not None:
            # What is not there but for its light is black.
            name = self._materials.name_of(_BLACK_BSDF, downwards, emission)
        return name

    def _light(self, entry: Entry, bsdf: Plugin | None) -> None:
        if self._materials.reflects(bsdf):
            self._notes.look(_BLACK, "" if bsdf is None else bsdf.name)
        self.lights.append(entry)

    # ---- shapes --------------------------------------------------------------------------------------

    def _rectangle(self, shape: Plugin, matrix: np.ndarray, bsdf: Any, emission: Any) -> None:
        corner = matrix[:3] @ [-1.0, -1.0, 0.0, 1.0]
        edges = [2.0 * matrix[:3, 0], 2.0 * matrix[:3, 1]]
        if emission is not None:
            edges = edges[::-1] if _is_turned(shape, matrix) else edges
            self._light(_quad(corner, *edges) | {"radiance": list(emission)}, bsdf)
            return
        material = self._materials.name_of(bsdf, True)
        if material is not None:
            self.tables["quads"].append(_quad(corner, *edges) | {"material": material})

    def _cube(self, shape: Plugin, matrix: np.ndarray, bsdf: Any, emission: Any) -> None:
        # Fronts face outwards: of a mirrored cube, v goes along the second edge as Mitsuba's does.
        mirrored = bool(np.linalg.det(matrix[:3, :3]) < 0.0)
        material = self._material(bsdf, emission, downwards=mirrored)
        order = [3, 2, 0] if mirrored else [0, 1, 3]
        for side in _CUBE[:, order] if material is not None else ():
            corner, along_u, along_v = side @ matrix[:3, :3].T + matrix[:3, 3]
            quad = _quad(corner, along_u - corner, along_v - corner)
            self.tables["quads"].append(quad | {"material": material})

    def _sphere(self, shape: Plugin, matrix: np.ndarray, bsdf: Any, emission: Any) -> None:
        radius = float(shape.values.get("radius", 1.0))
        centre = np.asarray(shape.values.get("center", np.zeros(3)), dtype=np.float64)
        scale = _similarity(matrix)
        if emission is not None and scale is not None and not shape.values.get("flip_normals", False):
            place = (matrix[:3, :3] @ centre + matrix[:3, 3]).tolist()
            light = {"kind": "sphere", "centre": place, "radius": scale * radius}
            self._light(light | {"radiance": list(emission)}, bsdf)
            return
        material = self._material(bsdf, emission, downwards=False)
        if material is None:
            return
        if scale is not None and not self._is_textured(material):
            place = (matrix[:3, :3] @ centre + matrix[:3, 3]).tolist()
            entry = {"center": place, "radius": scale * radius, "subdivisions": _SUBDIVISIONS}
            self.tables["spheres"].append(entry | {"material": material})
            return
        mesh = sphere_mesh(np.zeros(3), 1.0, _SUBDIVISIONS, textured=True)
        # Ours has its poles on y and begins at z; Mitsuba's on z and begins at x.
        vertices = centre + radius * mesh.vertices[:, [2, 0, 1]]
        uv = None if mesh.uv is None else mesh.uv - [0.5, 0.0]
        self._mesh(vertices, mesh.triangles, matrix, material, mesh.normals[:, [2, 0, 1]], uv)

    def _disk(self, shape: Plugin, matrix: np.ndarray, bsdf: Any, emission: Any) -> None:
        scale = _similarity(matrix)
        if emission is not None and scale is not None:
            normal = np.cross(matrix[:3, 0], matrix[:3, 1])
            normal = -normal if _is_turned(shape, matrix) else normal
            light = {"kind": "disc", "centre": matrix[:3, 3].tolist(), "radius": scale}
            light |= {"normal": (normal / np.linalg.norm(normal)).tolist()}
            self._light(light | {"radiance": list(emission)}, bsdf)
            return
        material = self._material(bsdf, emission)
        if material is None:
            return
        angle, circle = _circle()
        rim = np.column_stack([circle, np.zeros(len(circle))])
        vertices = np.concatenate([np.zeros((_SIDES, 3)), rim])
        middle = np.column_stack([np.zeros(_SIDES), angle[:-1] + math.pi / _SIDES])
        uv = np.concatenate([middle, np.column_stack([np.ones(len(angle)), angle])])
        first = np.arange(_SIDES)
        triangles = np.stack([first, _SIDES + first, _SIDES + first + 1], axis=1)
        self._mesh(vertices, triangles, matrix, material, None, uv * [1.0, 0.5 / math.pi])

    def _cylinder(self, shape: Plugin, matrix: np.ndarray, bsdf: Any, emission: Any) -> None:
        start, end = (
            np.asarray(shape.values.get(key, default), dtype=np.float64)
            for key, default in (("p0", [0.0, 0.0, 0.0]), ("p1", [0.0, 0.0, 1.0]))
        )
        radius, axis = float(shape.values.get("radius", 1.0)), end - start
        material = self._material(bsdf, emission)
        if material is None:
            return
        if not (np.isfinite(axis).all() and axis.any()):
            raise ValueError("a cylinder has no length")
        one, two = _across(axis / np.linalg.norm(axis))
        angle, circle = _circle()
        outwards = circle @ np.stack([one, two])
        vertices = np.concatenate([start + radius * outwards, end + radius * outwards])
        uv = np.concatenate(
            [np.column_stack([angle / (2 * math.pi), np.full(len(angle), v)]) for v in (0, 1)]
        )
        first, count = np.arange(_SIDES), len(angle)
        low = np.stack([first, first + 1, first + 1 + count], axis=1)
        high = np.stack([first, first + 1 + count, first + count], axis=1)
        normals = np.concatenate([outwards, outwards])
        self._mesh(vertices, np.concatenate([low, high]), matrix, material, normals, uv)

    def _obj(self, shape: Plugin, matrix: np.ndarray, bsdf: Any, emission: Any) -> None:
        # Its loader turns the file's v over, unless it is asked not to.
        flipped = shape.values.get("flip_tex_coords", shape.kind == "obj")
        name = str(shape.values.get("filename", ""))
        file = self._textures.file(name)
        if file is None:
            raise ValueError(f"the mesh file {name!r} of a shape does not exist")
        material = self._material(bsdf, emission, downwards=not flipped)
        if material is not None:
            entry: Entry = {"file": file, "material": material}
            if not np.array_equal(matrix, np.eye(4)):
                entry["transform"] = matrix.tolist()
            # What has no normals is shaded smoothly.
            entry["smooth"] = not shape.values.get("face_normals", False)
            self.tables["meshes"].append(entry)

    _ply = _obj

    def _serialized(self, shape: Plugin, matrix: np.ndarray, bsdf: Any, emission: Any) -> None:
        name = str(shape.values.get("filename", ""))
        file = self._textures.file(name)
        if file is None:
            raise ValueError(f"the mesh file {name!r} of a shape does not exist")
        mesh = read_serialized(self._textures.folder / file, int(shape.values.get("shape_index", 0)))
        material = self._material(bsdf, emission)
        if material is None:
            return
        flat = mesh.flat or bool(shape.values.get("face_normals", False))
        normals = mesh.normals
        if normals is None:
            normals = averaged_normals(mesh.vertices, mesh.triangles)
        self._mesh(mesh.vertices, mesh.triangles, matrix, material, None if flat else normals, mesh.uv)

    def _is_textured(self, material: str) -> bool:
        return any(isinstance(value, dict) for value in self._materials.tables[material].values())

    def _mesh(
        self,
        vertices: np.ndarray,
        triangles: np.ndarray,
        matrix: np.ndarray,
        material: str,
        normals: np.ndarray | None,
        uv: np.ndarray | None,
    ) -> None:
        """A mesh of arrays, moved to its place."""
        linear = matrix[:3, :3]
        if abs(np.linalg.det(linear)) <= 1e-12 * max(np.abs(linear).max(), 1e-300) ** 3:
            self._notes.shape("shapes that their transform flattens are left out", material)
            return
        entry: Entry = {"vertices": vertices @ linear.T + matrix[:3, 3], "triangles": triangles}
        if normals is not None:
            entry["normals"] = normals @ np.linalg.inv(linear)
        if uv is not None and self._is_textured(material):
            entry["uv"] = uv
        if np.linalg.det(linear) < 0.0:
            entry["triangles"] = triangles[:, ::-1]
        self.tables["meshes"].append(entry | {"material": material})


_BLACK_BSDF = Plugin(
    "bsdf", "twosided", "black", children=[Plugin("bsdf", "diffuse", "", {"reflectance": 0.0})]
)


def _is_turned(shape: Plugin, matrix: np.ndarray) -> bool:
    """Whether Mitsuba's normal, that of +z, is against the cross product of the images of x and y."""
    mirrored = bool(np.linalg.det(matrix[:3, :3]) < 0.0)
    return mirrored != bool(shape.values.get("flip_normals", False))


def _across(normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors across a third, as Mitsuba chooses them (Duff et al. 2017)."""
    x, y, z = normal
    sign = math.copysign(1.0, z)
    a = -1.0 / (sign + z)
    b = x * y * a
    return np.array([1.0 + sign * x * x * a, sign * b, -sign * x]), np.array([b, sign + y * y * a, -y])


def _circle() -> tuple[np.ndarray, np.ndarray]:
    """Angles (n + 1,) around a circle, the first again as the last, and its points (n + 1, 2)."""
    angle = np.linspace(0.0, 2.0 * math.pi, _SIDES + 1)
    return angle, np.stack([np.cos(angle), np.sin(angle)], axis=1)


def _similarity(matrix: np.ndarray) -> float | None:
    """By how much an affine map (4, 4) scales, if alike in all directions."""
    square = matrix[:3, :3].T @ matrix[:3, :3]
    scale = float(np.trace(square)) / 3.0
    if not (scale > 0.0 and np.abs(square - scale * np.eye(3)).max() <= 1e-6 * scale):
        return None
    return math.sqrt(scale)


def _quad(corner: np.ndarray, edge1: np.ndarray, edge2: np.ndarray) -> Entry:
    names = ("corner", "edge1", "edge2")
    return {name: vector.tolist() for name, vector in zip(names, (corner, edge1, edge2), strict=True)}
