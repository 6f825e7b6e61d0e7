"""The tables ``[[lights]]`` of a scene, each of a kind, become its lights."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ..assembly import Assembly
from ..model import Camera, Light, Material, QuadLight
from ..sky.read import DIRECTIONAL, DIRECTIONAL_KEYS, directional, with_suns
from ..table import Table
from .kinds import SPHERE_SUBDIVISIONS, DiscLight, SphereLight, SpotLight

# Radius of lights whose own is not given, over the diagonal of the bounds of the scene's surfaces, and
# at most over the way to the nearest of these.
SMALL_RADIUS, CLEAR_OF_SURFACES = 1e-3, 0.5


def add_lights(root: Table, assembly: Assembly) -> None:
    """Check the tables of ``lights`` and append them, in their order."""
    every = {key for keys, _ in _KINDS.values() for key in keys} | set(DIRECTIONAL_KEYS)
    material, suns = -1, []
    for table in root.tables("lights", {"kind", *every}):
        kind = table.text("kind", "quad")
        if kind == DIRECTIONAL:
            suns.append(directional(table.only(DIRECTIONAL_KEYS)))
            continue
        if kind not in _KINDS:
            known = ", ".join((*_KINDS, DIRECTIONAL))
            raise table.error("kind", f"unknown kind of light {kind!r}; known kinds: {known}")
        if material < 0:
            black = np.zeros(3, dtype=np.float32)
            material = assembly.new_material(Material(black, name="light"))
        keys, read = _KINDS[kind]
        assembly.add_light(table, read(table.only({"kind", *keys}), assembly), material)
    assembly.environment = with_suns(root.source, assembly.environment, suns)


def _quad(table: Table, _: Assembly) -> Light:
    corner, edge1, edge2 = (table.vector(key) for key in ("corner", "edge1", "edge2"))
    for key, edge in (("edge1", edge1), ("edge2", edge2)):
        if not np.any(edge):
            raise table.error(key, "light has no area (the edge has no length)")
    area = np.linalg.norm(np.cross(edge1, edge2))
    if area <= 1e-6 * np.linalg.norm(edge1) * np.linalg.norm(edge2):
        raise table.error("edge2", "light has no area (edge1 and edge2 are parallel)")
    two_sided = bool(table.flag("two_sided", False))
    return QuadLight(corner, edge1, edge2, table.colour("radiance"), two_sided)


def _disc(table: Table, _: Assembly) -> Light:
    two_sided = bool(table.flag("two_sided", False))
    return DiscLight(
        table.vector("centre"),
        _axis(table, "normal"),
        _radius(table),
        table.colour("radiance"),
        two_sided,
    )


def _sphere(table: Table, assembly: Assembly) -> Light:
    centre, radius = table.vector("centre"), _radius(table)
    _check_camera(table, "radius", assembly.camera, centre, radius)
    subdivisions = table.integer("subdivisions", SPHERE_SUBDIVISIONS, 0, 7)
    return SphereLight(centre, radius, table.colour("radiance"), subdivisions)


def _point(table: Table, assembly: Assembly) -> Light:
    position, intensity = table.vector("position"), table.colour("intensity")
    radius = _small_radius(table, position, assembly)
    radiance = (intensity / (np.pi * radius**2)).astype(np.float32)
    return SphereLight(position, radius, _finite(table, radiance), subdivisions=0)


def _spot(table: Table, assembly: Assembly) -> Light:
    position, intensity = table.vector("position"), table.colour("intensity")
    if ("direction" in table) == ("target" in table):
        raise table.error("direction", "give either direction or target")
    direction = table.vector("direction") if "direction" in table else table.vector("target") - position
    if not np.any(direction):
        key = "direction" if "direction" in table else "target"
        raise table.error(key, "leaves the axis of the beam without a direction")
    outer = table.number("outer_angle")
    if not 0.0 < outer <= 180.0:
        raise table.error(
            "outer_angle", f"{outer} is out of range; it must be above 0, at most 180 degrees"
        )
    inner = table.number("inner_angle", 0.75 * outer, 0.0, outer)
    radius = _small_radius(table, position, assembly)
    light = SpotLight(
        position, intensity, direction=direction / np.linalg.norm(direction), outer_angle=outer,
        inner_angle=inner, radius=radius,
    )  # fmt: skip
    _finite(table, light.radiance)
    return light


# What tables of each kind may hold beside it, and what reads them.
_KINDS: dict[str, tuple[tuple[str, ...], Callable[[Table, Assembly], Light]]] = {
    "quad": (("corner", "edge1", "edge2", "radiance", "two_sided"), _quad),
    "disc": (("centre", "normal", "radius", "radiance", "two_sided"), _disc),
    "sphere": (("centre", "radius", "radiance", "subdivisions"), _sphere),
    "point": (("position", "intensity", "radius"), _point),
    "spot": (
        ("position", "direction", "target", "intensity", "inner_angle", "outer_angle", "radius"),
        _spot,
    ),
}


def _axis(table: Table, key: str) -> NDArray[np.float64]:
    axis = table.vector(key)
    if not np.any(axis):
        raise table.error(key, "is zero, so it has no direction")
    return axis / np.linalg.norm(axis)


def _radius(table: Table) -> float:
    radius = table.number("radius")
    if not radius > 0.0:
        raise table.error("radius", f"{radius} is out of range; it must be positive")
    return radius


def _small_radius(table: Table, position: NDArray[np.float64], assembly: Assembly) -> float:
    """The key ``radius``, or what stands for it."""
    if "radius" in table:
        radius = _radius(table)
    else:
        diagonal, nearest = assembly.surroundings(position)
        if not diagonal > 0.0:
            raise table.error("radius", "is missing; it is required where there are no surfaces")
        radius = SMALL_RADIUS * diagonal
        if nearest > 0.0:
            radius = min(radius, CLEAR_OF_SURFACES * nearest)
    _check_camera(table, "position", assembly.camera, position, radius)
    return radius


def _check_camera(
    table: Table, key: str, camera: Camera, centre: NDArray[np.float64], radius: float
) -> None:
    if np.linalg.norm(camera.position - centre) <= radius:
        raise table.error(
            key, f"the camera is inside this light, of radius {radius:g}, which shines outwards only"
        )


def _finite(table: Table, radiance: NDArray[np.float32]) -> NDArray[np.float32]:
    if not np.isfinite(radiance).all():
        raise table.error("radius", "is so small that the light's radiance is beyond float32")
    return radiance
