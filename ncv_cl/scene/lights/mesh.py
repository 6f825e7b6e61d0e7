"""The triangles of lights: what rays meet, and the camera sees."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import trimesh
from numpy.typing import NDArray

from ..geometry import Mesh, flat_mesh, quad_mesh
from ..model import Light, QuadLight
from .kinds import DiscLight, SphereLight

# Corners of the polygon that stands for a disc.
DISC_CORNERS = 64


def light_mesh(light: Light) -> Mesh:
    """A light's triangles, in double precision; those of round ones have the round shape's area."""
    if isinstance(light, QuadLight):
        return replace(quad_mesh(light.corner, light.edge1, light.edge2), uv=None)
    if isinstance(light, DiscLight):
        return _disc_mesh(light)
    subdivisions = light.subdivisions if isinstance(light, SphereLight) else 0
    centre = light.centre if isinstance(light, SphereLight) else light.position
    unit = trimesh.creation.icosphere(subdivisions=subdivisions)
    return flat_mesh(centre + outer_radius(light.radius, subdivisions) * unit.vertices, unit.faces)


def outer_radius(radius: float, subdivisions: int) -> float:
    """Radius of the sphere about the icosahedron, so subdivided, that has a sphere's area."""
    return radius * _scale(subdivisions)


@cache
def _scale(subdivisions: int) -> float:
    return float(np.sqrt(4 * np.pi / trimesh.creation.icosphere(subdivisions=subdivisions).area))


def disc_axes(normal: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Two unit vectors that complete a normal of any length to a right-handed frame."""
    z = np.asarray(normal, np.float64) / np.linalg.norm(normal)
    x = np.cross(np.eye(3)[np.abs(z).argmin()], z)
    x /= np.linalg.norm(x)
    return x, np.cross(z, x)


def _disc_mesh(light: DiscLight) -> Mesh:
    x, y = disc_axes(light.normal)
    turn = 2 * np.pi / DISC_CORNERS
    angle = turn * np.arange(DISC_CORNERS)
    radius = light.radius * np.sqrt(turn / np.sin(turn))
    rim = light.centre + radius * (np.cos(angle)[:, None] * x + np.sin(angle)[:, None] * y)
    number = np.arange(DISC_CORNERS)
    fan = np.stack([np.full(DISC_CORNERS, DISC_CORNERS), number, (number + 1) % DISC_CORNERS], axis=1)
    return flat_mesh(np.concatenate([rim, light.centre[None]]), fan)
