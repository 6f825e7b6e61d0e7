"""glTF 2.0 (.gltf and .glb): the triangles of a scene in its rest pose."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from .common import (
    Asked,
    Colour,
    FileGeometry,
    FileMaterial,
    Indices,
    Notes,
    Vectors,
    check_triangles,
    constant_or_varying,
    three,
)
from .gltf_buffers import Container
from .gltf_lights import EXTENSION, light_index, read_light
from .gltf_material import coordinate_set, material_name, read_material
from .gltf_pose import Nodes, shown_nodes, skinned
from .polygons import strip_triangles

_READ = {"KHR_mesh_quantization", "EXT_mesh_gpu_instancing", "KHR_node_visibility", EXTENSION}
# Extensions that change looks only: a material says which of them it has.
_LOOKS = ("KHR_materials_", "KHR_texture_", "EXT_texture_", "MSFT_texture_", "EXT_materials_")
_COMPRESSION = "KHR_draco_mesh_compression"
_MODES = {0: "points", 1: "lines", 2: "lines", 3: "lines"}
_TRIANGLES, _STRIP, _FAN = 4, 5, 6


def read_gltf(path: Path, notes: Notes, asked: Asked) -> list[FileGeometry]:
    """Read what the file's default scene shows, else its first, else all root nodes.

    Every primitive gives one geometry for each of its places; lights go into `Notes.lights`.

    Raises
    ------
    ValueError
        If the file or one of its buffers cannot be read, an index or a position is wrong, or it
        needs an extension that is not read.
    """
    container = Container(path, asked.images.reach)
    tree = container.tree
    for extension in tree.get("extensionsRequired", []):
        if extension not in _READ and not extension.startswith(_LOOKS):
            raise ValueError(
                f"requires the extension {extension}, which is not read: export the file without it"
            )
    for extension in tree.get("extensionsUsed", []):
        if not (extension in _READ or extension == _COMPRESSION or extension.startswith(_LOOKS)):
            notes.shape("extensions that are not read", extension)
    for animation in tree.get("animations", []):
        notes.shape("animations are left out, the rest pose is shown", animation.get("name", ""))
    return _Scene(container, notes, asked).geometries()


class _Scene:
    """Collects the primitives of the nodes that are shown."""

    def __init__(self, container: Container, notes: Notes, asked: Asked) -> None:
        self._container = container
        self._asked = asked
        self._notes = notes
        self._nodes = Nodes(container)
        self._primitives: dict[tuple[object, ...], list[tuple[dict[str, Any], FileGeometry]]] = {}
        self._materials: dict[tuple[object, ...], FileMaterial] = {}
        self._seen: set[int] = set()

    def geometries(self) -> list[FileGeometry]:
        found: list[FileGeometry] = []
        if not self._container.tree.get("nodes"):
            for index in range(len(self._container.tree.get("meshes", []))):
                self._notes.shape("meshes that no node places stand where they were made", "")
                found += [geometry for _, geometry in self._mesh(index, None)]
        for index in shown_nodes(self._container, self._nodes, self._notes):
            node = self._container.entry("nodes", index)
            if "mesh" in node:
                found += self._placed(index, node)
            light = light_index(node)
            if light is not None:
                world = self._nodes.world(index)
                self._notes.lights.append(read_light(self._container, light, world, self._notes))
        return found

    def _placed(self, index: int, node: dict[str, Any]) -> list[FileGeometry]:
        """The primitives of a node's mesh where the node, or the skin it follows, puts them."""
        name = node.get("name", f"nodes[{index}]")
        primitives = self._mesh(node["mesh"], node.get("weights"))
        if "skin" not in node:
            places = self._nodes.instances(index)
            return [replace(g, transform=m, name=name) for m in places for _, g in primitives]
        matrices = self._nodes.joint_matrices(node["skin"])
        found = []
        for attributes, geometry in primitives:
            sets = sorted(key.split("_")[1] for key in attributes if key.startswith("JOINTS_"))
            if not sets:
                raise ValueError(f"{geometry.name} has no joints, but {name} has a skin")
            joints, weights = (
                np.concatenate([self._container.array(attributes[f"{kind}_{n}"]) for n in sets], axis=1)
                for kind in ("JOINTS", "WEIGHTS")
            )
            vertices, normals = skinned(
                geometry.vertices, geometry.normals, joints.astype(np.int64), weights, matrices
            )
            found.append(replace(geometry, vertices=vertices, normals=normals, name=name))
        return found

    def _mesh(
        self, index: int, weights: list[float] | None
    ) -> list[tuple[dict[str, Any], FileGeometry]]:
        """Attributes and geometry of every primitive that has triangles."""
        mesh = self._container.entry("meshes", index)
        weights = weights or mesh.get("weights")
        posed = (index, *(weights or ()))
        if posed in self._primitives:
            return self._primitives[posed]
        found = []
        for i, primitive in enumerate(mesh["primitives"]):
            name = f"{mesh.get('name', f'meshes[{index}]')}.primitives[{i}]"
            mode = primitive.get("mode", _TRIANGLES)
            if mode in _MODES:
                self._notes.shape("lines and points are left out", f"{_MODES[mode]} in {name}")
            elif "POSITION" not in primitive["attributes"]:
                self._notes.shape("primitives without positions are left out", name)
            else:
                geometry = self._primitive(primitive, mode, weights, name)
                found.append((primitive["attributes"], geometry))
        self._primitives[posed] = found
        return found

    def _primitive(
        self, primitive: dict[str, Any], mode: int, weights: list[float] | None, name: str
    ) -> FileGeometry:
        attributes = primitive["attributes"]
        accessor = self._container.entry("accessors", attributes["POSITION"])
        if _COMPRESSION in primitive.get("extensions", {}) and "bufferView" not in accessor:
            raise ValueError(
                f"{name} is compressed by {_COMPRESSION}, which is not read: export the file without it"
            )
        vertices = self._vectors(primitive, "POSITION", weights, name)
        normals = None
        if "NORMAL" in attributes:
            normals = self._vectors(primitive, "NORMAL", weights, name)
            normals = np.where(np.isfinite(normals), normals, 0.0)
            if len(normals) != len(vertices):
                raise ValueError(f"{name} has {len(normals)} normals for {len(vertices)} positions")
        if "indices" in primitive:
            stored = self._container.array(primitive["indices"], decode=False)
            indices = stored[:, 0].astype(np.int64)
        else:
            indices = np.arange(len(vertices))
        triangles = _triangles(indices, mode, name)
        check_triangles(vertices, triangles, name)
        material, colours = self._material(primitive, triangles, name)
        uv = self._coordinates(primitive, material, len(vertices), name)
        return FileGeometry(vertices, triangles, normals, material, name=name, uv=uv, colours=colours)

    def _vectors(
        self, primitive: dict[str, Any], key: str, weights: list[float] | None, name: str
    ) -> Vectors:
        """An attribute of three components, moved by the morph targets that have a weight."""
        values = self._container.array(primitive["attributes"][key])
        if values.shape[1] != 3:
            raise ValueError(f"{name}: {key} has {values.shape[1]} components, not 3")
        for weight, target in zip(weights or [], primitive.get("targets", []), strict=False):
            if weight and key in target:
                values = values + weight * self._container.array(target[key])
        return values

    def _material(
        self, primitive: dict[str, Any], triangles: Indices, name: str
    ) -> tuple[FileMaterial | None, Vectors | None]:
        """The primitive's material, and the colours of vertices that multiply it."""
        index = primitive.get("material")
        tint: Colour | None = (1.0, 1.0, 1.0)
        colours: Vectors | None = None
        if "COLOR_0" in primitive["attributes"] and len(triangles):
            stored = self._container.array(primitive["attributes"]["COLOR_0"], decode=False)
            scale = np.iinfo(stored.dtype).max if stored.dtype.kind in "iu" else 1.0
            tint, colours = constant_or_varying(stored[:, :3].astype(np.float64) / scale, triangles)
            if index is None:
                return FileMaterial(name, tint or three(1.0), three(0.0), 1.0), colours
        if index is None:
            return None, None
        if (index, tint) not in self._materials:
            notes = Notes() if index in self._seen else self._notes
            self._seen.add(index)
            own_name = material_name(self._container, index)
            self._materials[index, tint] = read_material(
                self._container, index, tint, own_name, notes, self._asked
            )
        return self._materials[index, tint], colours

    def _coordinates(
        self, primitive: dict[str, Any], material: FileMaterial | None, count: int, name: str
    ) -> Vectors | None:
        """The texture coordinates that are asked for, (count, 2), v upwards; None if there are none."""
        number = 0
        if not self._asked.coordinates:
            if material is None or material.maps is None:
                return None
            number = coordinate_set(self._container, primitive["material"])
        key = f"TEXCOORD_{number}"
        if key not in primitive["attributes"]:
            return None
        stored = self._container.array(primitive["attributes"][key])
        if stored.shape != (count, 2):
            raise ValueError(f"{name}: {key} is {stored.shape}, not ({count}, 2)")
        return np.stack([stored[:, 0], 1.0 - stored[:, 1]], axis=1)


def _triangles(indices: Indices, mode: int, name: str) -> Indices:
    """Triangles (n, 3) of a list, a strip or a fan of indices."""
    if mode == _TRIANGLES:
        if len(indices) % 3:
            raise ValueError(f"{name} has {len(indices)} indices, which are no whole triangles")
        return indices.reshape(-1, 3)
    if mode == _STRIP:
        return strip_triangles(indices)
    if mode != _FAN:
        raise ValueError(f"{name} has the unknown mode {mode}")
    if len(indices) < 3:
        return np.zeros((0, 3), dtype=np.int64)
    rest = np.stack([indices[1:-1], indices[2:]], axis=1)
    return np.column_stack([np.full(len(rest), indices[0]), rest])
