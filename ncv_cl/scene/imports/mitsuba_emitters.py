"""Emitters of Mitsuba that are no shapes: punctual ones and environments."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from trimesh.transformations import rotation_matrix

from ..meshes.common import Notes
from .mitsuba_texture import Textures
from .mitsuba_xml import Plugin


class Emitters:
    """Collects emitters.

    Attributes
    ----------
    lights : list of dict
        A scene file's ``lights``.
    environment : dict or None
        Its ``environment``.
    """

    def __init__(self, textures: Textures, notes: Notes) -> None:
        self.lights: list[dict[str, Any]] = []
        self.environment: dict[str, Any] | None = None
        self._textures = textures
        self._notes = notes

    def add(self, emitter: Plugin) -> None:
        read = {
            "point": self._point,
            "spot": self._spot,
            "directional": self._directional,
            "constant": self._constant,
            "envmap": self._image,
        }.get(emitter.kind)
        if read is None:
            self._notes.shape(f"emitters of the kind {emitter.kind} are left out", emitter.name)
        else:
            read(emitter)

    def _point(self, emitter: Plugin) -> None:
        matrix = _matrix(emitter)
        position = np.asarray(emitter.values.get("position", matrix[:3, 3]), dtype=np.float64)
        intensity = self._power(emitter, "intensity")
        self.lights.append({"kind": "point", "position": position.tolist(), "intensity": intensity})

    def _spot(self, emitter: Plugin) -> None:
        if any(value.category == "texture" for value in emitter.parts("texture")):
            self._notes.shape("images of spots are left out", emitter.name)
        matrix = _matrix(emitter)
        outer = float(emitter.values.get("cutoff_angle", 20.0))
        inner = float(emitter.values.get("beam_width", 0.75 * outer))
        self.lights.append(
            {
                "kind": "spot",
                "position": matrix[:3, 3].tolist(),
                "direction": _unit(matrix[:3, 2]),
                "intensity": self._power(emitter, "intensity"),
                "inner_angle": inner,
                "outer_angle": outer,
            }
        )

    def _directional(self, emitter: Plugin) -> None:
        direction = emitter.values.get("direction", _matrix(emitter)[:3, 2])
        irradiance = self._power(emitter, "irradiance")
        light = {"kind": "directional", "direction": _unit(direction), "irradiance": irradiance}
        self.lights.append(light)

    def _constant(self, emitter: Plugin) -> None:
        self._set({"radiance": self._power(emitter, "radiance")}, emitter)

    def _image(self, emitter: Plugin) -> None:
        name = str(emitter.values.get("filename", ""))
        file = self._textures.file(name)
        if file is None:
            raise ValueError(f"the image {name!r} of the environment does not exist")
        table: dict[str, Any] = {"file": file, "scale": float(emitter.values.get("scale", 1.0))}
        matrix = _matrix(emitter)[:3, :3]
        if np.linalg.det(matrix) < 0.0:
            self._notes.shape("environments that are mirrored, which are not", name)
        up = np.array(_unit(matrix[:, 1]))
        if not np.allclose(up, [0.0, 1.0, 0.0], atol=1e-6):
            table["up"] = up.tolist()
        angle = rotation_about(up, matrix)
        if abs(angle) > 1e-6:
            table["rotation"] = angle
        self._set(table, emitter)

    def _set(self, table: dict[str, Any], emitter: Plugin) -> None:
        if self.environment is None:
            self.environment = table
        else:
            self._notes.shape("environments beyond the first are left out", emitter.kind)

    def _power(self, emitter: Plugin, key: str) -> list[float]:
        colour = np.broadcast_to(self._textures.mean(emitter.values.get(key, 1.0)), 3)
        scale = float(emitter.values.get("scale", 1.0))
        return (scale * np.asarray(colour, dtype=np.float64)).tolist()


def rotation_about(up: np.ndarray, matrix: np.ndarray) -> float:
    """By how many degrees, about `up`, a map (3, 3) goes on turning after y has been turned to `up`.

    The first turn is the shortest; `up` is where the map has y.
    """
    axis = np.cross([0.0, 1.0, 0.0], up)
    angle = math.atan2(float(np.linalg.norm(axis)), float(up[1]))
    shortest = rotation_matrix(angle, axis if axis.any() else [1.0, 0.0, 0.0])[:3, :3]
    start, forward = shortest[:, 2], matrix[:, 2] / np.linalg.norm(matrix[:, 2])
    return math.degrees(math.atan2(float(np.cross(start, forward) @ up), float(start @ forward)))


def _matrix(emitter: Plugin) -> np.ndarray:
    return np.asarray(emitter.values.get("to_world", np.eye(4)), dtype=np.float64)


def _unit(vector: Any) -> list[float]:
    vector = np.asarray(vector, dtype=np.float64)
    length = np.linalg.norm(vector)
    if not (np.isfinite(length) and length > 0.0):
        raise ValueError("a light has no direction")
    return (vector / length).tolist()
