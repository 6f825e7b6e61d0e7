"""Textures of mesh files: decoded, or replaced by their mean where they cannot be shown."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..textures.image_file import ImageFiles
from ..textures.texture import Maps, Texture
from .common import Colour, FileMaterial, Notes, three

# A file, or its content; None if it is not there.
Image = Path | bytes | None
MISSING = "textures that are missing or cannot be read, in whose place {} stands"
MEANS = "textures are not read, their mean colour stands for them"
HALF_OPAQUE = "materials that blend are opaque, with holes where their opacity is below a half"
NO_NORMALS = "textures of normals that are missing or not placed as the colour is, which are left out"
NO_OPACITY = "textures of opacity that are missing or not placed as the colour is, the surface is opaque"
MEAN_OF_OTHERS = "textures that are not placed as the colour is, their mean colour stands for them"
NOT_PLACED_ALIKE = "textures of metal that are not placed as the colour is, the surface is no metal"
NO_METAL = "textures of metal that are missing or cannot be read, the surface is no metal"


def colour_texture(
    images: ImageFiles,
    image: Image,
    label: str,
    notes: Notes,
    wrap: tuple[str, str] = ("repeat", "repeat"),
    nearest: bool = False,
) -> Texture | None:
    """A texture of a base colour, or None if it cannot be read; notes colours that are clamped."""
    texels = None if image is None else images.texels(image)
    if texels is None:
        return None
    colours = texels[:, :, :3]
    if np.min(colours) < 0 or np.max(colours) > 1:
        notes.look("textures with colours outside [0, 1], which are clamped", label)
        texels = np.clip(texels, 0, 1)
    return Texture(texels, wrap, nearest)


def mean_colour(images: ImageFiles, image: Image) -> Colour | None:
    """Mean linear RGB of an image, or None if it cannot be read. Pixels count by their alpha."""
    texels = None if image is None else images.texels(image)
    return None if texels is None else three(_mean(texels)[:3])


def surface_texture(
    roughness: Texture | None, metal: Texture | None, channels: tuple[int, int]
) -> Texture | None:
    """One texture, as `Maps.surface` is, of the images of roughness and of metal.

    Parameters
    ----------
    channels : (int, int)
        Which channel of each counts.
    """
    if roughness is None and metal is None:
        return None
    largest = max(
        (one for one in (roughness, metal) if one is not None), key=lambda one: one.texels.size
    )
    texels = np.ones_like(largest.texels)
    for target, one, channel in ((1, roughness, channels[0]), (2, metal, channels[1])):
        if one is not None:
            texels[:, :, target] = _resampled(one, texels.shape[:2])[:, :, channel]
    return replace(largest, texels=np.clip(texels, 0, 1))


def without_textures(material: FileMaterial, notes: Notes) -> FileMaterial:
    """A textured material for a mesh without coordinates: means stand for the textures."""
    maps = material.maps
    if maps is None or not maps.textures:
        return material
    kind = "textures of meshes without texture coordinates, their mean stands for them"
    notes.look(kind, material.name)
    colour, surface, emission = (
        np.ones(4) if one is None else _mean(one.texels)
        for one in (maps.colour, maps.surface, maps.emission)
    )
    return replace(
        material,
        albedo=three(np.multiply(material.albedo, colour[:3])),
        roughness=float(material.roughness * surface[1]),
        emission=three(np.multiply(material.emission, emission[:3])),
        maps=Maps(metallic=float(maps.metallic * surface[2])),
    )


def _resampled(texture: Texture, shape: tuple[int, int]) -> NDArray:
    """A texture's texels at the centres of `shape`'s."""
    if texture.texels.shape[:2] == shape:
        return texture.texels
    rows, columns = ((np.arange(size) + 0.5) / size for size in shape)
    v, u = np.meshgrid(rows, columns, indexing="ij")
    return texture.at(np.stack([u, v], axis=2).reshape(-1, 2)).reshape(*shape, 4)


def _mean(texels: NDArray[np.float16]) -> NDArray[np.float64]:
    """Mean of texels (4,), by their alpha unless that is 0 everywhere."""
    rows = texels.reshape(-1, 4).astype(np.float64)
    return np.average(rows, axis=0, weights=rows[:, 3] if rows[:, 3].any() else None)
