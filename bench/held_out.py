"""Scenes that no number was tuned on, made by a seed: rooms, terrains, foliage, polished and rough."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from rooms import CAMERA, HEIGHT, boxes, furniture, walls

import ncv_cl as ncv

# Height fields' quads a side, and leaves.
QUADS, LEAVES = 40, 3000


def room(seed: int, lamps: int, polished: bool) -> ncv.Scene:
    """Boxes in a room under lamps at random places of its ceiling."""
    generator = np.random.default_rng(seed)
    gloss = {"reflectance": 0.3, "roughness": 0.2} if polished else {}
    materials = {
        "white": ncv.Material(generator.uniform(0.4, 0.8)),
        "things": ncv.Material(generator.uniform(0.1, 0.7, 3), **gloss),
    }
    lights = []
    for x, z in generator.uniform((-2.6, -3.6), (2.0, 2.5), (lamps, 2)):
        a, b = generator.uniform(0.2, 0.6, 2)
        radiance = generator.uniform(3, 30, 3)
        lights.append(ncv.QuadLight((x, HEIGHT - 0.02, z), (a, 0, 0), (0, 0, b), radiance))
    meshes = [walls("white"), furniture("things", seed, 12)]
    return ncv.build_scene(CAMERA, materials, meshes, lights)


def terrain(seed: int) -> ncv.Scene:
    """Hills under a wide light."""
    generator = np.random.default_rng(seed)
    x, z = np.meshgrid(*2 * [np.linspace(-4, 4, QUADS + 1)], indexing="ij")
    y = np.zeros_like(x)
    for octave in range(1, 5):
        (a, b), phase = generator.normal(0, octave, (2, 2)), generator.uniform(0, 6.3)
        y += 0.5 / octave * np.sin(a[0] * x + b[0] * z + phase) * np.cos(a[1] * x + b[1] * z)
    at = np.arange((QUADS + 1) ** 2).reshape(QUADS + 1, -1)
    a, b, c, d = at[:-1, :-1], at[:-1, 1:], at[1:, 1:], at[1:, :-1]
    triangles = np.stack([a, b, c, a, c, d], axis=-1).reshape(-1, 3)
    ground = ncv.TriangleMesh(np.stack([x, y, z], axis=-1).reshape(-1, 3), triangles, "ground")
    light = ncv.QuadLight((-3, 5, -3), (3, 0, 0), (0, 0, 3), 12)
    camera = ncv.Camera((0, 3.5, 7), (0, 0, 0), vertical_fov=50)
    return ncv.build_scene(camera, {"ground": ncv.Material((0.5, 0.45, 0.3))}, [ground], [light])


def foliage(seed: int) -> ncv.Scene:
    """Leaves over a floor, under two lights."""
    generator = np.random.default_rng(seed)
    middle = generator.normal((0, 1.8, 0), (1.2, 0.5, 1.2), (LEAVES, 3))
    corners = middle[:, None] + generator.normal(0, 0.06, (LEAVES, 3, 3))
    leaves = ncv.TriangleMesh(corners.reshape(-1, 3), np.arange(3 * LEAVES).reshape(-1, 3), "leaf")
    floor = boxes("floor", ((-4, -0.1, -4), (4, 0, 4)))
    materials = {"leaf": ncv.Material((0.2, 0.5, 0.15)), "floor": ncv.Material(0.6)}
    lights = [
        ncv.QuadLight((x, 5, -1), (1.5, 0, 0), (0, 0, 1.5), radiance)
        for x, radiance in ((-2.5, (20, 15, 10)), (2, (4, 6, 12)))
    ]
    camera = ncv.Camera((0, 2.5, 6), (0, 1, 0), vertical_fov=45)
    return ncv.build_scene(camera, materials, [floor, leaves], lights)


HELD_OUT: dict[str, Callable[[], ncv.Scene]] = {
    "room, 1 lamp": lambda: room(11, 1, False),
    "room, 4 lamps": lambda: room(12, 4, False),
    "room, 12 lamps": lambda: room(13, 12, False),
    "polished room": lambda: room(14, 2, True),
    "terrain": lambda: terrain(15),
    "foliage": lambda: foliage(16),
}
