"""A mesh file as a scene: its own cameras and lights, or else suggested ones."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from .. import meshes
from ..meshes.common import Notes, sentences
from ..meshes.gltf_camera import read_cameras
from ..textures.image_file import ImageFiles
from .found import Found
from .suggest import camera_table, light_table

_GLTF = (".gltf", ".glb")
NO_CAMERA = "no camera: one that sees all of it from outside is taken"
NO_LIGHT = "no light: a square above it is added"


def mesh_scene(path: Path, images: ImageFiles, camera: str | None) -> Found:
    """The tables of a mesh file.

    Raises
    ------
    ValueError
        If the file cannot be read, or has no camera of that name.
    """
    found = meshes.read_meshes(path, np.eye(4), None, images)
    used = [item.mesh.vertices[item.mesh.triangles].reshape(-1, 3) for item in found.meshes]
    bounds = np.stack(
        [end([end(points, axis=0) for points in used], axis=0) for end in (np.min, np.max)]
    )
    notes = Notes()
    tables: dict[str, Any] = {"name": path.stem, "meshes": [{"file": path.name}]}
    own = read_cameras(path, images.reach, notes) if path.suffix.lower() in _GLTF else []
    said = []
    chosen = chosen_camera(own, camera)
    if chosen is None:
        said.append(NO_CAMERA)
    tables["camera"] = chosen or camera_table(bounds)
    emits = any(item.material is not None and any(item.material.emission) for item in found.meshes)
    if not (emits or found.lights):
        said.append(NO_LIGHT)
        tables["lights"] = [light_table(bounds)]
    return Found(tables, said + sentences(notes.geometry), found)


def chosen_camera(
    cameras: list[tuple[str, dict[str, Any] | str]], wanted: str | None
) -> dict[str, Any] | None:
    """The camera of that name, or the first; None where there are none.

    Raises
    ------
    ValueError
        If there is none of that name, or it cannot be read.
    """
    if not cameras and wanted is None:
        return None
    named = [camera for name, camera in cameras if wanted in (None, name)]
    if not named:
        known = ", ".join(dict(cameras)) or "none"
        raise ValueError(f"there is no camera {wanted!r}; its cameras: {known}")
    usable = [camera for camera in named if isinstance(camera, dict)]
    if not usable:
        raise ValueError(str(named[0]))
    return usable[0]
