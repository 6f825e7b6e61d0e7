"""Values at points: the bits of a camera, closed forms, orders, refusals."""

from __future__ import annotations

import json

import numpy as np
import pytest
import trimesh
from reference import camera_at, grey, light_at, light_corners, mesh_scene, polygon_irradiance, quad

import ncv_cl as ncv
from ncv_cl import PointError
from ncv_cl.integrands import IntegrandError
from ncv_cl.points.arrays import curve_cells, ordered
from ncv_cl.points.points import find_points
from ncv_cl.points.trace import Tracer

CAMERA = camera_at((0, 2, 6), (0, 0, 0))
FLOOR = quad((-1, 0, -1), (0, 0, 2), (2, 0, 0))
LAMP = light_at((-0.5, 2, -0.5), (1, 0, 0), (0, 0, 1), 3.0)
UP = np.array([[0.0, 1.0, 0.0]])


def lamp_scene(*lights, meshes=(FLOOR,), albedo=0.5):
    return mesh_scene(np.concatenate(meshes), CAMERA, lights or (LAMP,), (grey(albedo),))


def sensors(number: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Places over a floor, and directions of the upper hemisphere."""
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(number, 3))
    normals[:, 1] = np.abs(normals[:, 1])
    return rng.uniform((-0.9, 0.05, -0.9), (0.9, 1.5, 0.9), (number, 3)), normals


def above_horizon(corners: np.ndarray, position: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """What of a polygon lies above a sensor's plane."""
    heights = (corners - position) @ normal
    kept = []
    for k, (corner, height) in enumerate(zip(corners, heights, strict=True)):
        last, before = corners[k - 1], heights[k - 1]
        if (height > 0) != (before > 0):
            kept.append(last + (corner - last) * before / (before - height))
        if height > 0:
            kept.append(corner)
    return np.array(kept)


def lambert(lights, positions, normals) -> np.ndarray:
    """Irradiance without shadows, float64 (n, 3)."""
    found = np.zeros((len(positions), 3))
    for light in lights:
        for k, (position, normal) in enumerate(zip(positions, normals, strict=True)):
            normal = normal / np.linalg.norm(normal)
            polygon = above_horizon(light_corners(light), position, normal)
            if len(polygon) and (light.two_sided or (position - light.corner) @ light.normal > 0):
                found[k] += polygon_irradiance(polygon, position, normal) * light.radiance
    return found


def camera_points(device, scene, size):
    """Positions, normals and directions of what the camera sees in every pixel, (rows, columns, 3)."""
    found = find_points(device, scene, Tracer(scene), *size, 1, True)
    order = np.argsort(found.cell)
    rows = (found.rows(row).T[order].astype(float) for row in ("position", "normal", "outgoing"))
    position, normal, outgoing = (one.reshape(size[1], size[0], 3) for one in rows)
    return position + scene.origin, normal, outgoing


@pytest.mark.parametrize("method", ["mc", "ncv"])
@pytest.mark.parametrize("name", ["direct", "gi", "ao"])
def test_a_cameras_points_as_arrays_have_the_bits_of_its_image(scenes, one_device, name, method):
    scene, size = ncv.load_scene(scenes / "interior.toml"), (24, 16)
    options = {"method": method, "spp": 16, "seed": 3, "device": one_device}
    if method == "ncv":
        options["train_spp"] = 8
    position, normal, outgoing = camera_points(one_device, scene, size)
    integrand = ncv.AmbientOcclusion(radius=0.5) if name == "ao" else name
    image = ncv.render(scene, integrand, size=size, **options)
    values = ncv.radiance(scene, position, normal, outgoing, integrand=integrand, **options)
    assert image.pixels.any() and image.variance.any()
    assert np.array_equal((values.values + np.zeros(3)).astype(np.float32), image.pixels)
    assert np.array_equal((values.variance + np.zeros(3)).astype(np.float32), image.variance)
    if name == "ao":
        again = ncv.ambient_occlusion(scene, position, normal, radius=0.5, **options)
        assert np.array_equal(again.values, values.values[..., 0])


def test_irradiance_is_pi_times_the_radiance_of_a_white_surface(one_device):
    scene = lamp_scene(albedo=1.0)
    x, z = np.meshgrid(np.linspace(-0.9, 0.9, 8), np.linspace(-0.9, 0.9, 8))
    at = np.stack([x, 0 * x, z], axis=-1)
    up = np.broadcast_to(UP, at.shape)
    options = {"spp": 8, "method": "mc", "device": one_device}
    received = ncv.irradiance(scene, at, up, **options)
    sent = ncv.radiance(scene, at, up, up, integrand="direct", **options)
    assert np.array_equal(received.values, np.pi * sent.values)
    assert np.array_equal(received.variance, np.pi**2 * sent.variance)
    assert received.stats["points_detached"] == 0


def test_irradiance_without_shadows_is_lamberts(device):
    """Of sensors in the air; a row of strips made for the floor would leave out the lamp below it."""
    low = light_at((1.5, -0.6, -0.5), (0, 0, 1), (0, 0.4, 0), 9.0, two_sided=True)
    scene = lamp_scene(LAMP, low)
    at, normals = sensors(512)
    found = ncv.irradiance(scene, at, normals, spp=64, method="mc", device=device, visibility="lines")
    # The floor may shade what is below it: sensors that it cannot, or that it hides all of.
    exact = lambert([LAMP, low], at, normals)
    reaches = at[:, 1] * (1.5 - 1.0) > 0.6 * (1.0 - at[:, 0])  # over the floor's edge
    assert reaches.sum() > 50 and found.stats["points_detached"] == 512
    only_low = lambert([low], at, normals)[reaches]
    assert np.count_nonzero(only_low.mean(axis=1) > 0.1) > 10
    error = found.values[reaches] - exact[reaches]
    allowed = 5 * found.standard_error[reaches] + 1e-5 * exact[reaches].max()
    assert (np.abs(error) <= allowed).all()


def test_errors_are_as_large_as_said(one_device):
    scene = lamp_scene()
    at, normals = sensors(2000, seed=1)
    exact = lambert([LAMP], at, normals)[:, 0]
    for sampler in ("sobol", "independent"):
        found = ncv.irradiance(
            scene,
            at,
            normals,
            spp=16,
            method="mc",
            device=one_device,
            visibility="points",
            sampler=sampler,
        )
        lit = exact > 0.05
        z = (found.values[:, 0] - exact)[lit] / found.standard_error[lit, 0]
        assert 0.8 < np.sqrt(np.mean(z**2)) < 1.25, sampler
        assert abs(z.mean()) < 4 / np.sqrt(lit.sum())


def test_both_sides_add(one_device):
    other = light_at((-0.5, -2, -0.5), (0, 0, 1), (1, 0, 0), 5.0)
    scene = lamp_scene(LAMP, other, meshes=(quad((3, 0, 3), (0, 0, 1), (1, 0, 0)),))
    at, normals = sensors(64)
    found = ncv.irradiance(scene, at, normals, both_sides=True, spp=64, device=one_device)
    exact = lambert([LAMP, other], at, normals) + lambert([LAMP, other], at, -normals)
    assert found.values.shape == found.variance.shape == (64, 3)
    assert (np.abs(found.values - exact) <= 5 * found.standard_error + 1e-5 * exact.max()).all()


def test_all_light_in_a_furnace_is_pi(one_device):
    """Black walls of radiance 1 all around: every sensor gets pi, wherever it looks."""
    box = ncv.TriangleMesh(*_box((-1, -1, -1), (1, 1, 1)), material="hot")
    scene = ncv.build_scene(CAMERA, {"hot": ncv.Material(0.0, emission=1.0)}, [box])
    at, normals = sensors(50)
    options = {"method": "mc", "spp": 1024, "sampler": "independent", "device": one_device}
    found = ncv.irradiance(scene, 0.5 * at, normals, integrand="gi", **options)
    assert (found.standard_error < 0.02 * np.pi).all()
    assert (np.abs(found.values - np.pi) < 4.5 * found.standard_error).all()


def _box(lower, upper):
    box = trimesh.creation.box(bounds=np.array([lower, upper], float))
    return box.vertices, box.faces


def test_sky_view_factor_in_front_of_a_wall(one_device):
    """Of the ground before an endless wall, (1 + cos a) / 2 at an angle of elevation a."""
    wall = quad((-4000, 0, 0), (8000, 0, 0), (0, 3, 0))
    scene = mesh_scene(np.concatenate([wall, FLOOR]), CAMERA)
    distance = np.linspace(0.1, 0.9, 200)
    at = np.stack([0 * distance, 0 * distance, distance], axis=1)
    found = ncv.ambient_occlusion(
        scene, at, np.broadcast_to(UP, at.shape), spp=256, method="mc", device=one_device,
        visibility="lines",
    )  # fmt: skip
    exact = (1 + distance / np.hypot(distance, 3)) / 2
    assert found.values.shape == found.variance.shape == (200,)
    z = (found.values - exact) / np.maximum(found.standard_error, 1e-5)
    assert np.abs(z).max() < 5
    assert np.abs(found.values - exact).mean() < 2e-3


@pytest.mark.parametrize("method", ["mc", "ncv"])
def test_the_order_of_points_changes_nothing_but_that_of_results(one_device, method):
    scene = lamp_scene()
    at, normals = sensors(300)
    at, normals = (np.concatenate([array, array[:20]]) for array in (at, normals))
    options = {"spp": 8, "method": method, "device": one_device, "seed": 2}
    if method == "ncv":
        options["train_spp"] = 4
    plain = ncv.irradiance(scene, at, normals, **options)
    order = np.random.default_rng(5).permutation(len(at))
    mixed = ncv.irradiance(scene, at[order], normals[order], **options)
    assert np.array_equal(plain.values[order], mixed.values)
    assert np.array_equal(plain.variance[order], mixed.variance)
    assert np.array_equal(plain.values[:20], plain.values[-20:])
    assert plain.stats["equal_points"] == 20 and plain.stats["points"] == 320


def test_points_are_ordered_along_a_curve_once_each():
    rng = np.random.default_rng(0)
    vectors = rng.integers(0, 4, (500, 6)).astype(np.float32)
    first, number = ordered(vectors)
    assert np.array_equal(vectors[first][number], vectors)
    assert len(np.unique(vectors, axis=0)) == len(first)
    cells, (columns, rows) = curve_cells(len(first))
    assert len(np.unique(cells)) == len(first) and cells.max() < columns * rows
    x, y = cells % columns, cells // columns
    # Sixteen in a row are a square of four.
    assert np.ptp(x[:16]) == np.ptp(y[:16]) == 3


def test_lengths_of_normals_and_layout_do_not_matter(one_device):
    scene = lamp_scene()
    at, normals = sensors(40)
    options = {"spp": 4, "device": one_device}
    plain = ncv.irradiance(scene, at, normals, **options)
    scaled = ncv.irradiance(scene, at.tolist(), 1e-30 * normals, **options)
    assert np.allclose(plain.values, scaled.values, rtol=1e-4, atol=1e-6)
    unit = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    assert np.array_equal(ncv.irradiance(scene, at, unit, **options).values, plain.values)


@pytest.mark.parametrize("number", [0, 1])
def test_no_point_and_a_single_one(one_device, number):
    scene = lamp_scene()
    at, up = np.zeros((number, 3)), np.repeat(UP, number, axis=0)
    for method in ("mc", "ncv", "auto"):
        found = ncv.irradiance(scene, at, up, spp=16, method=method, device=one_device)
        assert found.values.shape == found.variance.shape == (number, 3)
        assert found.stats["points"] == number
        if number:
            error = found.values - lambert([LAMP], at, up)
            assert (np.abs(error) < 4 * found.standard_error + 1e-6).all()
            assert (found.standard_error < 1e-3).all() and found.stats["estimates_a_point"] == 256
    assert ncv.ambient_occlusion(scene, at, up, spp=4, device=one_device).values.shape == (number,)
    sent = ncv.radiance(scene, at, up, up, spp=4, device=one_device)
    assert sent.values.shape == (number, 3)
    json.dumps(found.stats, allow_nan=False)


def test_sensors_on_lights_inside_things_and_at_surfaces_are_counted(one_device):
    inside = ncv.TriangleMesh(*_box((0.4, 0.0, 0.4), (0.8, 0.4, 0.8)), material="grey")
    floor = ncv.TriangleMesh(*_corners(FLOOR), material="grey")
    scene = ncv.build_scene(CAMERA, {"grey": grey()}, [floor, inside], [LAMP])
    #   on the floor, below it by rounding, in the box, on the lamp, in the air, at night
    at = [[-0.5, 0, 0], [-0.5, -1e-6, 0.1], [0.6, 0.2, 0.6], [0, 2, 0], [-0.5, 0.5, 0], [0, 1, 0]]
    normals = [[0, 1, 0], [0, 1, 0], [0, 1, 0], [0, -1, 0], [0, 1, 0], [0, -1, 0]]
    found = ncv.irradiance(scene, at, normals, spp=64, device=one_device)
    assert found.stats["points_detached"] == 3
    assert found.stats["points_on_lights"] == 1
    assert found.stats["points_zero"] == 3 and found.stats["points_without_light"] == 2
    exact = lambert([LAMP], np.array(at, float), np.array(normals, float))
    seen = [0, 1, 4]
    assert np.allclose(found.values[seen], exact[seen], rtol=2e-3)
    assert not found.values[[2, 3, 5]].any()


def test_a_sensor_in_a_lamps_plane_gets_the_other_lamps_light(device):
    """Along lines of a lamp in whose plane the sensor lies no light comes, and nothing is undefined."""
    up = light_at((-0.5, 0.5, -0.5), (0, 0, 1), (1, 0, 0), 2.0)
    scene = lamp_scene(LAMP, up)
    at = np.array([[x, 2, z] for x in (-2, 0, 0.3, 2) for z in (-0.5, 0, 0.5, 2.0)])
    down = np.broadcast_to([[0.0, -1, 0]], at.shape)
    found = ncv.irradiance(scene, at, down, spp=64, visibility="lines", device=device)
    exact = lambert([up], at, down)
    assert (np.abs(found.values - exact) <= 5 * found.standard_error + 1e-5).all() and exact.all()


def test_a_sensor_on_a_tilted_lamp_sees_what_the_floor_beneath_does_not(device):
    """Its strips are not those of the floor's cell, which leave out a lamp below the floor."""
    tilted = light_at((0.5, 0.5, -0.2), (0, 0, 0.4), (0.16, -0.12, 0), 3.0, two_sided=True)
    low = light_at((3, -0.6, -0.5), (0, 0, 1), (0, 0.4, 0), 9.0, two_sided=True)
    scene = lamp_scene(tilted, low)
    rng = np.random.default_rng(2)
    at = (
        np.array([0.5, 0.5, -0.2])
        + rng.random((40, 1)) * [0, 0, 0.4]
        + rng.random((40, 1)) * [0.16, -0.12, 0]
    )
    normals = np.broadcast_to(tilted.normal, at.shape)
    found = ncv.irradiance(scene, at, normals, spp=64, device=device)
    exact = lambert([low], at, normals)
    assert found.stats["points_on_lights"] == 40 and exact.min() > 0.05
    assert (np.abs(found.values - exact) <= 5 * found.standard_error + 1e-5).all()


def _corners(mesh: np.ndarray):
    vertices = np.asarray(mesh, float).reshape(-1, 3)
    return vertices, np.arange(len(vertices)).reshape(-1, 3)


def test_radiance_has_what_lights_and_surfaces_emit(one_device):
    hot = ncv.Material(0.5, emission=(0.25, 0.5, 1))
    floor = ncv.TriangleMesh(*_corners(FLOOR), material="hot")
    scene = ncv.build_scene(CAMERA, {"hot": hot}, [floor], [LAMP])
    down = [[0, -1, 0], [0, -1, 0]]
    lamp = ncv.radiance(scene, [[0, 2, 0], [0, 0, 0]], down, down, spp=4, device=one_device)
    assert np.allclose(lamp.values, [[3, 3, 3], [0.25, 0.5, 1]])
    assert not lamp.variance.any()
    lit = ncv.radiance(scene, [[0, 0, 0]], UP, UP, spp=64, device=one_device).values
    assert np.allclose(lit - lambert([LAMP], [[0, 0, 0]], UP) * 0.5 / np.pi, [0.25, 0.5, 1], atol=1e-3)


def test_a_network_of_an_image_serves_points(one_device, tmp_path, scenes):
    scene, file = ncv.load_scene(scenes / "interior.toml"), tmp_path / "network.npz"
    options = {"method": "ncv", "spp": 8, "device": one_device}
    ncv.render(scene, "gi", size=(24, 16), train_spp=16, save_network=file, **options)
    image = ncv.render(scene, "gi", size=(24, 16), network=file, **options)
    found = ncv.radiance(scene, *camera_points(one_device, scene, (24, 16)), network=file, **options)
    assert "train" not in found.stats["seconds"] and found.stats["method"] == "ncv"
    assert np.array_equal(found.values.astype(np.float32), image.pixels)


def test_far_away_rays_are_traced(one_device):
    """A blind before the lamp, from 300 times the scene's size: half of it is seen."""
    scene = lamp_scene(meshes=(quad((-2, 1.9, -2), (0, 0, 4), (2, 0, 0)),))
    at = np.array([[0.0, -300, 30 * k] for k in range(-5, 6)])
    found = ncv.irradiance(scene, at, -at, spp=256, device=one_device)
    half = light_at((0, 2, -0.5), (0.5, 0, 0), (0, 0, 1), 3.0)
    exact = lambert([half], at, -at)
    assert found.stats["rays_traced"] and np.allclose(found.values, exact, rtol=2e-2)
    with pytest.raises(ValueError, match="no farther away than 16 times"):
        ncv.irradiance(scene, at, -at, visibility="lines", device=one_device)


def test_a_target_ends_it(one_device):
    scene = lamp_scene(meshes=(FLOOR, quad((-0.3, 1, -0.3), (0, 0, 0.6), (0.6, 0, 0))))
    at, normals = sensors(400)
    found = ncv.irradiance(
        scene, at, normals, both_sides=True, spp=1 << 14, method="mc", visibility="points",
        target_error=3e-3, device=one_device,
    )  # fmt: skip
    root_mean_square = np.sqrt(found.variance.mean())
    assert found.stats["ended_by"] == "target_mse" and root_mean_square <= 3e-3
    assert found.stats["samples_per_point"] < 1 << 13
    assert root_mean_square > 3e-4


BAD = [
    ("positions[1]", lambda at, n: (np.array([[0, 0, 0], [0, np.nan, 0]]), n)),
    ("positions[0][2]", lambda at, n: (np.full((1, 3, 3), [[0.0], [0.0], [np.inf]]), n)),
    ("positions: expected numbers", lambda at, n: (np.zeros((4, 2)), n)),
    ("positions: expected numbers", lambda at, n: ([[1, 2, 3], [1, 2]], n)),
    ("positions: expected numbers", lambda at, n: ([["a", "b", "c"]], n)),
    ("normals[1]: is zero", lambda at, n: (at, np.array([[0, 1, 0], [0, 0, 0]]))),
    ("normals: must have the shape", lambda at, n: (at, n[:1])),
    ("normals[0]: [0.0, inf, 0.0] is not finite", lambda at, n: (at, [[0, np.inf, 0], [0, 1, 0]])),
]


@pytest.mark.parametrize(("message", "spoil"), BAD)
def test_bad_points_are_named_by_index(one_device, message, spoil):
    at, normals = spoil(np.zeros((2, 3)), np.repeat(UP, 2, axis=0))
    with pytest.raises(PointError) as raised:
        ncv.irradiance(lamp_scene(), at, normals, device=one_device)
    assert message in str(raised.value)


def test_what_has_no_effect_or_no_meaning_is_refused(one_device):
    scene, at = lamp_scene(), np.array([[0, 0.5, 0.0]])
    places = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.5, 0]])
    with pytest.raises(PointError, match=r"positions\[2\]: .* lies on no surface"):
        up = np.repeat(UP, 3, axis=0)
        ncv.radiance(scene, places, up, up, device=one_device)
    with pytest.raises(IntegrandError, match="not ao"):
        ncv.irradiance(scene, at, UP, integrand="ao", device=one_device)
    with pytest.raises(ValueError, match="supersample"):
        ncv.irradiance(scene, at, UP, supersample=2, device=one_device)
    with pytest.raises(TypeError, match="checkpoint"):
        ncv.irradiance(scene, at, UP, checkpoint="a.npz", device=one_device)
    with pytest.raises(ValueError, match="target_error must be"):
        ncv.irradiance(scene, at, UP, target_error=-1, device=one_device)
    with pytest.raises(ValueError, match="not both"):
        ncv.irradiance(scene, at, UP, target_error=1, target_mse=1, device=one_device)


def test_radiance_of_a_textured_room_is_that_of_its_picture(scenes, one_device):
    """Colours, gloss, emission and bent normals are those of the place on the surface."""
    scene = ncv.load_scene(scenes / "textured_room.toml")
    options = {"method": "mc", "spp": 64, "seed": 3, "device": one_device, "visibility": "embree"}
    points = find_points(one_device, scene, Tracer(scene), 24, 16)
    on_surface = points.light < 0
    position, normal, outgoing = (
        points.rows(name).T[on_surface].astype(np.float64) for name in ("position", "normal", "outgoing")
    )
    found = ncv.radiance(scene, position + scene.origin, normal, outgoing, integrand="gi", **options)
    image = ncv.render(scene, "gi", size=(24, 16), **options)
    pixels = image.pixels.reshape(-1, 3)[points.cell[on_surface]]
    variance = image.variance.reshape(-1, 3)[points.cell[on_surface]] + found.variance
    deviations = (found.values - pixels) / np.sqrt(np.maximum(variance, 1e-12))
    assert abs(deviations.mean()) < 4 / np.sqrt(len(deviations))
    assert np.mean(np.abs(deviations) < 4) > 0.97
