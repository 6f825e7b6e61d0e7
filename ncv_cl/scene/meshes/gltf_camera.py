"""Cameras of glTF as a scene file's table ``camera``."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from ...host.reach import Reach
from .common import Notes, Vectors
from .gltf_buffers import Container
from .gltf_pose import Nodes, shown_nodes


def read_cameras(path: Path, reach: Reach, notes: Notes) -> list[tuple[str, dict[str, Any] | str]]:
    """The cameras of the nodes that a file shows, in their order.

    Returns
    -------
    list of (str, dict or str)
        A camera's name, its own or else its node's, and its table, or why it has none.

    Raises
    ------
    ValueError
        If the file is malformed.
    """
    container = Container(path, reach)
    nodes = Nodes(container)
    found = []
    for index in shown_nodes(container, nodes, Notes()):
        node = container.entry("nodes", index)
        if "camera" in node:
            camera = container.entry("cameras", node["camera"])
            name = camera.get("name") or node.get("name") or f"cameras[{node['camera']}]"
            found.append((str(name), _camera(camera, nodes.world(index), str(name), notes)))
    return found


def _camera(camera: dict[str, Any], world: Vectors, name: str, notes: Notes) -> dict[str, Any] | str:
    if camera.get("type") != "perspective":
        return f"the camera {name} is of the type {camera.get('type')!r}, and perspective ones are read"
    fov = math.degrees(float(camera["perspective"]["yfov"]))
    if not 0.0 < fov < 180.0:
        return f"the camera {name} has a field of view of {fov:g} degrees"
    if not np.isfinite(world).all() or abs(np.linalg.det(world[:3, :3])) < 1e-30:
        return f"the node of the camera {name} flattens it"
    return looking_at(world[:3, 3], -world[:3, 2], world[:3, 1], fov, _is_mirrored(world), name, notes)


def _is_mirrored(world: Vectors) -> bool:
    return bool(np.linalg.det(world[:3, :3]) < 0.0)


def looking_at(
    position: Vectors,
    forward: Vectors,
    up: Vectors,
    fov: float,
    mirrored: bool,
    name: str,
    notes: Notes,
) -> dict[str, Any]:
    """The table of a camera by the axes of its frame, of any length."""
    if mirrored:
        notes.shape("cameras that mirror the picture, which is shown unmirrored", name)
    # Far from the origin, a target a unit away would lose digits.
    distance = 1.0 + float(np.abs(position).max())
    target = position + forward / np.linalg.norm(forward) * distance
    return {
        "position": position.tolist(),
        "target": target.tolist(),
        "up": (up / np.linalg.norm(up)).tolist(),
        "vertical_fov": fov,
    }
