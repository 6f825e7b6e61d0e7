"""Thin panes of glass on the way of rays: what these let through."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..scene.model import Scene
from ..scene.textures.surface import surface_at, varies


class Panes:
    """The panes of a scene.

    Attributes
    ----------
    triangles : bool (n_triangles,)
        Those that are panes.
    """

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._ior = np.abs([one.signed_ior for one in scene.materials])
        self._tint = np.array([one.tint for one in scene.materials], np.float64)
        is_pane = np.array([one.is_glass and one.thin for one in scene.materials], np.bool_)
        self.triangles = is_pane[scene.triangle_material]

    def let_through(
        self, triangle: NDArray, u: NDArray, v: NDArray, directions: NDArray
    ) -> NDArray[np.float64]:
        """What panes let through of rays that hit them, (n, 3): their tint times 1 - R.

        R = 2 F / (1 + F) is what a pane reflects by all reflections between its sides, F being
        Fresnel's reflectance of one side at the angle with the triangle's own normal: as bsdf.cl has it.

        Parameters
        ----------
        triangle : integers (n,)
            Panes.
        u, v : floats (n,)
            Barycentric coordinates of corners 1 and 2.
        directions : floats (n, 3)
            Of any length.
        """
        scene = self._scene
        corners = scene.vertices[scene.triangles[triangle]].astype(np.float64)
        edges = corners[:, 1:] - corners[:, :1]
        # Scaled before products, which leave no range then.
        edges /= np.abs(edges).max(axis=2, keepdims=True)
        normals = np.cross(edges[:, 0], edges[:, 1])
        lengths = np.linalg.norm(normals, axis=1) * np.linalg.norm(directions, axis=1)
        cosines = np.abs(np.sum(normals * directions, axis=1)) / lengths
        material = scene.triangle_material[triangle]
        one_side = fresnel(cosines, self._ior[material])
        through = (1.0 - one_side) / (1.0 + one_side)
        tint = surface_at(scene, triangle, u, v).albedo if varies(scene) else self._tint[material]
        return tint * through[:, None]


def fresnel(cosine: NDArray, eta: NDArray) -> NDArray[np.float64]:
    """What a dielectric interface reflects of unpolarised light, (n,): 1 where it reflects totally.

    Parameters
    ----------
    cosine : floats (n,)
        In [0, 1], on the side that light comes from.
    eta : floats (n,)
        Index of refraction behind the interface over that before it.
    """
    cosine = np.clip(cosine, 0.0, 1.0)
    sine2 = (1.0 - cosine**2) / eta**2
    inner = np.sqrt(np.maximum(1.0 - sine2, 0.0))
    total = sine2 >= 1.0
    across = (cosine - eta * inner) / np.where(total, 1.0, cosine + eta * inner)
    along = (eta * cosine - inner) / np.where(total, 1.0, eta * cosine + inner)
    return np.where(total, 1.0, 0.5 * (across**2 + along**2))
