"""A camera that sees all of a scene, and a light above it, for files that have none."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..model import Camera

# The suggested camera looks from in front, from the right and from above, at this angle.
_VIEW = np.array([0.5, 0.45, 1.0])
_FOV = 40.0
# The suggested light: how high above the mesh, and its side, in diagonals of the bounds.
_LIGHT_HEIGHT, _LIGHT_SIZE = 1.5, 1.0
# White, facing it, is then about as bright as a picture shows.
_LIGHT_RADIANCE = 8.0


def view_of(bounds: NDArray[np.float64]) -> Camera:
    """A camera outside of bounds, float64 (2, 3), that sees all of them."""
    centre, radius = bounds.mean(axis=0), 0.5 * _diagonal(bounds)
    distance = 1.05 * radius / np.sin(np.radians(_FOV / 2))
    position = centre + distance * _VIEW / np.linalg.norm(_VIEW)
    step = 10.0 ** (np.floor(np.log10(radius)) - 2)
    return Camera(np.round(position / step) * step, np.round(centre / step) * step, _FOV)


def camera_table(bounds: NDArray[np.float64]) -> dict[str, Any]:
    """`view_of` as a scene file's table ``camera``."""
    camera = view_of(bounds)
    return {
        "position": camera.position.tolist(),
        "target": camera.target.tolist(),
        "vertical_fov": camera.vertical_fov,
    }


def light_table(bounds: NDArray[np.float64]) -> dict[str, Any]:
    """A light above bounds, as one of a scene file's tables ``lights``."""
    size = _diagonal(bounds)
    centre = np.array([bounds[:, 0].mean(), bounds[1, 1], bounds[:, 2].mean()])
    side = _LIGHT_SIZE * size
    corner = centre + np.array([-side / 2, _LIGHT_HEIGHT * size, -side / 2])
    return {
        "corner": [float(f"{x:.6g}") for x in corner],
        "edge1": [float(f"{side:.6g}"), 0.0, 0.0],
        "edge2": [0.0, 0.0, float(f"{side:.6g}")],
        "radiance": _LIGHT_RADIANCE,
    }


def _diagonal(bounds: NDArray[np.float64]) -> float:
    # A point has none; scenes of nothing else are refused.
    return float(np.linalg.norm(bounds[1] - bounds[0])) or 1.0
