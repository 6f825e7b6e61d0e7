"""A scene from numpy arrays: a landscape of waves and a ball of its own, in the light of a lamp."""

from __future__ import annotations

import sys

import numpy as np

import ncv_cl as ncv


def grid(rows: int, columns: int) -> np.ndarray:
    """Triangles of a grid of vertices, whose rows follow one another; int64 (n, 3)."""
    first = np.arange((rows - 1) * columns).reshape(rows - 1, columns)[:, :-1].ravel()
    second = first + columns
    lower, upper = (first, second, first + 1), (first + 1, second, second + 1)
    return np.concatenate([np.stack(lower, axis=1), np.stack(upper, axis=1)])


def waves(size: int = 80) -> ncv.TriangleMesh:
    """y = f(x, z), with the normals of the function itself."""
    x, z = np.meshgrid(*[np.linspace(-3, 3, size)] * 2)
    height = 0.25 * np.sin(2 * x) * np.cos(2 * z)
    slope = (0.5 * np.cos(2 * x) * np.cos(2 * z), -0.5 * np.sin(2 * x) * np.sin(2 * z))
    vertices = np.stack([x, height, z], axis=-1).reshape(-1, 3)
    normals = np.stack([-slope[0], np.ones_like(x), -slope[1]], axis=-1).reshape(-1, 3)
    return ncv.TriangleMesh(vertices, grid(size, size), "sand", normals)


def ball(centre: tuple[float, float, float], radius: float, size: int = 40) -> ncv.TriangleMesh:
    theta, phi = np.meshgrid(np.linspace(0, np.pi, size), np.linspace(0, 2 * np.pi, size))
    around = np.sin(theta) * np.cos(phi), np.cos(theta), np.sin(theta) * np.sin(phi)
    normals = np.stack(around, axis=-1).reshape(-1, 3)
    # Poles are points: triangles without area there would be dropped with a warning.
    triangles, vertices = grid(size, size), normals * radius + centre
    corners = vertices[triangles]
    edges = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = np.linalg.norm(np.cross(*edges), axis=1)
    return ncv.TriangleMesh(vertices, triangles[area > 1e-9], "plastic", normals)


def scene() -> ncv.Scene:
    materials = {
        "sand": ncv.Material(albedo=(0.7, 0.55, 0.35)),
        "plastic": ncv.Material(albedo=(0.1, 0.3, 0.6), reflectance=0.04, roughness=0.3),
    }
    camera = ncv.Camera(position=(0, 3, 6), target=(0, 0.3, 0), vertical_fov=40)
    lamp = ncv.QuadLight(corner=(-2, 4, -2), edge1=(2, 0, 0), edge2=(0, 0, 2), radiance=12)
    return ncv.build_scene(camera, materials, [waves(), ball((0.3, 0.9, 0), 0.7)], [lamp])


if __name__ == "__main__":
    output = sys.argv[1] if len(sys.argv) > 1 else "scene_from_arrays.png"
    ncv.render(scene(), "direct", "ncv", spp=64, size=(160, 120)).write(output)
