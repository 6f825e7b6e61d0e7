"""Lights of glTF (KHR_lights_punctual) as tables of a scene file's ``lights``.

A light's number is taken for W/sr (point, spot: the file has candela) or W/m² (directional: the file has
lux), as Mitsuba's and Blender's numbers are: what a scene shows is in proportion either way.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from .common import Notes, Vectors
from .gltf_buffers import Container

EXTENSION = "KHR_lights_punctual"


def light_index(node: dict[str, Any]) -> object:
    """The index of a node's light; None if it has none."""
    return node.get("extensions", {}).get(EXTENSION, {}).get("light")


def read_light(container: Container, index: object, world: Vectors, notes: Notes) -> dict[str, Any]:
    """The table of light `index`, which its node's transform (4, 4) puts into the world.

    Raises
    ------
    ValueError
        If there is no such light, or it has a number that is none or an unknown type.
    """
    lights = container.tree.get("extensions", {}).get(EXTENSION, {}).get("lights", [])
    if not isinstance(index, int) or isinstance(index, bool) or not 0 <= index < len(lights):
        raise ValueError(f"the light {index} does not exist: the file has {len(lights)}")
    light = lights[index]
    what = str(light.get("name") or f"lights[{index}]")
    strength = _number(light, "intensity", 1.0, what)
    colour = [strength * _finite(c, what) for c in light.get("color", [1.0, 1.0, 1.0])]
    if len(colour) != 3 or min(colour) < 0.0:
        raise ValueError(f"the light {what} has no colour of three numbers from 0")
    position, direction = world[:3, 3].tolist(), _direction(world, what)
    if "range" in light:
        notes.shape("ranges of lights are not read, their light goes on", what)
    kind = light.get("type")
    if kind == "directional":
        return {"kind": kind, "direction": direction, "irradiance": colour}
    if kind == "point":
        return {"kind": kind, "position": position, "intensity": colour}
    if kind != "spot":
        raise ValueError(f"the light {what} is of the unknown type {kind!r}")
    cone = light.get("spot", {})
    inner = _number(cone, "innerConeAngle", 0.0, what)
    outer = _number(cone, "outerConeAngle", math.pi / 4, what)
    if not 0.0 <= inner < outer <= math.pi / 2 * (1.0 + 1e-6):
        raise ValueError(f"the light {what} has cones of {inner:g} and {outer:g} radians")
    angles = {"inner_angle": math.degrees(inner), "outer_angle": min(math.degrees(outer), 90.0)}
    return {"kind": kind, "position": position, "direction": direction, "intensity": colour} | angles


def placed(light: dict[str, Any], transform: Vectors) -> dict[str, Any]:
    """A light's table, moved by an affine transform (4, 4); what it emits stays."""
    moved = dict(light)
    if "position" in light:
        moved["position"] = (transform[:3, :3] @ light["position"] + transform[:3, 3]).tolist()
    if "direction" in light:
        moved["direction"] = (transform[:3, :3] @ light["direction"]).tolist()
    return moved


def _direction(world: Vectors, what: str) -> list[float]:
    """Where a light shines: along its node's -z."""
    direction = -world[:3, 2]
    length = np.linalg.norm(direction)
    if not (np.isfinite(world).all() and length > 0.0):
        raise ValueError(f"the node of the light {what} flattens it")
    return (direction / length).tolist()


def _number(table: dict[str, Any], key: str, default: float, what: str) -> float:
    return _finite(table.get(key, default), what)


def _finite(value: Any, what: str) -> float:
    number = float(value)
    if not math.isfinite(number):
        raise ValueError(f"the light {what} has a number that is not finite")
    return number
