"""Scenes that no number was tuned on, made by a seed: rooms, halls, terrains, foliage, glass, skies."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from rooms import CAMERA, HEIGHT, boxes, furniture, walls

import ncv_cl as ncv

# Height fields' quads a side, leaves, and a ball's parallels.
QUADS, LEAVES, BALL = 40, 3000, 12
# Towards the sun.
SUN = (-0.8, 0.5, 0.2)


def room(
    seed: int,
    lamps: int,
    gloss: dict[str, object] | None = None,
    glass: int = 0,
    glow: int = 0,
    window: bool = False,
) -> ncv.Scene:
    """Boxes, and balls of glass or that glow, in a room under lamps at random places of its ceiling.

    `gloss` is what its boxes have beside their albedo, and its walls, too, if it is METAL. By the
    `window`, a wall that is not there, come light of the sky and of a sun.
    """
    generator = np.random.default_rng(seed)
    gloss = gloss or {}
    walled = gloss if gloss is METAL else {}
    dark = 0.15 if gloss is METAL else 1.0
    materials = {
        "white": ncv.Material(dark * generator.uniform(0.4, 0.8), **walled),
        "things": ncv.Material(dark * generator.uniform(0.1, 0.7, 3), **gloss),
    }
    if glass:
        materials["glass"] = ncv.Material(0.0, transmission=(0.9, 0.95, 0.9))
    if glow:
        materials["glow"] = ncv.Material(0.3, emission=(6, 5, 3))
    lights = []
    for x, z in generator.uniform((-2.6, -3.6), (2.0, 2.5), (lamps, 2)):
        a, b = generator.uniform(0.2, 0.6, 2)
        radiance = generator.uniform(3, 30, 3) / max(1, lamps / 12)
        lights.append(ncv.QuadLight((x, HEIGHT - 0.02, z), (a, 0, 0), (0, 0, b), radiance))
    meshes = [walls("white", *["left"] * window), furniture("things", seed, 12)]
    for material in ["glass"] * glass + ["glow"] * glow:
        middle = generator.uniform((-1.5, 0.7, -2), (1.5, 1.5, 2))
        meshes.append(ball(material, middle, generator.uniform(0.3, 0.6)))
    return ncv.build_scene(CAMERA, materials, meshes, lights, environment=day() if window else None)


def ball(material: str, middle: np.ndarray, radius: float) -> ncv.TriangleMesh:
    """A sphere of meridians and parallels, its normals outwards."""
    height, turn = np.meshgrid(
        np.linspace(0, np.pi, BALL + 1), np.linspace(0, 2 * np.pi, 2 * BALL + 1), indexing="ij"
    )
    ring = np.sin(height)
    around = np.stack([ring * np.cos(turn), np.cos(height), ring * np.sin(turn)], axis=-1)
    # Where the last meridian is the first, and at the poles, the corners are the same numbers.
    around[:, -1] = around[:, 0]
    around[0], around[-1] = (0, 1, 0), (0, -1, 0)
    triangles = grid(*around.shape[:2])
    vertices = middle + radius * around.reshape(-1, 3)
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    whole = np.linalg.norm(np.cross(b - a, c - a), axis=1) > 1e-6 * radius**2
    return ncv.TriangleMesh(vertices, triangles[whole], material)


def grid(rows: int, columns: int) -> np.ndarray:
    """The triangles of a grid of so many vertices, numbered row by row."""
    at = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = at[:-1, :-1], at[:-1, 1:], at[1:, 1:], at[1:, :-1]
    return np.stack([a, b, c, a, c, d], axis=-1).reshape(-1, 3)


def day() -> ncv.Environment:
    """A sky, brighter towards its upper edge, and a sun."""
    rows = np.linspace(1, 0.1, 16)[:, None, None] * np.array((0.4, 0.6, 1.0))
    sun = ncv.Sun(SUN, irradiance=(4, 3.5, 2.5))
    return ncv.Environment(np.repeat(rows, 32, axis=1).astype(np.float32), suns=(sun,))


def terrain(seed: int, sky: bool = False) -> ncv.Scene:
    """Hills under a wide light, or under the sky."""
    generator = np.random.default_rng(seed)
    x, z = np.meshgrid(*2 * [np.linspace(-4, 4, QUADS + 1)], indexing="ij")
    y = np.zeros_like(x)
    for octave in range(1, 5):
        (a, b), phase = generator.normal(0, octave, (2, 2)), generator.uniform(0, 6.3)
        y += 0.5 / octave * np.sin(a[0] * x + b[0] * z + phase) * np.cos(a[1] * x + b[1] * z)
    vertices = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    ground = ncv.TriangleMesh(vertices, grid(QUADS + 1, QUADS + 1), "ground")
    lights = [] if sky else [ncv.QuadLight((-3, 5, -3), (3, 0, 0), (0, 0, 3), 12)]
    camera = ncv.Camera((0, 3.5, 7), (0, 0, 0), vertical_fov=50)
    materials = {"ground": ncv.Material((0.5, 0.45, 0.3))}
    return ncv.build_scene(camera, materials, [ground], lights, environment=day() if sky else None)


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


POLISHED, ROUGH = {"reflectance": 0.3, "roughness": 0.2}, {"reflectance": 0.3, "roughness": 0.6}
METAL = {"reflectance": (0.6, 0.5, 0.4), "roughness": 0.3}
HELD_OUT: dict[str, Callable[[], ncv.Scene]] = {
    "room, 1 lamp": lambda: room(31, 1),
    "room, 4 lamps": lambda: room(32, 4),
    "room, 12 lamps": lambda: room(33, 12),
    "hall, 60 lamps": lambda: room(37, 60),
    "polished room": lambda: room(34, 2, POLISHED),
    "rough room": lambda: room(38, 2, ROUGH),
    "room of metal": lambda: room(42, 2, METAL),
    "room, 2 glowing balls": lambda: room(43, 0, glow=2),
    "glass in a room": lambda: room(39, 2, glass=3),
    "room by daylight": lambda: room(40, 0, window=True),
    "terrain": lambda: terrain(35),
    "terrain by daylight": lambda: terrain(41, sky=True),
    "foliage": lambda: foliage(36),
}
