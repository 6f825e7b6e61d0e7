"""Means agree with an independent renderer's: the scene's conversion, and ours."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from reference import camera_at, grey, light_at, mesh_scene, quad

import ncv_cl as ncv

pytest.importorskip("mitsuba", reason="mitsuba is not installed")
sys.path.insert(0, str(Path(__file__).parent.parent / "bench"))
import compare_mitsuba
from mitsuba_scene import MitsubaScene

CASES = [case for case in compare_mitsuba.CASES if case[0] != "knot"]
# Batch means of six images have few degrees of freedom.
DEVIATIONS = 6.0


@pytest.fixture(scope="module")
def mitsuba():
    return compare_mitsuba.import_mitsuba()


def check(row):
    for difference, error in zip(row["difference"], row["standard_error"], strict=True):
        # Shadow rays start and end elsewhere by design: that is a bias of at most a thousandth.
        assert abs(difference) <= DEVIATIONS * error + 1e-3


@pytest.mark.slow
@pytest.mark.parametrize(("scene", "integrand"), CASES)
def test_means_agree(one_device, mitsuba, scene, integrand):
    row = compare_mitsuba.agreement(
        mitsuba, one_device, scene, integrand, True, size=(24, 24), batches=6, spp=16
    )
    if "skipped" in row:
        pytest.skip(row["skipped"])
    check(row)


@pytest.mark.parametrize("two_sided", [False, True])
def test_a_light_shines_from_its_sides_and_reflects_nothing(one_device, mitsuba, two_sided):
    # A skewed light between two walls; its front is towards the right wall, and the camera sees it.
    light = light_at([-0.1, -0.6, -0.5], [0.2, 1, 0], [0, 0.3, 1], (3, 2, 1), two_sided)
    walls = [quad([x, -2, -2], [0, 4, 0], [0, 0, 4]) for x in (-1, 1)]
    scene = mesh_scene(np.concatenate(walls), camera_at([0, 0.3, 4], [0, 0, 0], 50), (light,), (grey(),))
    theirs = MitsubaScene(mitsuba, scene)
    size, spp = (16, 12), 64
    other = np.stack([theirs.radiance(compare_mitsuba.DIRECT, size, 1, spp, s) for s in range(6)])
    ours = np.stack(
        [
            ncv.render(scene, "direct", "mc", spp=spp, size=size, seed=s, device=one_device).pixels
            for s in range(6)
        ]
    ).astype(np.float64)
    check(compare_mitsuba.compare(ours, other, spp))
    right = np.s_[:, :, size[0] // 2 + 4 :], np.s_[:, :, : size[0] // 2 - 4]
    lit = [stack[half].mean() > 0 for stack in (ours, other) for half in right]
    assert lit == [True, two_sided] * 2


def textured_room():
    """A room lit by a lamp at its ceiling: images that go on in each way, and colours of vertices."""
    generator = np.random.default_rng(3)
    square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    images = [
        ncv.Texture.of(generator.random((height, width, 3)), wrap, nearest)
        for height, width, wrap, nearest in (
            (7, 5, "repeat", False), (4, 6, "mirror", False),
            (5, 5, "clamp", False), (3, 4, "repeat", True),
        )
    ]  # fmt: skip
    walls = {
        "floor": ([-2, 0, 2], [4, 0, 0], [0, 0, -4], images[0]),
        "back": ([-2, 0, -2], [4, 0, 0], [0, 3, 0], images[1]),
        "left": ([-2, 0, 2], [0, 0, -4], [0, 3, 0], images[2]),
        "right": ([2, 0, -2], [0, 0, 4], [0, 3, 0], images[3]),
        "ceiling": ([-2, 3, -2], [4, 0, 0], [0, 0, 4], 0.7),
        "shelf": ([-1, 0.9, 0], [1.5, 0.2, 0], [0, 0.1, -1.2], 0.9),
    }
    meshes, materials = [], {}
    for name, (corner, edge1, edge2, albedo) in walls.items():
        vertices = np.array([corner + u * np.array(edge1) + v * np.array(edge2) for u, v in square])
        colours = generator.random((4, 3)) if name == "shelf" else None
        uv = square @ [[2.3, 0.4], [-0.3, 1.6]] - 0.4
        meshes.append(ncv.TriangleMesh(vertices, [[0, 1, 2], [0, 2, 3]], name, uv=uv, colours=colours))
        materials[name] = ncv.Material(albedo)
    lamp = ncv.QuadLight((-0.7, 2.9, -0.7), (1.4, 0, 0), (0, 0, 1.4), (12, 10, 8))
    return ncv.build_scene(ncv.Camera((0.3, 1.6, 4.5), (0, 1.2, -1), 55), materials, meshes, [lamp])


@pytest.mark.parametrize("depth", [2, 5])
def test_a_textured_room_agrees(one_device, mitsuba, depth):
    scene = textured_room()
    theirs = MitsubaScene(mitsuba, scene)
    size, spp = (32, 24), 64
    path = {"type": "path", "max_depth": depth, "rr_depth": 1000}
    other = np.stack([theirs.radiance(path, size, 1, spp, s) for s in range(6)])
    integrand = ncv.GlobalIllumination(depth)
    options = {"method": "mc", "size": size, "device": one_device}
    ours = np.stack(
        [ncv.render(scene, integrand, spp=spp, seed=s, **options).pixels for s in range(6)]
    ).astype(np.float64)
    row = compare_mitsuba.compare(ours, other, spp)
    for difference, error in zip(row["difference"], row["standard_error"], strict=True):
        assert abs(difference) <= max(4 * error, 0.005) and error < 0.005
    # Pixel by pixel, for images that are laid otherwise may have the same mean.
    variance = (ours.var(0, ddof=1) + other.var(0, ddof=1)) / 6
    z = (ours.mean(0) - other.mean(0)) / np.sqrt(variance + 1e-12)
    assert np.mean(np.abs(z) < 4) > 0.97
    turned = (ours.mean(0)[:, ::-1] - other.mean(0)) / np.sqrt(variance + 1e-12)
    assert np.mean(np.abs(turned) < 4) < 0.7


def lamps():
    """A floor and a wall under lights of every shape, two of them surfaces that reflect."""
    square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    floor = square[:, [1, 0]] @ np.array([[6.0, 0, 0], [0, 0, 6]]) - [3, 0, 3]
    wall = square @ np.array([[6.0, 0, 0], [0, 4, 0]]) - [3, 0, 2]
    panel = square @ np.array([[0.7, 0, 0.2], [0, 0.8, 0.3]]) + [-2, 0.6, -1.5]
    tent = np.array([[1.2, 0.1, 0.2], [1.9, 0.1, 0.1], [1.6, 0.1, 0.8], [1.5, 0.9, 0.4]])
    sides = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
    meshes = [
        ncv.TriangleMesh(floor, faces, "dull"),
        ncv.TriangleMesh(wall, faces, "dull"),
        ncv.TriangleMesh(panel, faces, "panel"),
        ncv.TriangleMesh(tent, sides, "tent"),
    ]
    materials = {
        "dull": ncv.Material((0.6, 0.5, 0.4)),
        "panel": ncv.Material(0.3, emission=(2, 1, 0.5)),
        "tent": ncv.Material(0.5, emission=(0.5, 1, 2)),
    }
    lights = [
        ncv.DiscLight((0.5, 2.5, -0.5), (0.2, -1, 0.1), 0.4, 4),
        ncv.SphereLight((-0.7, 1.2, 0.4), 0.3, 3),
        ncv.SpotLight((-0.5, 2.2, 1), 4, direction=(0.7, -1, -0.4), outer_angle=35),
        ncv.PointLight((2.2, 2, 1), 1.5),
    ]
    return ncv.build_scene(ncv.Camera((0.5, 2, 6), (0, 1, 0), 50), materials, meshes, lights)


@pytest.mark.parametrize("depth", [2, 4])
def test_lights_of_every_shape_agree(one_device, mitsuba, depth):
    scene = lamps()
    theirs = MitsubaScene(mitsuba, scene)
    size, spp = (24, 18), 64
    path = {"type": "path", "max_depth": depth, "rr_depth": 1000}
    other = np.stack([theirs.radiance(path, size, 1, spp, s) for s in range(6)])
    options = {"method": "mc", "size": size, "device": one_device}
    integrand = ncv.GlobalIllumination(depth)
    ours = np.stack(
        [ncv.render(scene, integrand, spp=spp, seed=s, **options).pixels for s in range(6)]
    ).astype(np.float64)
    check(compare_mitsuba.compare(ours, other, spp))
    variance = (ours.var(0, ddof=1) + other.var(0, ddof=1)) / 6
    z = (ours.mean(0) - other.mean(0)) / np.sqrt(variance + 1e-12)
    assert np.mean(np.abs(z) < 4) > 0.97


def test_a_difference_of_means_is_seen():
    generator = np.random.default_rng(0)
    images = 1 + 0.01 * generator.normal(size=(2, 8, 6, 5, 3))
    same = compare_mitsuba.compare(*images, 1)
    other = compare_mitsuba.compare(images[0] * 1.02, images[1], 1)
    assert same["agrees"] and not other["agrees"]
    np.testing.assert_allclose(other["difference"], 0.02, atol=0.005)
