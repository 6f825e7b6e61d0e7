"""Holes in surfaces: where the opacity of a texture is too small, rays pass."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..model import Scene


class Holes:
    """The holes of a scene.

    Attributes
    ----------
    triangles : bool (n_triangles,)
        Those that have some.
    """

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        has_some = [one.maps is not None and one.maps.opacity is not None for one in scene.materials]
        self.triangles = np.array(has_some, np.bool_)[scene.triangle_material]

    def at(self, triangle: NDArray, u: NDArray, v: NDArray) -> NDArray[np.bool_]:
        """Whether hits are in a hole, bool (n,); `triangle` is -1 where there is no hit.

        Parameters
        ----------
        u, v : floats (n,)
            Barycentric coordinates of corners 1 and 2.
        """
        found = np.zeros(len(triangle), np.bool_)
        asked = np.flatnonzero(triangle >= 0)
        asked = asked[self.triangles[triangle[asked]]]
        corners = self._scene.triangles[triangle[asked]]
        material = self._scene.triangle_material[triangle[asked]]
        shares = np.stack([1.0 - u[asked] - v[asked], u[asked], v[asked]], axis=1)
        for index in np.unique(material):
            here = material == index
            uv = np.einsum("ij,ijk->ik", shares[here], self._scene.coordinates[corners[here]])
            maps = self._scene.materials[index].maps
            if maps is not None and maps.opacity is not None:
                found[asked[here]] = maps.opacity.at(uv)[:, 3] < maps.cutoff
        return found
