"""Scenes of glass that tests share."""

from __future__ import annotations

import numpy as np

import ncv_cl as ncv
from ncv_cl.scene.geometry import box_mesh, sphere_mesh

TWO = [[0, 1, 2], [0, 2, 3]]


def sheet(corner, edge1, edge2, material):
    """A parallelogram."""
    corner, edge1, edge2 = (np.asarray(vector, float) for vector in (corner, edge1, edge2))
    corners = np.stack([corner, corner + edge1, corner + edge1 + edge2, corner + edge2])
    return ncv.TriangleMesh(corners, TWO, material)


def ball(centre, radius, material, subdivisions=4):
    one = sphere_mesh(np.asarray(centre, float), radius, subdivisions)
    return ncv.TriangleMesh(one.vertices, one.triangles, material, normals=one.normals)


def block(centre, size, material):
    one = box_mesh(np.asarray(centre, float), np.asarray(size, float), np.eye(4), False)
    return ncv.TriangleMesh(one.vertices, one.triangles, material)


def furnace(glass, meshes):
    """Glass in a room whose walls glow alike."""
    materials = {"glass": glass, "wall": ncv.Material(0.0, emission=(1, 2, 0.5))}
    camera = ncv.Camera((0.1, 0.3, 2.5), (0, 0, 0), 42)
    return ncv.build_scene(camera, materials, [*meshes, block([0, 0, 0], [6, 6, 6], "wall")])


def room(glass, meshes):
    """A coloured room with a lamp at its ceiling."""
    walls = {
        "floor": ([-2, 0, 2], [4, 0, 0], [0, 0, -4], (0.7, 0.6, 0.5)),
        "back": ([-2, 0, -2], [4, 0, 0], [0, 3, 0], (0.5, 0.6, 0.7)),
        "left": ([-2, 0, 2], [0, 0, -4], [0, 3, 0], (0.7, 0.3, 0.3)),
        "right": ([2, 0, -2], [0, 0, 4], [0, 3, 0], (0.3, 0.7, 0.3)),
        "ceiling": ([-2, 3, -2], [4, 0, 0], [0, 0, 4], 0.7),
    }
    materials = {name: ncv.Material(albedo) for name, (*_, albedo) in walls.items()}
    surfaces = [sheet(*places, name) for name, (*places, _) in walls.items()]
    lamp = ncv.QuadLight((-0.7, 2.9, -0.7), (1.4, 0, 0), (0, 0, 1.4), (12, 10, 8))
    camera = ncv.Camera((0.3, 1.6, 4.5), (0, 1.2, -1), 50)
    return ncv.build_scene(camera, {**materials, "glass": glass}, [*surfaces, *meshes], [lamp])


PANES = (
    sheet([-1.5, 0, 0.5], [3, 0, 0], [0, 2, -0.3], "glass"),
    sheet([-0.8, 2.4, 0.8], [1.6, 0, 0], [0, 0.1, -1.6], "glass"),
)
