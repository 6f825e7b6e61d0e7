"""Normals that textures bend, at first hits and at bounces."""

from __future__ import annotations

import numpy as np
import pytest
from mesh_files import write_image
from reference import camera_at, light_at, unit

import ncv_cl as ncv
from ncv_cl import GlobalIllumination, Material, QuadLight, SceneError, Texture, TriangleMesh
from ncv_cl.points.points import find_points
from ncv_cl.points.trace import Tracer
from ncv_cl.scene.textures.normals import tangents
from ncv_cl.scene.textures.texture import Maps

TWO = [[0, 1, 2], [0, 2, 3]]
SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
LIGHT = light_at([-0.5, 1.9, -0.5], [1, 0, 0], [0, 0, 1], (9, 8, 7))
LAMP = QuadLight(LIGHT.corner, LIGHT.edge1, LIGHT.edge2, LIGHT.radiance)
WALLS = [
    ([-1, 0, 1], [2, 0, 0], [0, 0, -2]),
    ([-1, 0, -1], [2, 0, 0], [0, 2, 0]),
    ([-1, 0, 1], [0, 0, -2], [0, 2, 0]),
]
# Normals of texels along u, v and off the surface; the lowest row first.
NORMALS = unit(np.random.default_rng(2).normal([0, 0, 1.2], 0.35, (3, 4, 3)))
CAMERA = camera_at([0.8, 1.4, 2.4], [-0.2, 0.5, -0.5], 48)


def corners_of(corner, edge1, edge2):
    corner, edge1, edge2 = (np.asarray(vector, float) for vector in (corner, edge1, edge2))
    return np.stack([corner + u * edge1 + v * edge2 for u, v in SQUARE])


def image_of(normals):
    """As images hold normals; the uppermost row first."""
    return Texture.of((0.5 + 0.5 * normals[::-1]), nearest=True)


def with_maps(normals=NORMALS, scale=1.0, uv=SQUARE, turned=False, camera=CAMERA, **material):
    maps = Maps(normal=image_of(normals), normal_scale=scale)
    triangles = np.array(TWO)[:, ::-1] if turned else TWO
    meshes = [TriangleMesh(corners_of(*one), triangles, "m", uv=uv) for one in WALLS]
    return ncv.build_scene(camera, {"m": Material(0.6, maps=maps, **material)}, meshes, [LAMP])


def in_parts(**material):
    """A small quad with normals of its own for every texel."""
    meshes = []
    rows, columns = NORMALS.shape[:2]
    for corner, edge1, edge2 in WALLS:
        edge1, edge2 = np.asarray(edge1, float), np.asarray(edge2, float)
        frame = np.stack([unit(edge1), unit(edge2), unit(np.cross(edge1, edge2))])
        for row in range(rows):
            for column in range(columns):
                start = corner + column / columns * edge1 + row / rows * edge2
                corners = corners_of(start, edge1 / columns, edge2 / rows)
                normals = np.tile(NORMALS[row, column] @ frame, (4, 1))
                meshes.append(TriangleMesh(corners, TWO, "m", normals=normals))
    return ncv.build_scene(CAMERA, {"m": Material(0.6, **material)}, meshes, [LAMP])


def normals_of(device, scene, size=(20, 16)):
    """Shading normals (n, 3) of a picture's points, and where in the picture they are."""
    points = find_points(device, scene, Tracer(scene), *size)
    return points.rows("normal").T, points.cell


def test_tangents_go_with_the_coordinates():
    scene = with_maps()
    tangent, side = tangents(scene, np.arange(6))
    expected = np.repeat([unit(edge1) for _, edge1, _ in WALLS], 2, axis=0)
    np.testing.assert_allclose(tangent, expected, atol=1e-7)
    assert (side == 1).all()
    tangent, side = tangents(with_maps(uv=SQUARE * [-1, 1]), np.arange(6))
    np.testing.assert_allclose(tangent, -expected, atol=1e-7)
    assert (side == -1).all()
    tangent, _ = tangents(with_maps(uv=SQUARE * [1, 0]), np.arange(6))
    assert not tangent.any()


def test_first_hits_have_the_normals_of_small_parts(device):
    found, cell = normals_of(device, with_maps())
    expected, other = normals_of(device, in_parts())
    assert (cell == other).all() and np.ptp(found, axis=0).min() > 0.5
    # Texels are halves.
    np.testing.assert_allclose(found, expected, atol=2e-3)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, atol=1e-6)


