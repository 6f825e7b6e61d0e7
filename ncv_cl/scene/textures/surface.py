"""What a scene's surfaces are made of at points of its triangles: textures and colours of vertices."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..geometry import SMALLEST_ROUGHNESS
from ..model import Scene
from .normals import bent


@dataclass(frozen=True, eq=False)
class Surface:
    """The numbers of a `Material` at points, where they may vary.

    Of glass these are its tint, and its reflectance at normal incidence.

    Attributes
    ----------
    albedo, reflectance : float64 (n, 3)
    roughness : float64 (n,)
    emission_factor : float64 (n, 3)
        What a texture multiplies the material's emission by.
    """

    albedo: NDArray[np.float64]
    reflectance: NDArray[np.float64]
    roughness: NDArray[np.float64]
    emission_factor: NDArray[np.float64]


def varies(scene: Scene) -> bool:
    """Whether anything but a point's material decides how it scatters."""
    return scene.vertex_uv is not None or scene.vertex_colours is not None


def surface_at(scene: Scene, triangle: NDArray, u: NDArray, v: NDArray) -> Surface:
    """What triangles are made of at points of barycentric coordinates `u`, `v` of corners 1 and 2.

    Parameters
    ----------
    triangle : integers (n,)
    u, v : floats (n,)
    """
    material = scene.triangle_material[triangle]
    albedo, reflectance, roughness = (
        np.array([getattr(one, name) for one in scene.materials], np.float64)[material]
        for name in ("tint", "facing", "roughness")
    )
    shares = np.stack([1.0 - u - v, u, v], axis=1).astype(np.float64)
    corners = scene.triangles[triangle]
    if scene.vertex_colours is not None:
        albedo *= _interpolated(scene.vertex_colours, corners, shares)
    metallic, emission_factor = np.zeros(len(triangle)), np.ones((len(triangle), 3))
    for index, one in enumerate(scene.materials):
        maps = one.maps
        if maps is None:
            continue
        here = np.flatnonzero(material == index)
        if not len(here):
            continue
        metallic[here] = maps.metallic
        if maps.textures:
            uv = _interpolated(scene.coordinates, corners[here], shares[here])
        if maps.colour is not None:
            albedo[here] *= maps.colour.at(uv)[:, :3]
        if maps.surface is not None:
            texel = maps.surface.at(uv)
            roughness[here] *= texel[:, 1]
            metallic[here] *= texel[:, 2]
        if maps.emission is not None:
            emission_factor[here] = maps.emission.at(uv)[:, :3]
    reflectance = reflectance * (1.0 - metallic)[:, None] + albedo * metallic[:, None]
    roughness = np.clip(roughness, SMALLEST_ROUGHNESS, 1.0)
    return Surface(albedo * (1.0 - metallic)[:, None], reflectance, roughness, emission_factor)


def bent_normals(
    scene: Scene, triangle: NDArray, u: NDArray, v: NDArray, normal: NDArray, outgoing: NDArray
) -> NDArray[np.float64]:
    """Shading normals (n, 3), bent where a material has a texture for that.

    Parameters
    ----------
    triangle, u, v
        As `surface_at` takes them.
    normal, outgoing : floats (n, 3)
        As `normals.bent` takes them.
    """
    found = np.array(normal, np.float64)
    material = scene.triangle_material[triangle]
    shares = np.stack([1.0 - u - v, u, v], axis=1).astype(np.float64)
    for index, one in enumerate(scene.materials):
        here = np.flatnonzero(material == index)
        if not len(here) or one.maps is None or one.maps.normal is None:
            continue
        own = triangle[here]
        uv = _interpolated(scene.coordinates, scene.triangles[own], shares[here])
        texel = one.maps.normal.at(uv)[:, :3]
        scale = one.maps.normal_scale
        found[here] = bent(scene, own, texel, scale, found[here], outgoing[here].astype(np.float64))
    return found


def _interpolated(rows: NDArray, corners: NDArray, shares: NDArray) -> NDArray[np.float64]:
    """Values of vertices at points with these shares (n, 3) of their triangles' corners (n, 3)."""
    return np.einsum("ij,ijk->ik", shares, rows[corners].astype(np.float64))
