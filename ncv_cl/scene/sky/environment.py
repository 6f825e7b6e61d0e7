"""What surrounds a scene: radiance by direction, and suns."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from trimesh.transformations import rotation_matrix

from .cie import clear_sky, overcast_sky
from .image import read_sky

# The sun's as seen from the earth, on average, in degrees.
SUN_DIAMETER = 0.533
UP = (0.0, 1.0, 0.0)


@dataclass(frozen=True, eq=False)
class Sun:
    """A disc of light without distance.

    Attributes
    ----------
    direction : float64 (3,)
        Towards it, of any length.
    irradiance : float32 (3,)
        On a surface across the direction, linear RGB.
    angular_diameter : float
        Degrees, in (0, 180).
    """

    direction: NDArray[np.float64]
    irradiance: NDArray[np.float32]
    angular_diameter: float = SUN_DIAMETER

    @property
    def towards(self) -> NDArray[np.float64]:
        """`direction` of length 1."""
        direction = np.asarray(self.direction, np.float64)
        return direction / np.linalg.norm(direction)

    @property
    def half_angle(self) -> float:
        """Radians."""
        return float(np.radians(self.angular_diameter) / 2)

    @property
    def solid_angle(self) -> float:
        """Steradians."""
        return float(4 * np.pi * np.sin(self.half_angle / 2) ** 2)

    @property
    def radiance(self) -> NDArray[np.float64]:
        """Of the disc, float64 (3,): its irradiance is ∫ L cos dω = L π sin²(half angle)."""
        return np.asarray(self.irradiance, np.float64) / (np.pi * np.sin(self.half_angle) ** 2)


@dataclass(frozen=True, eq=False)
class Environment:
    """Radiance that arrives from outside of the scene.

    An image in latitude and longitude surrounds the scene: its upper edge is the direction `up`. With
    the default `up` and no `rotation` its left edge is -z, the quarter +x, the middle +z. For another
    `up` the whole is turned the shortest way.

    Attributes
    ----------
    radiance : float32 (3,) or (height, width, 3)
        Linear RGB: everywhere the same, or an image from the upper edge down. Between the middles of
        pixels it is interpolated.
    rotation : float
        Degrees, counter-clockwise about `up` as seen from its end.
    up : float64 (3,)
        Of any length.
    suns : tuple of Sun
        Their directions are the world's, whatever `rotation` is.
    """

    radiance: NDArray[np.float32]
    rotation: float = 0.0
    up: NDArray[np.float64] = field(default_factory=lambda: np.array(UP))
    suns: tuple[Sun, ...] = ()

    @classmethod
    def read(
        cls, path: str | Path, scale: float = 1.0, rotation: float = 0.0, up: ArrayLike = UP
    ) -> Environment:
        """An image file, times `scale`.

        Raises
        ------
        SkyError
            If it cannot be read, or a number in it is negative or not finite.
        """
        return cls(read_sky(Path(path)) * np.float32(scale), rotation, np.array(up, np.float64))

    @classmethod
    def overcast(cls, zenith: ArrayLike = 1.0, up: ArrayLike = UP) -> Environment:
        """The CIE's overcast sky of a zenith radiance, RGB or one number; black below the horizon."""
        return cls(overcast_sky(zenith), 0.0, np.array(up, np.float64))

    @classmethod
    def clear(
        cls, sun: Sun, zenith: ArrayLike = 1.0, up: ArrayLike = UP, rotation: float = 0.0
    ) -> Environment:
        """The CIE's clear sky of a zenith radiance about the sun, and that; black below the horizon."""
        blank = cls(np.zeros(3, np.float32), rotation, np.array(up, np.float64), (sun,))
        return replace(blank, radiance=clear_sky(zenith, blank.axes @ sun.towards))

    @property
    def is_black(self) -> bool:
        """Whether nothing arrives."""
        return not np.any(self.radiance) and not self.suns

    @property
    def texels(self) -> NDArray[np.float32]:
        """`radiance` as an image, float32 (height, width, 3)."""
        found = np.asarray(self.radiance, np.float32)
        return found if found.ndim == 3 else found.reshape(1, 1, 3)

    @property
    def axes(self) -> NDArray[np.float64]:
        """The world's directions of the image's x, y (up) and z, rows of float64 (3, 3)."""
        up = np.asarray(self.up, np.float64)
        up = up / np.linalg.norm(up)
        across, cosine = np.cross(UP, up), float(np.dot(UP, up))
        # Opposite directions have no shortest way: by way of z.
        about = across if np.any(across) else np.array([1.0, 0.0, 0.0])
        tilt = rotation_matrix(np.arctan2(np.linalg.norm(across), cosine), about)[:3, :3]
        return (rotation_matrix(np.radians(self.rotation), up)[:3, :3] @ tilt).T

    def radiance_of(self, directions: NDArray[np.float64]) -> NDArray[np.float64]:
        """Radiance that arrives from unit directions (n, 3), suns included: float64 (n, 3)."""
        x, y, z = self.axes @ np.asarray(directions, np.float64).T
        texels = self.texels.astype(np.float64)
        height, width = texels.shape[:2]
        across = np.arctan2(x, -z) / (2 * np.pi) % 1.0 * width - 0.5
        down = np.clip(np.arctan2(np.hypot(x, z), y) / np.pi * height - 0.5, 0, height - 1)
        column, row = np.floor(across), np.floor(down)
        right, lower = (across - column)[:, None], (down - row)[:, None]
        column, row = column.astype(np.int64), row.astype(np.int64)
        found = np.zeros((len(across), 3))
        for below, part in ((0, 1 - lower), (1, lower)):
            line = texels[np.minimum(row + below, height - 1)]
            at = np.arange(len(column))
            found += part * (1 - right) * line[at, column % width]
            found += part * right * line[at, (column + 1) % width]
        for sun in self.suns:
            apart = ((np.asarray(directions) - sun.towards) ** 2).sum(axis=1)
            found += (apart <= 4 * np.sin(sun.half_angle / 2) ** 2)[:, None] * sun.radiance
        return found