@pytest.mark.parametrize("integrand", ["ao", "direct", GlobalIllumination(4)])
@pytest.mark.parametrize("gloss", [{}, {"reflectance": 0.3, "roughness": 0.4}])
def test_bent_normals_are_as_good_as_small_parts(device, integrand, gloss):
    options = {"method": "mc", "sampler": "independent", "spp": 512, "size": (12, 10), "device": device}
    first = ncv.render(with_maps(**gloss), integrand, seed=1, **options)
    second = ncv.render(in_parts(**gloss), integrand, seed=2, **options)
    variance = first.variance + second.variance
    known = variance > 1e-10
    z = ((first.pixels - second.pixels) / np.sqrt(variance + 1e-12))[known]
    assert z.size > 200 and np.mean(z**2) < 1 + 5 * np.sqrt(2 / (z.size / 3)) and np.abs(z).max() < 5.5


def test_a_flat_texture_and_a_scale_of_zero_bend_nothing(one_device):
    flat = np.tile([0.0, 0, 1], (2, 2, 1))
    plain, _ = normals_of(one_device, with_maps(flat))
    for scene in (with_maps(scale=0.0), with_maps(uv=SQUARE * [1, 0])):
        found, _ = normals_of(one_device, scene)
        np.testing.assert_allclose(found, plain, atol=1e-6)
    # A scale multiplies the slope.
    tilted = np.tile(unit([0.2, 0, 1]), (2, 2, 1))
    found, _ = normals_of(one_device, with_maps(tilted, scale=2.0))
    expected, _ = normals_of(one_device, with_maps(np.tile(unit([0.4, 0, 1]), (2, 2, 1))))
    np.testing.assert_allclose(found, expected, atol=2e-3)


@pytest.mark.parametrize("mirrored", [False, True])
def test_hills_lean_as_the_coordinates_do(one_device, mirrored):
    """Towards larger u is where red is bright, on images that are mirrored too."""
    tilted = np.tile(unit([0.5, 0.25, 1]), (2, 2, 1))
    uv = SQUARE * [-1, 1] if mirrored else SQUARE
    camera = camera_at([0, 1, 2.4], [0, 1, -1], 30)
    found, _ = normals_of(one_device, with_maps(tilted, uv=uv, camera=camera), (1, 1))
    expected = unit([-0.5 if mirrored else 0.5, 0.25, 1])
    np.testing.assert_allclose(found[0], expected, atol=2e-3)


def test_from_behind_hills_are_dents(one_device):
    tilted = np.tile(unit([0.5, 0.25, 1]), (2, 2, 1))
    camera = camera_at([0, 1, 2.4], [0, 1, -1], 30)
    # With the other winding the camera sees the back: the front's normal, turned around.
    found, _ = normals_of(one_device, with_maps(tilted, turned=True, camera=camera), (1, 1))
    np.testing.assert_allclose(found[0], unit([-0.5, -0.25, 1]), atol=2e-3)


def test_a_normal_that_would_turn_from_the_viewer_is_not_taken(one_device):
    steep = np.tile(unit([-1.0, 0, 0.02]), (2, 2, 1))
    camera = camera_at([0.9, 1, 1], [0, 1, -1], 1)
    found, _ = normals_of(one_device, with_maps(steep, camera=camera), (1, 1))
    np.testing.assert_allclose(found[0], [0, 0, 1], atol=1e-6)


def test_a_scene_file_may_give_normals(tmp_path, one_device):
    write_image(tmp_path / "n.png", np.full((1, 1, 3), [0.5 + 0.5 * 0.6, 0.5, 0.9], np.float32))
    text = """
[camera]
position = [0, 0, 4]
target = [0, 0, 0]
vertical_fov = 28
[materials.m]
albedo = 0.5
normal = { file = "n.png", factor = 0.5 }
[[quads]]
corner = [-1, -1, 0]
edge1 = [2, 0, 0]
edge2 = [0, 2, 0]
material = "m"
"""
    (tmp_path / "x.toml").write_text(text)
    found, _ = normals_of(one_device, ncv.load_scene(tmp_path / "x.toml"), (1, 1))
    np.testing.assert_allclose(found[0], unit([0.3, 0, 0.8]), atol=5e-3)
    (tmp_path / "x.toml").write_text(text.replace('{ file = "n.png", factor = 0.5 }', "1"))
    with pytest.raises(SceneError, match=r"materials\.m\.normal: expected a table \{ file"):
        ncv.load_scene(tmp_path / "x.toml")
