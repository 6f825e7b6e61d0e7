"""Images on surfaces: their texels in linear light, and what they are at a point of the surface.

A texture's coordinates (u, v) are (0, 0) in the image's lower left corner and (1, 1) in its upper right
one, and texels' colours stand for their centres.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

# How an image goes on beyond its sides; their order is that of the kernels' numbers.
WRAPS = ("repeat", "mirror", "clamp")
# (a, b, c, d, e, f): textures are looked up at (a u + b v + c, d u + e v + f).
Placement: TypeAlias = tuple[float, float, float, float, float, float]
AS_IT_IS: Placement = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)
# No mesh means coordinates beyond; they would not be finite in single precision.
_FARTHEST = 1e9
LARGEST_HALF = float(np.finfo(np.float16).max)


@dataclass(frozen=True, eq=False)
class Texture:
    """An image that is looked up at texture coordinates.

    Attributes
    ----------
    texels : float16 (height, width, 4)
        Red, green and blue in linear light, and alpha; the lowest row first.
    wrap : (str, str)
        What is beyond the image's sides along u and v, of `WRAPS`.
    nearest : bool
        Whether a texel is a rectangle of one colour; else texels are interpolated bilinearly.
    """

    texels: NDArray[np.float16]
    wrap: tuple[str, str] = ("repeat", "repeat")
    nearest: bool = False

    @classmethod
    def of(
        cls, image: ArrayLike, wrap: str | tuple[str, str] = "repeat", nearest: bool = False
    ) -> Texture:
        """A texture from an array of linear colours, which is rounded to half precision.

        Parameters
        ----------
        image : array (height, width), (height, width, 3) or (height, width, 4)
            The uppermost row first, as images are stored; with a fourth channel, alpha.
        wrap : str or (str, str)
            Of `WRAPS`, along both axes or along u and v.
        nearest : bool

        Raises
        ------
        ValueError
            If the array has another shape, is empty or holds what is no number of half precision, or
            `wrap` is unknown.
        """
        values = np.asarray(image)
        values = values[..., None] if values.ndim == 2 else values
        if values.dtype.kind not in "fiub" or values.ndim != 3 or values.shape[2] not in (1, 3, 4):
            raise ValueError(
                f"an image is numbers (height, width), with 3 or 4 channels behind, got {values.dtype} "
                f"{np.shape(image)}"
            )
        if not values.size:
            raise ValueError("the image has no pixels")
        if not (np.abs(values) <= LARGEST_HALF).all():
            raise ValueError(f"an image holds what is not finite or beyond {LARGEST_HALF:g}")
        wraps: tuple[str, ...] = (wrap, wrap) if isinstance(wrap, str) else tuple(wrap)
        if len(wraps) != 2 or not set(wraps) <= set(WRAPS):
            raise ValueError(f"wrap must be one of {', '.join(WRAPS)}, or two of them, got {wraps!r}")
        texels = np.ones((*values.shape[:2], 4), np.float16)
        colours = values.shape[2] if values.shape[2] == 4 else 3
        texels[:, :, :colours] = values[::-1]
        texels.setflags(write=False)
        return cls(texels, (wraps[0], wraps[1]), bool(nearest))

    def at(self, uv: NDArray) -> NDArray[np.float64]:
        """Colours and alpha at coordinates (n, 2), float64 (n, 4)."""
        height, width = self.texels.shape[:2]
        uv = np.asarray(uv, dtype=np.float64)
        (column, across), (row, up) = (
            self._between(uv[:, axis], size, self.wrap[axis]) for axis, size in ((0, width), (1, height))
        )
        across, up = across[:, None], up[:, None]
        lower, upper = (
            (1.0 - across) * self.texels[one, column[0]] + across * self.texels[one, column[1]]
            for one in row
        )
        return (1.0 - up) * lower + up * upper

    def _between(
        self, coordinate: NDArray[np.float64], size: int, wrap: str
    ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Between which two texels (2, n) of an axis coordinates lie, and the weight of the second."""
        place = folded(coordinate, wrap) * size - 0.5
        if self.nearest:
            place = np.floor(place + 0.5)
        first = np.floor(place)
        texels = first.astype(np.int64) + np.array([[0], [1]])
        texels = texels % size if wrap == "repeat" else np.clip(texels, 0, size - 1)
        return texels, place - first


def linear_from_srgb(colours: NDArray) -> NDArray[np.float64]:
    """Linear values of sRGB-encoded ones in [0, 1] (IEC 61966-2-1)."""
    colours = np.asarray(colours, dtype=np.float64)
    return np.where(colours <= 0.04045, colours / 12.92, ((colours + 0.055) / 1.055) ** 2.4)


def folded(coordinate: NDArray[np.float64], wrap: str) -> NDArray[np.float64]:
    """Where in [0, 1] of the image itself a coordinate is looked up."""
    if wrap == "repeat":
        return coordinate - np.floor(coordinate)
    if wrap == "mirror":
        return 1.0 - np.abs(coordinate - 2.0 * np.floor(0.5 * coordinate) - 1.0)
    return np.clip(coordinate, 0.0, 1.0)


@dataclass(frozen=True)
class Maps:
    """What varies over a material's surface: textures that multiply its numbers, and how metallic it is.

    The material's `albedo` is then a base colour. Of it a dielectric reflects all as albedo, a metal
    as reflectance, and in between, with metallic share m: albedo (1 - m) and reflectance
    (1 - m) + albedo m.

    Attributes
    ----------
    colour : Texture, optional
        Multiplies the albedo.
    surface : Texture, optional
        Its green multiplies the roughness, its blue the metallic share; as in glTF.
    emission : Texture, optional
        Multiplies the emission.
    opacity : Texture, optional
        Where its alpha is below `cutoff` the surface has a hole.
    normal : Texture, optional
        Twice its colour less 1 is the normal along u, along v, and off the surface; the first two are
        multiplied by `normal_scale`.
    metallic, cutoff : float
        In [0, 1].
    normal_scale : float
    placement : tuple of six floats
        (a, b, c, d, e, f): textures are looked up at (a u + b v + c, d u + e v + f).
    """

    colour: Texture | None = None
    surface: Texture | None = None
    emission: Texture | None = None
    opacity: Texture | None = None
    normal: Texture | None = None
    metallic: float = 0.0
    cutoff: float = 0.5
    normal_scale: float = 1.0
    placement: Placement = AS_IT_IS

    def placed(self, uv: NDArray[np.float64]) -> NDArray[np.float64]:
        """Where a mesh's coordinates (n, 2) are looked up; those that are not finite are 0.

        Where images go on, that is moved by whole images to where single precision is fine.
        """
        uv = np.clip(np.nan_to_num(uv, posinf=0.0, neginf=0.0), -_FARTHEST, _FARTHEST)
        matrix = np.reshape(self.placement, (2, 3))
        moved = uv @ matrix[:, :2].T + matrix[:, 2]
        for axis in (0, 1):
            if not any(one.wrap[axis] == "clamp" for one in self.textures):
                moved[:, axis] -= 2.0 * np.round(0.5 * np.median(moved[:, axis]))
        return moved

    @property
    def textures(self) -> tuple[Texture, ...]:
        """Those that there are."""
        found = (self.colour, self.surface, self.emission, self.opacity, self.normal)
        return tuple(one for one in found if one is not None)
