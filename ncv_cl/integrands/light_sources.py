"""All that shines in a scene, as arrays: its lights, and the triangles of surfaces that emit.

Each is one record of lights.cl. Pairs of triangles that make a parallelogram become one. Where surfaces
have more of them than strips of the square can be handed out to, neighbours share a strip.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cached_property
from weakref import WeakKeyDictionary

import numpy as np

from ..scene.lights.kinds import DiscLight, SphereLight
from ..scene.lights.mesh import disc_axes, outer_radius
from ..scene.lights.pieces import clusters, parallelograms, pieces
from ..scene.load import Scene
from ..scene.model import Light, QuadLight

# The shapes of lights, as light_shapes.cl knows them.
PARALLELOGRAM, TRIANGLE, DISC, BALL = range(4)
# Strips that surfaces which emit may have, beside those of lights: a power of two.
MOST_SURFACE_STRIPS = 64
# Of a strip of many lights so many stand for all where it is asked what they bring.
STAND_INS = 8


@dataclass(frozen=True)
class Lights:
    """Lights as arrays, float64 (lights, ...) unless it says otherwise.

    Attributes
    ----------
    corner : (lights, 3)
        Of a ball its centre.
    edges : (lights, 2, 3)
        Of a disc those of the square about it; of a ball zero.
    normal : (lights, 3)
        Of the side that shines; of a ball zero.
    radiance : (lights, 3)
    area : (lights,)
        Of one side; of a ball that of the disc that it is seen as.
    two_sided : bool (lights,)
        Balls are.
    shape : int64 (lights,)
    reach : (lights,)
        Of a ball the radius of a sphere about all that stands for it; else 0.
    beam : (lights, 5)
        Of a ball: its axis, the angle from this beyond which nothing is sent, and one over the width of
        the range of angles before that in which it falls off, in radians.
    strip : int64 (lights,)
        The strip of the square that it is sampled in.
    """

    corner: np.ndarray
    edges: np.ndarray
    normal: np.ndarray
    radiance: np.ndarray
    area: np.ndarray
    two_sided: np.ndarray
    shape: np.ndarray
    reach: np.ndarray
    beam: np.ndarray
    strip: np.ndarray

    @staticmethod
    def of(lights: tuple[Light, ...]) -> Lights:
        """A scene's lights, each with a strip of its own."""
        forms = [_form(light) for light in lights]
        vectors = np.array([form[:3] for form in forms], np.float64).reshape(-1, 3, 3)
        shape = np.array([form[3] for form in forms], np.int64)
        two_sided = [getattr(light, "two_sided", True) for light in lights]
        found = Lights._flat(
            vectors[:, 0],
            vectors[:, 1:],
            np.array([light.radiance for light in lights], np.float64).reshape(-1, 3),
            np.array(two_sided, bool),
            shape,
            np.arange(len(lights)),
        )
        is_round = (shape == DISC) | (shape == BALL)
        area = np.array([light.area for light in lights], np.float64)
        return replace(
            found,
            area=np.where(is_round, area, found.area),
            reach=np.array([form[4] for form in forms], np.float64),
            beam=np.array([form[5] for form in forms], np.float64).reshape(-1, 5),
        )

    @staticmethod
    def _flat(
        corner: np.ndarray,
        edges: np.ndarray,
        radiance: np.ndarray,
        two_sided: np.ndarray,
        shape: np.ndarray,
        strip: np.ndarray,
    ) -> Lights:
        """Parallelograms and triangles; area and normal of others are not theirs."""
        vector_area = np.cross(edges[:, 0], edges[:, 1]).reshape(-1, 3)
        area = np.linalg.norm(vector_area, axis=1)
        # As single as kernels have it.
        normal = vector_area / np.where(area > 0, area, 1.0)[:, None]
        normal = normal.astype(np.float32).astype(np.float64)
        area = np.where(shape == TRIANGLE, 0.5 * area, area)
        count = len(corner)
        reach, beam = np.zeros(count), np.zeros((count, 5))
        return Lights(
            corner, edges, normal, radiance, area, two_sided, shape, reach, beam, strip
        )  # fmt: skip

    @staticmethod
    def joined(first: Lights, second: Lights) -> Lights:
        names = [field.name for field in fields(Lights)]
        return Lights(*(np.concatenate([getattr(first, n), getattr(second, n)]) for n in names))

    def only(self, chosen: np.ndarray) -> Lights:
        """Those of the lights that an index of one dimension chooses."""
        return Lights(*(getattr(self, field.name)[chosen] for field in fields(Lights)))

    @property
    def corners(self) -> np.ndarray:
        """float64 (4, lights, 3); a triangle's third one twice, a ball's centre."""
        edge1, edge2 = self.edges[:, 0], self.edges[:, 1]
        last = edge2 + np.where(self.tapered[:, None], 0.0, edge1)
        return np.stack([self.corner, self.corner + edge1, self.corner + edge2, self.corner + last])

    @property
    def middle(self) -> np.ndarray:
        """float64 (lights, 3)."""
        part = np.where(self.tapered, 1 / 3, 1 / 2)[:, None]
        return self.corner + part * self.edges.sum(axis=1)

    @property
    def tapered(self) -> np.ndarray:
        """Whose lines shorten to nothing, bool (lights,)."""
        return self.shape == TRIANGLE

    def at(self, u: float, v: float) -> np.ndarray:
        """A place on each, u of the way across it and v along the line there, float64 (lights, 3)."""
        along = np.where(self.tapered[:, None], (1.0 - u) * v, v)
        return self.corner + u * self.edges[:, 0] + along * self.edges[:, 1]

    def sent(self, light: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """What lights send along unit directions, over their radiance, float32 (...,).

        Parameters
        ----------
        light : ndarray
            Which, int (...,).
        directions : ndarray
            Float (..., 3).
        """
        beam = self.beam[light]
        cosine = np.clip((directions * beam[..., :3]).sum(axis=-1), -1.0, 1.0)
        inside = np.clip((beam[..., 3] - np.arccos(cosine)) * beam[..., 4], 0.0, 1.0)
        return np.where(self.shape[light] == BALL, inside, 1.0).astype(np.float32)

    @property
    def power(self) -> np.ndarray:
        """What each emits, mean of the channels, over pi; balls emit four times what a disc does."""
        sides = np.where(self.shape == BALL, 4, 1 + self.two_sided)
        return self.area * self.radiance.mean(axis=1) * sides

    @property
    def strips(self) -> int:
        """How many strips there are."""
        return int(self.strip.max(initial=-1)) + 1

    @cached_property
    def has_clusters(self) -> bool:
        """Whether some strip belongs to several lights."""
        return self.strips < len(self.strip)

    @property
    def has_balls(self) -> bool:
        return bool((self.shape == BALL).any())

    def per_strip(self, values: np.ndarray) -> np.ndarray:
        """Sums over the lights of each strip, (..., strips), of (..., lights)."""
        return np.add.reduceat(values, self._firsts, axis=-1)

    @property
    def _firsts(self) -> np.ndarray:
        """The first light of each strip: lights are in the order of strips."""
        return np.searchsorted(self.strip, np.arange(self.strips))

    def bounds(self) -> Lights:
        """One light a strip that lights whatever one of the strip's lights may: itself, or a ball."""
        if not self.has_clusters:
            return self
        firsts = self._firsts
        counts = np.diff(np.append(firsts, len(self.strip)))
        corners = self.corners
        least = np.minimum.reduceat((corners - self.reach[:, None]).min(axis=0), firsts)
        most = np.maximum.reduceat((corners + self.reach[:, None]).max(axis=0), firsts)
        one = self.only(firsts)
        many = counts > 1
        column = many[:, None]
        return replace(
            one,
            corner=np.where(column, (least + most) / 2, one.corner),
            edges=np.where(column[:, None], 0.0, one.edges),
            normal=np.where(column, 0.0, one.normal),
            two_sided=one.two_sided | many,
            shape=np.where(many, BALL, one.shape),
            reach=np.where(many, np.linalg.norm(most - least, axis=1) / 2, one.reach),
        )

    def stand_ins(self) -> Lights:
        """`STAND_INS` lights of each strip of more, evenly by power, each for its share of it."""
        if not self.has_clusters:
            return self
        chosen, scale = [], []
        power = self.power
        for first, last in zip(self._firsts, np.append(self._firsts[1:], len(power)), strict=True):
            total = np.cumsum(power[first:last])
            if last - first <= STAND_INS or not total[-1] > 0:
                own = np.arange(first, min(last, first + STAND_INS))
                factor = np.ones(len(own))
            else:
                places = total[-1] * (np.arange(STAND_INS) + 0.5) / STAND_INS
                own = first + np.minimum(np.searchsorted(total, places), last - first - 1)
                factor = total[-1] / STAND_INS / power[own]
            chosen.append(own)
            scale.append(factor)
        found = self.only(np.concatenate(chosen))
        return replace(found, radiance=found.radiance * np.concatenate(scale)[:, None])


def _form(light: Light) -> tuple[np.ndarray, np.ndarray, np.ndarray, int, float, np.ndarray]:
    """Of `Lights`: corner and both edges, shape, reach and beam."""
    if isinstance(light, QuadLight):
        return light.corner, light.edge1, light.edge2, PARALLELOGRAM, 0.0, np.zeros(5)
    if isinstance(light, DiscLight):
        edge1, edge2 = (2 * light.radius * axis for axis in disc_axes(light.normal))
        return light.centre - (edge1 + edge2) / 2, edge1, edge2, DISC, 0.0, np.zeros(5)
    if isinstance(light, SphereLight):
        # All angles are far from where this beam ends.
        reach, beam = outer_radius(light.radius, light.subdivisions), np.array([0.0, 0.0, 1.0, 8.0, 1.0])
        return light.centre, np.zeros(3), np.zeros(3), BALL, reach, beam
    inner, outer = np.radians([light.inner_angle, light.outer_angle])
    # An edge, where the angles are the same.
    beam = np.array([*light.direction, outer, 1.0 / max(outer - inner, 1e-6)])
    return light.position, np.zeros(3), np.zeros(3), BALL, outer_radius(light.radius, 0), beam


@dataclass(frozen=True)
class Sources:
    """All lights of a scene, those of `Scene.lights` first and in their order.

    Attributes
    ----------
    lights : Lights
    of_triangle : int32 (triangles,)
        The light that each triangle of the scene is part of, or -1.
    """

    lights: Lights
    of_triangle: np.ndarray


_SOURCES: WeakKeyDictionary[Scene, Sources] = WeakKeyDictionary()


def light_sources(scene: Scene) -> Sources:
    """What shines in a scene and is sampled as a light, found once."""
    if scene not in _SOURCES:
        _SOURCES[scene] = _light_sources(scene)
    return _SOURCES[scene]


def emissions(scene: Scene) -> np.ndarray:
    """What each material emits, float32 (materials, 3)."""
    return np.array([material.emission for material in scene.materials], np.float32).reshape(-1, 3)


def sampled_materials(scene: Scene) -> np.ndarray:
    """The materials whose emission is sampled as light, bool (materials,).

    Where a texture says how bright it is, or where there are holes, only paths find it.
    """
    return np.array(
        [
            bool(one.emission.any())
            and (one.maps is None or (one.maps.emission is None and one.maps.opacity is None))
            for one in scene.materials
        ],
        bool,
    )


def hidden_materials(scene: Scene) -> np.ndarray:
    """The materials whose emission only paths find, bool (materials,)."""
    emits = np.array([bool(one.emission.any()) for one in scene.materials], bool)
    return emits & ~sampled_materials(scene)


def _light_sources(scene: Scene) -> Sources:
    lights = Lights.of(scene.lights)
    of_triangle = scene.triangle_light.copy()
    emits = sampled_materials(scene)[scene.triangle_material] & (scene.triangle_light < 0)
    triangles = np.flatnonzero(emits)
    if not len(triangles):
        return Sources(lights, of_triangle)
    corners = scene.vertices[scene.triangles[triangles]].astype(np.float64)
    material = scene.triangle_material[triangles]
    partner = parallelograms(corners, material)
    kept = np.flatnonzero(np.arange(len(triangles)) <= partner)
    corner, edges, is_pair = pieces(corners, partner, kept)
    shape = np.where(is_pair, PARALLELOGRAM, TRIANGLE)
    radiance = np.array([one.emission for one in scene.materials], np.float64)[material[kept]]
    found = Lights._flat(
        corner, edges, radiance, np.ones(len(kept), bool), shape, np.zeros(len(kept), np.int64)
    )
    order, strip = clusters(found.middle, found.power, MOST_SURFACE_STRIPS)
    found = replace(found.only(order), strip=len(scene.lights) + strip)
    number = np.empty(len(triangles), np.int64)
    number[kept[order]] = np.arange(len(kept))
    number[partner[kept]] = number[kept]
    of_triangle[triangles] = len(scene.lights) + number
    return Sources(Lights.joined(lights, found), of_triangle)
