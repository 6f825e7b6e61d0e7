"""Sensors of Mitsuba as a scene file's table ``camera``."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ..meshes.common import Notes
from ..meshes.gltf_camera import looking_at
from .mitsuba_xml import Plugin

_FILM = (768, 576)
# Half the diagonal of 35 mm film, which focal lengths are meant for.
_HALF_DIAGONAL = 0.5 * math.hypot(36.0, 24.0)


def read_sensor(sensor: Plugin, name: str, notes: Notes) -> dict[str, Any] | str:
    """A sensor's table, or why it has none."""
    if sensor.kind not in ("perspective", "thinlens"):
        return f"the camera {name} is of the kind {sensor.kind}, and perspective ones are read"
    if sensor.kind == "thinlens":
        notes.shape("lenses are pinholes, all is in focus", name)
    for key in ("principal_point_offset_x", "principal_point_offset_y"):
        if sensor.values.get(key, 0.0):
            notes.shape("cameras whose centre is off the picture's are centred", name)
    matrix = np.asarray(sensor.values.get("to_world", np.eye(4)), dtype=np.float64)
    determinant = np.linalg.det(matrix[:3, :3])
    if not (np.isfinite(matrix).all() and abs(determinant) > 1e-30):
        return f"the transform of the camera {name} flattens it"
    fov = _vertical_fov(sensor)
    if not 0.0 < fov < 180.0:
        return f"the camera {name} has a field of view of {fov:g} degrees"
    # It looks along its own +z, where +x is on the left.
    return looking_at(matrix[:3, 3], matrix[:3, 2], matrix[:3, 1], fov, determinant < 0.0, name, notes)


def _vertical_fov(sensor: Plugin) -> float:
    values = sensor.values
    films = sensor.parts("film")
    width, height = (
        float(films[0].values.get(key, default)) if films else float(default)
        for key, default in zip(("width", "height"), _FILM, strict=True)
    )
    if not (width > 0.0 and height > 0.0):
        raise ValueError("a film has no pixels")
    axis = values.get("fov_axis", "x")
    if "focal_length" in values or "fov" not in values:
        length = float(str(values.get("focal_length", "50mm")).removesuffix("mm"))
        half, axis = math.atan2(_HALF_DIAGONAL, length), "diagonal"
    else:
        half = math.radians(float(values["fov"])) / 2.0
    if axis in ("smaller", "larger"):
        axis = "y" if (axis == "smaller") == (height < width) else "x"
    along = {"x": width, "y": height, "diagonal": math.hypot(width, height)}
    if axis not in along:
        raise ValueError(f"a camera's fov_axis is {axis!r}")
    return math.degrees(2.0 * math.atan(math.tan(half) * height / along[axis]))
