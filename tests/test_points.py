"""Shading points: camera rays, interpolation, normals, offsets and their order."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from reference import (
    camera_at,
    camera_directions,
    grey,
    intersect,
    light_at,
    mesh_scene,
    quad,
    unit,
)

from ncv_cl.points.points import RELATIVE_OFFSET, find_points, triangle_spreads
from ncv_cl.points.trace import Tracer

MATERIALS = (grey((0.1, 0.2, 0.3), 0.04, 0.5), grey(0.9, (0.5, 0.6, 0.7), 0.1))


def soup(seed: int, count: int = 40) -> np.ndarray:
    """Random triangles in the cube [-1, 1]³."""
    generator = np.random.default_rng(seed)
    return generator.uniform(-1, 1, (count, 1, 3)) + generator.normal(0, 0.3, (count, 3, 3))


def placed(scene, scale: float, offset: float):
    """The scene scaled, then moved; in the single precision that all stages read."""
    shift = offset * np.array([1.0, -0.5, 0.7])
    camera = replace(
        scene.camera,
        position=(scene.camera.position * scale + shift).astype(np.float32).astype(float),
        target=(scene.camera.target * scale + shift).astype(np.float32).astype(float),
    )
    vertices = (scene.vertices.astype(float) * scale + shift).astype(np.float32)
    return replace(scene, camera=camera, vertices=vertices)


def points_of(device, scene, size=(37, 23), supersample=1, emitters_active=False):
    return find_points(device, scene, Tracer(scene, 2), *size, supersample, emitters_active)


def test_camera_looks_along_z_with_x_to_the_left(device):
    wall = mesh_scene(quad([-9, -9, 1], [18, 0, 0], [0, 18, 0]), camera_at([0, 0, 0], [0, 0, 5], 90))
    outgoing = points_of(device, wall, (2, 2)).rows("outgoing").T
    corners = np.array([[1, 1, 2], [-1, 1, 2], [1, -1, 2], [-1, -1, 2]])
    np.testing.assert_allclose(outgoing, -unit(corners), atol=1e-6)


@pytest.mark.parametrize("supersample", [1, 3])
def test_camera_rays_pass_through_subpixel_centres(device, supersample):
    camera = camera_at([1, 2, 3], [0.5, 0.3, -0.7], 35, up=[0.3, 1, -0.2])
    forward = unit(camera.target - camera.position)
    across = np.cross(forward, [0, 1, 0])
    corner = camera.position + forward - 9 * across - 9 * np.cross(across, forward)
    wall = mesh_scene(quad(corner, 18 * across, 18 * np.cross(across, forward)), camera)
    points = points_of(device, wall, (31, 9), supersample)
    assert points.total == points.active == 31 * 9 * supersample**2
    expected = -camera_directions(camera, 31, 9, supersample)
    np.testing.assert_allclose(points.rows("outgoing").T, expected, atol=3e-7)


@pytest.mark.parametrize(
    ("scale", "offset"), [(1, 0), (1e-3, 0), (1e4, 0), (1e3, 1e5), (1, 1e4), (1e-8, 0), (1e12, 0)]
)
@pytest.mark.parametrize("smooth", [False, True])
def test_points_match_brute_force(device, scale, offset, smooth):
    generator = np.random.default_rng(5)
    triangles = soup(5)
    normals = unit(generator.normal(size=triangles.shape)) if smooth else None
    material = generator.integers(0, 2, len(triangles))
    camera = camera_at([0.3, 0.4, 4], [0, 0, 0])
    scene = mesh_scene(triangles, camera, (), MATERIALS, normals, material)
    scene = placed(scene, scale, offset)
    points = points_of(device, scene)

    directions = camera_directions(scene.camera, 37, 23)
    start = np.broadcast_to(scene.camera.position, directions.shape)
    # What rounding does to a pixel's barycentric coordinates.
    slack = 1e-5 + 1e-6 * offset / scale
    triangle, u, v, _ = intersect(scene, start, directions)
    clear = [intersect(scene, start, directions, s)[0] == triangle for s in (slack, -slack)]
    hit = np.flatnonzero(triangle >= 0)
    sure = np.logical_and(*clear)
    assert sure.mean() > 0.8
    assert np.isin(points.cell, hit)[sure[points.cell]].all()
    assert np.isin(hit[sure[hit]], points.cell).all()

    rows = np.flatnonzero(sure[points.cell])
    cell = points.cell[rows]
    triangle, u, v = triangle[cell], u[cell, None], v[cell, None]
    corners = scene.vertices[scene.triangles[triangle]].astype(float)
    outgoing = -directions[cell]
    geometric = unit(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    facing = np.sum(geometric * outgoing, 1)
    geometric *= np.sign(facing)[:, None]
    ulp = np.spacing(np.abs(corners).max(axis=(1, 2)).astype(np.float32)).astype(float)
    position = points.rows("position").T[rows]
    off_plane = np.abs(np.sum((position - corners[:, 0]) * geometric, 1))
    # The offset of ray origins must dwarf what interpolation loses.
    assert (off_plane <= 2 * ulp).all()
    blend = [1 - u - v, u, v]
    expected = sum(b * corners[:, i] for i, b in enumerate(blend))
    grazing = np.maximum(np.abs(facing), 1e-3)
    assert (np.linalg.norm(position - expected, axis=1) <= (8 * ulp + 1e-5 * scale) / grazing).all()
    np.testing.assert_allclose(points.rows("geometric_normal").T[rows], geometric, atol=3e-5)
    moved = points.rows("offset")[0, rows]
    assert (off_plane <= moved / 8).all()
    wanted = np.abs(position).max(axis=1) + triangle_spreads(corners, geometric)
    np.testing.assert_allclose(moved, RELATIVE_OFFSET * wanted, rtol=1e-4)
    for name, value in [
        ("albedo", [m.albedo for m in MATERIALS]),
        ("reflectance", [m.reflectance for m in MATERIALS]),
        ("roughness", [[m.roughness] for m in MATERIALS]),
    ]:
        values = np.array(value, np.float32)[scene.triangle_material[triangle]]
        np.testing.assert_array_equal(points.rows(name).T[rows], values)

    shading = geometric
    decided = np.ones(len(rows), bool)
    if smooth:
        corner_normals = scene.vertex_normals[scene.triangles[triangle]].astype(float)
        shading = sum(b * corner_normals[:, i] for i, b in enumerate(blend))
        side = np.sum(shading * geometric, 1)
        length = np.linalg.norm(shading, axis=1)
        shading = unit(shading * np.where(side < 0, -1, 1)[:, None])
        turned = np.sum(shading * outgoing, 1)
        shading = np.where((turned <= 0)[:, None], geometric, shading)
        decided = (np.abs(side) > 1e-2) & (np.abs(turned) > 1e-2) & (length > 0.1)
        assert (turned[decided] <= 0).any(), "no silhouette falls back"
    tolerance = 1e-4 + 3e-6 * offset / scale
    np.testing.assert_allclose(points.rows("normal").T[rows][decided], shading[decided], atol=tolerance)


@pytest.mark.parametrize("smooth", [False, True])
def test_both_normals_face_the_viewer(device, smooth):
    normals = unit(np.random.default_rng(1).normal(size=(40, 3, 3))) if smooth else None
    scene = mesh_scene(soup(2), camera_at([0, 0, 4], [0, 0, 0]), normals=normals)
    points = points_of(device, scene)
    outgoing = points.rows("outgoing")
    for name in ("normal", "geometric_normal"):
        normal = points.rows(name)
        np.testing.assert_allclose(np.linalg.norm(normal, axis=0), 1, atol=1e-6)
        assert (np.sum(normal * outgoing, 0) > -1e-6).all()


@pytest.mark.parametrize("emitters_active", [False, True])
def test_points_are_row_major_with_inactive_emitters_last(device, emitters_active):
    lights = (
        light_at([-1, 1, 0], [2, 0, 0], [0, -0.5, 0]),
        light_at([-1, -1, 0], [0.5, 0, 0], [0, 0.3, 0]),
    )
    wall = quad([-1, -0.6, 0], [2, 0, 0], [0, 1, 0])
    scene = mesh_scene(wall, camera_at([0, 0, 4], [0, 0, 0]), lights)
    size, supersample = (19, 13), 2
    points = points_of(device, scene, size, supersample, emitters_active)
    directions = camera_directions(scene.camera, *size, supersample)
    start = np.broadcast_to(scene.camera.position, directions.shape)
    triangle = intersect(scene, start, directions)[0]
    light = np.where(triangle >= 0, scene.triangle_light[triangle], -1)
    assert points.background == np.count_nonzero(triangle < 0) > 0
    hit = np.flatnonzero(triangle >= 0)
    first = hit if emitters_active else hit[light[hit] < 0]
    last = np.setdiff1d(hit, first)
    assert points.active == len(first)
    assert set(light[hit]) == {-1, 0, 1}
    np.testing.assert_array_equal(points.cell, np.concatenate([first, last]))
    np.testing.assert_array_equal(points.light, light[points.cell])
    np.testing.assert_allclose(points.rows("outgoing").T, -directions[points.cell], atol=3e-7)


def test_a_view_of_nothing_has_no_points(device):
    scene = mesh_scene(quad([-1, 0, -1], [2, 0, 0], [0, 0, 2]), camera_at([0, 1, 0], [0, 5, 0.1]))
    points = points_of(device, scene, (5, 3))
    assert (points.total, points.active, points.background) == (0, 0, 15)
    assert points.rows("normal").shape == (3, 0)


def test_batches_of_camera_rays_do_not_change_the_points(one_device, monkeypatch):
    scene = mesh_scene(soup(3), camera_at([0, 0, 4], [0, 0, 0]))
    whole = points_of(one_device, scene)
    monkeypatch.setattr("ncv_cl.points.points.CAMERA_RAYS_PER_BATCH", 100)
    parts = points_of(one_device, scene)
    np.testing.assert_array_equal(whole.cell, parts.cell)
    np.testing.assert_array_equal(whole.surface.read(), parts.surface.read())
