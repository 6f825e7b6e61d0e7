"""How much of paths' noise stays each point's own where a group shares them: whether sharing pays."""

from __future__ import annotations

import functools

import numpy as np

from ..points.points import ShadingPoints
from ..points.trace import Hits, Tracer
from ..scene.load import Scene
from ..scene.textures.surface import surface_at
from ..visibility.trace import DeviceTracer
from . import tuning

# Groups of a block that are looked at, by one ray of each member.
GROUPS_SEEN = 64
# Shadow rays end before the place that they go to by this part of their length.
SHORTENED = 2.0**-10


class OwnNoise:
    """What rays from a scene's points find, and which other points see it."""

    def __init__(self, scene: Scene, tracer: Tracer | DeviceTracer) -> None:
        self._scene, self._given = scene, tracer

    def pays(self, points: ShadingPoints, groups: np.ndarray) -> bool:
        """Whether `groups` gain by shared paths; as `part` takes them."""
        return self.part(points, groups) <= tuning.MOST_OWN

    def part(self, points: ShadingPoints, groups: np.ndarray) -> float:
        """The part of paths' mean square that sharing leaves, from 1 / members to 1.

        Where the same light comes from everywhere, what is left of member k's is the mean, over places
        that its own rays find, of d_k / (sum of d over all members), d being share.cl's densities.
        Not shared is what a lobe at such a place sends, nor what a member's own lobe finds: its strip of
        the square is the lobe's share of what the member reflects, all of which goes into the mean
        square. The same rays every time: the same answer.

        Parameters
        ----------
        groups : ndarray
            Integers (groups, members), points that lie close to each other in number.
        """
        seen = groups[np.linspace(0, len(groups) - 1, min(GROUPS_SEEN, len(groups))).astype(int)]
        block = range(int(seen.min()), int(seen.max()) + 1)
        names = ("position", "normal", "geometric_normal", "offset", "albedo", "reflectance")
        position, normal, geometric, offset, albedo, reflectance = (
            points.rows(name, block)[:, seen - block.start].astype(np.float64) for name in names
        )
        origin, direction = position + offset * geometric, _towards(normal)
        hits = self._tracer.closest(_rays(origin), _rays(direction))
        # Light that comes straight from lamps needs no path.
        found = (hits.triangle >= 0) & (self._scene.triangle_light[hits.triangle] < 0)
        matte, lobes = np.zeros((2, len(found)))
        matte[found], lobes[found] = self._squares(hits, found)
        reach = np.where(found, hits.distance, 1.0).reshape(seen.shape)
        faces = self._normals(np.where(found, hits.triangle, 0)).reshape(origin.shape)
        left = self._own(origin, normal, origin + reach * direction, faces).ravel()
        lobe, reflected = reflectance.mean(axis=0).ravel(), (albedo + reflectance).mean(axis=0).ravel()
        strip = lobe / np.maximum(reflected, 1e-12)
        kept = matte * (left + strip * (1 - left)) + lobes
        whole = float(np.sum(reflected**2 * (matte + lobes)))
        return float(np.sum(reflected**2 * kept)) / whole if whole > 0 else 1.0

    @functools.cached_property
    def _tracer(self) -> Tracer:
        """One that answers the host."""
        return Tracer(self._scene) if isinstance(self._given, DeviceTracer) else self._given

    def _squares(self, hits: Hits, found: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean squares of what places scatter by their matte parts and by their lobes, (found,).

        In units of 1 / pi: albedo^2, and of GGX R^2 / (12 alpha^2), as the integral of D^2 over half
        vectors is 1 / (3 pi alpha^2) where alpha is small.
        """
        surface = surface_at(self._scene, *(row[found] for row in (hits.triangle, hits.u, hits.v)))
        lobe = surface.reflectance / surface.roughness[:, None] ** 2
        return np.mean(surface.albedo**2, axis=1), np.mean(lobe**2, axis=1) / 12

    def _normals(self, triangle: np.ndarray) -> np.ndarray:
        """Those of triangles, not of length 1, (3, triangles)."""
        a, b, c = self._scene.vertices[self._scene.triangles[triangle]].astype(np.float64).swapaxes(0, 1)
        return np.cross(b - a, c - a).T

    def _own(
        self, origin: np.ndarray, normal: np.ndarray, place: np.ndarray, faces: np.ndarray
    ) -> np.ndarray:
        """d_k / (sum of d) of the member that found each place, (groups, members).

        All arguments are (3, groups, members); `faces`, the places' normals, may have any length.
        """
        members = origin.shape[2]
        # Member k by who found the place: (3, groups, k, finder).
        to = place[:, :, None] - origin[..., None]
        squared = np.sum(to**2, axis=0)
        cosine = np.sum(to * normal[..., None], axis=0)
        side = np.sum(to * faces[:, :, None], axis=0)
        own_side = np.diagonal(side, axis1=1, axis2=2)[:, None]
        visible = np.empty(squared.size, np.uint8)
        ends = np.full(squared.size, 1.0 - SHORTENED, np.float32)
        starts = np.broadcast_to(origin[..., None], to.shape)
        self._tracer.visible(_rays(starts), _rays(to), ends, visible)
        # A finder sees its place, whatever rounding says of a shadow ray.
        sees = (visible.reshape(squared.shape) > 0) | np.eye(members, dtype=bool)
        facing = np.maximum(cosine, 0) * np.maximum(side * np.sign(own_side), 0)
        density = sees * facing / np.maximum(squared, 1e-300) ** 2
        own = np.diagonal(density, axis1=1, axis2=2)
        return np.where(own > 0, own / np.maximum(density.sum(axis=1), 1e-300), 1.0)


def _towards(normal: np.ndarray) -> np.ndarray:
    """Directions about `normal` (3, ...) that go as the cosine, the same every time."""
    height, turn = np.random.default_rng(1).random((2, *normal.shape[1:]))
    height, turn = 2 * height - 1, 2 * np.pi * turn
    ring = np.sqrt(1 - height**2)
    towards = normal + np.stack([ring * np.cos(turn), ring * np.sin(turn), height])
    return towards / np.maximum(np.linalg.norm(towards, axis=0), 1e-12)


def _rays(vectors: np.ndarray) -> np.ndarray:
    """Vectors (3, ...) as embree takes them, float32 (rays, 3)."""
    return np.ascontiguousarray(vectors.reshape(3, -1).T, np.float32)
