"""Named surfaces as patches: one side of them, in parallelograms and triangles, and points on it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..opencl.device import Device
from ..scene.load import Scene
from .points import triangle_spreads
from .sampler import Stream, square_samples

# A name with this before it is the surface's other side.
BACK = "-"
# Of a surface of more triangles than these it is not asked which of them are halves of parallelograms.
MOST_PAIRED = 64
# Two triangles make a parallelogram if its corners fit to so many of float32's roundings.
ROUNDINGS = 8 * 2.0**-24


@dataclass(frozen=True)
class Patch:
    """One side of a named surface.

    Attributes
    ----------
    name : str
        As it was asked for.
    triangles : ndarray
        int64 (triangles,), those of the scene.
    corner, edge1, edge2 : ndarray
        float64 (pieces, 3), in the scene's frame; edge1 × edge2 points to the patch's side.
    is_parallelogram : ndarray
        bool (pieces,); the others are triangles.
    """

    name: str
    triangles: np.ndarray
    corner: np.ndarray
    edge1: np.ndarray
    edge2: np.ndarray
    is_parallelogram: np.ndarray

    @property
    def normals(self) -> np.ndarray:
        """Unit normals of the pieces, float64 (pieces, 3)."""
        vectors = np.cross(self.edge1, self.edge2)
        return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)

    @property
    def piece_areas(self) -> np.ndarray:
        """float64 (pieces,)."""
        whole = np.linalg.norm(np.cross(self.edge1, self.edge2), axis=1)
        return np.where(self.is_parallelogram, whole, 0.5 * whole)

    @property
    def piece_corners(self) -> list[np.ndarray]:
        """Corners of each piece, counter-clockwise as seen from its side, float64 (3 or 4, 3)."""
        found = []
        for corner, first, second, whole in zip(
            self.corner, self.edge1, self.edge2, self.is_parallelogram, strict=True
        ):
            middle = [corner + first + second] if whole else []
            found.append(np.array([corner, corner + first, *middle, corner + second]))
        return found

    @property
    def area(self) -> float:
        """Of one side."""
        return float(self.piece_areas.sum())

    @property
    def spread(self) -> float:
        """The largest `triangle_spreads` of its pieces."""
        corners = np.stack([self.corner, self.corner + self.edge1, self.corner + self.edge2], axis=1)
        return float(triangle_spreads(corners, self.normals).max())

    def triangle_normals(self, scene: Scene) -> np.ndarray:
        """Normals of `triangles` on the patch's side, of any length, float64 (triangles, 3)."""
        corners = scene.vertices[scene.triangles[self.triangles]].astype(np.float64)
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        return -normals if self.name.startswith(BACK) else normals

    @property
    def is_flat(self) -> bool:
        """Whether no point of the patch can be seen from another: all lie in one plane."""
        normal, height = self.normals, self.corner - self.corner[0]
        reach = np.abs(height).max(initial=0.0) + np.abs(self.edge1).max() + np.abs(self.edge2).max()
        same = (normal @ normal[0] > 1 - 1e-12).all()
        return bool(same and (np.abs(height @ normal[0]) <= 1e-6 * reach).all())

    def points(self, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Positions and normals, float64 (n, 3), of points of the unit square, in equal density."""
        share = self.piece_areas / self.area
        ends = np.cumsum(share)
        piece = np.minimum(np.searchsorted(ends, u, side="right"), len(share) - 1)
        a = np.clip((u - ends[piece] + share[piece]) / share[piece], 0.0, 1.0)
        # A square onto a triangle of half its area, without a fold (Heitz 2019, A low-distortion map).
        b, lower = v, a < v
        half = np.where(lower, a, b) / 2
        first = np.where(lower, half, a - half)
        second = np.where(lower, b - half, half)
        whole = self.is_parallelogram[piece]
        a, b = np.where(whole, a, first), np.where(whole, b, second)
        edges = a[:, None] * self.edge1[piece] + b[:, None] * self.edge2[piece]
        return self.corner[piece] + edges, self.normals[piece]


def find_patch(scene: Scene, name: str) -> Patch:
    """The patch of a name, such as "wall", or "-wall" for the side that is not the one of its normal.

    The normal's side is that from which a triangle's corners go round counter-clockwise: that of edge1 ×
    edge2 for a quad, the outside of boxes and spheres.

    Raises
    ------
    SceneError
        If no surface is called so.
    """
    is_back = name.startswith(BACK)
    triangles = scene.surface_of(name.removeprefix(BACK))
    corners = scene.vertices[scene.triangles[triangles]].astype(np.float64)
    if is_back:
        corners = corners[:, ::-1]
    pieces, paired = _pieces(corners) if len(corners) <= MOST_PAIRED else (corners, None)
    whole = np.zeros(len(pieces), bool) if paired is None else paired
    edges = pieces[:, 1:] - pieces[:, :1]
    return Patch(name, triangles, pieces[:, 0], edges[:, 0], edges[:, 1], whole)


def _pieces(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Triangles (n, 3, 3) with halves of parallelograms joined: corners (m, 3, 3), which are joined."""
    left, found, whole = list(range(len(corners))), [], []
    slack = ROUNDINGS * np.abs(corners).max()
    while left:
        triangle = corners[left.pop(0)]
        turned = [np.roll(triangle, -k, axis=0) for k in range(3)]
        match = next(
            ((own, other) for own in turned for other in left if _completes(own, corners[other], slack)),
            None,
        )
        found.append(turned[0] if match is None else match[0])
        whole.append(match is not None)
        if match is not None:
            left.remove(match[1])
    return np.array(found), np.array(whole)


def _completes(own: np.ndarray, other: np.ndarray, slack: float) -> bool:
    """Whether a triangle is the other half of the parallelogram of `own`'s edges from its corner 0."""
    fourth = own[1] + own[2] - own[0]
    wanted = np.array([fourth, own[2], own[1]])
    return any(np.abs(np.roll(other, k, axis=0) - wanted).max() <= slack for k in range(3))


def patch_points(
    device: Device, patch: Patch, number: int, scrambles: range, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Sobol points on a patch, and their normals, float64 (scrambles, number, 3) each.

    Parameters
    ----------
    scrambles : range
        Each is a sequence of its own, independent of all others.
    """
    u, v = square_samples(device, "sobol", scrambles, range(number), seed, Stream.PATCHES)
    # From the middle of the step of 2^-24 that the number stands for.
    found = patch.points(u.ravel() + 2.0**-25, v.ravel() + 2.0**-25)
    position, normal = (array.reshape(len(scrambles), number, 3) for array in found)
    return position, normal
