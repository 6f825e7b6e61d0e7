"""Rooms that global illumination is measured in: boxes in a closed box, lit in several ways."""

from __future__ import annotations

import numpy as np

import ncv_cl as ncv

# Half width and depth, and height.
WIDTH, DEPTH, HEIGHT, WALL = 3.0, 4.0, 3.0, 0.1
SIDES = {
    "floor": ((-WIDTH, -WALL, -DEPTH), (WIDTH, 0, DEPTH)),
    "ceiling": ((-WIDTH, HEIGHT, -DEPTH), (WIDTH, HEIGHT + WALL, DEPTH)),
    "left": ((-WIDTH - WALL, 0, -DEPTH), (-WIDTH, HEIGHT, DEPTH)),
    "right": ((WIDTH, 0, -DEPTH), (WIDTH + WALL, HEIGHT, DEPTH)),
    "back": ((-WIDTH, 0, -DEPTH - WALL), (WIDTH, HEIGHT, -DEPTH)),
    "front": ((-WIDTH, 0, DEPTH), (WIDTH, HEIGHT, DEPTH + WALL)),
}
CAMERA = ncv.Camera(position=(0.3, 1.7, 3.8), target=(0, 1.0, -1), vertical_fov=60)
Box = tuple[tuple[float, ...], tuple[float, ...]]
# Corners of the faces of a box whose corners are numbered by the bits x, y, z.
FACES = np.array(
    [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
     [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]
)  # fmt: skip


def boxes(material: str, *corners: Box) -> ncv.TriangleMesh:
    """Boxes by their lower and upper corners."""
    vertices = [
        np.array(np.meshgrid(*zip(lower, upper, strict=True), indexing="ij")).reshape(3, 8).T
        for lower, upper in corners
    ]
    triangles = [FACES + 8 * number for number in range(len(corners))]
    return ncv.TriangleMesh(np.concatenate(vertices), np.concatenate(triangles), material)


def walls(material: str, *without: str) -> ncv.TriangleMesh:
    return boxes(material, *[box for side, box in SIDES.items() if side not in without])


def furniture(material: str, seed: int, number: int) -> ncv.TriangleMesh:
    """Boxes that stand on the floor at random, some into each other."""
    generator = np.random.default_rng(seed)
    found = []
    for _ in range(number):
        x, z = generator.uniform((-2.8, -3.8), (2.8, 1.8))
        a, b, c = generator.uniform(0.15, 0.6, 3)
        found.append(((x - a, 0, z - c), (x + a, 2 * b, z + c)))
    return boxes(material, *found)


def office() -> ncv.Scene:
    """Two lamps at the ceiling."""
    materials = {"white": ncv.Material(0.7), "wood": ncv.Material((0.5, 0.3, 0.15))}
    lights = [ncv.QuadLight((x - 0.5, 2.95, -0.4), (1, 0, 0), (0, 0, 0.8), 10) for x in (-1.5, 1.5)]
    return ncv.build_scene(CAMERA, materials, [walls("white"), furniture("wood", 1, 14)], lights)


def dim() -> ncv.Scene:
    """A lamp over a shelf: most of what is seen is lit by the ceiling."""
    materials = {"white": ncv.Material(0.8), "red": ncv.Material((0.6, 0.2, 0.1))}
    shelf = boxes("red", ((-3, 2.0, -2), (-2.2, 2.05, 1)))
    light = ncv.QuadLight((-2.9, 2.2, -1), (0, 0, 1), (0.4, 0, 0), 40)
    meshes = [walls("white"), furniture("red", 2, 10), shelf]
    return ncv.build_scene(CAMERA, materials, meshes, [light])


def white() -> ncv.Scene:
    """Walls that swallow hardly any light."""
    materials = {"white": ncv.Material(0.93), "grey": ncv.Material(0.5)}
    light = ncv.QuadLight((-0.3, 2.95, -0.3), (0.6, 0, 0), (0, 0, 0.6), 20)
    return ncv.build_scene(CAMERA, materials, [walls("white"), furniture("grey", 3, 8)], [light])


def gloss() -> ncv.Scene:
    """A polished floor and metal before a window."""
    materials = {
        "white": ncv.Material(0.6),
        "floor": ncv.Material((0.2, 0.15, 0.1), 0.2, 0.25),
        "metal": ncv.Material(0.02, (0.7, 0.6, 0.4), 0.3),
    }
    light = ncv.QuadLight((2.95, 0.8, -2), (0, 0, 2), (0, 1.5, 0), 8)
    meshes = [
        walls("white", "floor"),
        boxes("floor", SIDES["floor"]),
        furniture("metal", 4, 6),
        furniture("white", 5, 6),
    ]
    return ncv.build_scene(CAMERA, materials, meshes, [light])


def door() -> ncv.Scene:
    """A lamp in the next room."""
    materials = {"white": ncv.Material(0.75), "blue": ncv.Material((0.2, 0.3, 0.6))}
    partition = boxes(
        "white",
        ((-3, 0, -1.6), (0.8, 3, -1.5)),
        ((1.6, 0, -1.6), (3, 3, -1.5)),
        ((0.8, 2.1, -1.6), (1.6, 3, -1.5)),
    )
    light = ncv.QuadLight((-1.5, 2.9, -3.3), (1.5, 0, 0), (0, 0, 1), 30)
    meshes = [walls("white"), furniture("blue", 6, 6), partition]
    return ncv.build_scene(CAMERA, materials, meshes, [light])


ROOMS = {"office": office, "dim": dim, "white": white, "gloss": gloss, "door": door}
