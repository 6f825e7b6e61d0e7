"""Direct light: every sample against float64, and Lambert's closed form for whole pictures."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from reference import (
    batch_arrays,
    camera_at,
    grey,
    light_at,
    light_corners,
    light_samples,
    mesh_scene,
    polygon_irradiance,
    quad,
    render_plain,
    sampling,
    scattering,
    shadowed_values,
)

from ncv_cl.integrands import DirectLight, IntegrandError
from ncv_cl.integrands.light_cells import cell_of
from ncv_cl.integrands.lights import light_rows
from ncv_cl.sampling.samples import NO_RAY
from ncv_cl.scene.load import load_scene

FLOOR = quad([-10, 0, -10], [0, 0, 20], [20, 0, 0])
CAMERA = camera_at([0, 2.5, 4.5], [0, 0, 1])
# None of them stands between another and what the camera sees.
LIGHTS = (
    light_at([-1, 2, -1], [2, 0, 0], [0, 0, 2], (5, 4, 3)),
    light_at([4, 0.5, 1], [0, 0, 1], [0, 1, 0.3], (1, 90, 20)),
    light_at([-5, 0.5, 0], [0, 1, 0], [1, 0, 0.3], 40, two_sided=True),
)


def floor_scene(lights, material=None, camera=CAMERA, scale=1.0, offset=0.0):
    """A floor under lights, scaled and moved."""
    shift = offset * np.array([1.0, 0.5, -0.7])
    moved = tuple(
        light_at(one.corner.astype(float) * scale + shift, one.edge1.astype(float) * scale,
                 one.edge2.astype(float) * scale, one.radiance, one.two_sided)
        for one in lights
    )  # fmt: skip
    camera = replace(
        camera, position=camera.position * scale + shift, target=camera.target * scale + shift
    )
    return mesh_scene(FLOOR * scale + shift, camera, moved, (material or grey(),))


def exact_radiance(scene, points, albedo=0.5):
    """Reflected radiance of a Lambertian floor under unoccluded lights, (3, points.active)."""
    positions = points.rows("position").T[: points.active].astype(float)
    normals = points.rows("normal").T[: points.active].astype(float)
    radiance = np.zeros((3, points.active))
    for light in scene.lights:
        corners = light_corners(light)
        for index, (position, normal) in enumerate(zip(positions, normals, strict=True)):
            if light.two_sided or (position - light.corner) @ light.normal > 0:
                form = polygon_irradiance(corners, position, normal)
                radiance[:, index] += light.radiance * form * albedo / np.pi
    return radiance


def strips_at(scene, points):
    """Of each point, where its lights' strips begin and their widths, (points, lights, 2)."""
    if len(scene.lights) == 1:
        return np.broadcast_to([0.0, 1.0], (points.active, 1, 2))
    found = light_rows(scene)
    places = (points.rows(name).T[: points.active] for name in ("position", "geometric_normal"))
    return found.strips[found.table[cell_of(found.cells, *places)]]


@pytest.mark.parametrize("lights", [LIGHTS[:1], LIGHTS[1:], LIGHTS])
def test_every_sample_matches_float64(device, lights):
    material, samples = grey((0.2, 0.5, 0.9)), 203
    scene = floor_scene(lights, material)
    points, source, rays = sampling(device, scene, DirectLight(), (7, 5), samples)
    arrays = batch_arrays(source.draw(range(points.active), range(samples), 0), 3)
    strips = strips_at(scene, points)
    two_sided = np.array([one.two_sided for one in scene.lights])
    rows = {name: points.rows(name).T.astype(float) for name in ("position", "normal", "outgoing")}
    for point in range(points.active):
        u, v = (arrays[name][point].astype(float) for name in "uv")
        first, widths = strips[point].T
        inside = (u[:, None] >= first) & (u[:, None] < first + widths)
        assert (inside.sum(axis=1) == 1).all()
        which = inside.argmax(axis=1)
        along = (u - first[which]) / widths[which]
        normal = np.array([one.normal for one in scene.lights], float)[which]
        end, stands_for = np.empty((samples, 3)), np.empty(samples)
        for number, light in enumerate(scene.lights):
            own = which == number
            end[own], stands_for[own] = light_samples(light, rows["position"][point], along[own], v[own])
        towards = end - rows["position"][point]
        distance = np.linalg.norm(towards, axis=1)
        towards /= distance[:, None]
        facing = -np.sum(towards * normal, 1)
        facing = np.where(two_sided[which], np.abs(facing), np.maximum(facing, 0))
        cosine = towards @ rows["normal"][point]
        f_r = scattering(
            rows["normal"][point], rows["outgoing"][point], towards, material.albedo,
            material.reflectance, material.roughness,
        )  # fmt: skip
        radiance = np.array([one.radiance for one in scene.lights], float)[which] / widths[which, None]
        geometry = np.maximum(cosine, 0) * stands_for * (facing > 0)
        expected = f_r * geometry[:, None] * radiance
        np.testing.assert_allclose(arrays["value"][:, point].T, expected, rtol=2e-4, atol=1e-6)

        slot = arrays["slot"][point]
        traced = slot != NO_RAY
        np.testing.assert_array_equal(traced, expected.max(axis=1) > 0)
        reached = rays.origins[slot[traced]].astype(float) + rays.directions[slot[traced]]
        np.testing.assert_allclose(reached, end[traced], atol=1e-4)
    assert (rays.distances == 1).all()


@pytest.mark.parametrize(("scale", "offset"), [(1, 0), (1e-3, 0), (1e4, 0), (1e-2, 1), (1, 100)])
@pytest.mark.parametrize("count", [1, 3])
def test_quadrature_gives_lamberts_form_factor(device, scale, offset, count):
    scene, samples = floor_scene(LIGHTS[:count], scale=scale, offset=offset), 1 << 14
    points, source, rays = sampling(device, scene, DirectLight(), (4, 3), samples)
    batch = source.draw(range(points.active), range(samples), 0)
    # No light and no floor stands in its own way.
    assert rays.answers.all()
    mean = shadowed_values(batch, 3).mean(axis=-1)
    # Two-sided lights and strips have jumps in u; a lone light is smooth.
    tolerance = 2e-5 if count == 1 else 3e-4
    rounding = 1e-6 * offset / scale
    np.testing.assert_allclose(mean, exact_radiance(scene, points), rtol=tolerance + rounding)


def test_a_render_of_plane_light_converges_to_the_closed_form(device, scenes):
    scene = load_scene(scenes / "plane_light.toml")
    image, points = render_plain(device, scene, DirectLight(), (15, 11), 1024)
    assert points.active == 15 * 11
    exact = exact_radiance(scene, points)
    np.testing.assert_allclose(image.pixels.reshape(-1, 3).T, exact, rtol=3e-4)
    deviation = np.sqrt(image.variance.reshape(-1, 3).T)
    # Variances assume independence, so Sobol's errors are far below them.
    assert (np.abs(image.pixels.reshape(-1, 3).T - exact) < deviation).all()


def test_errors_of_independent_samples_are_as_large_as_the_variance_says(device, scenes):
    scene = load_scene(scenes / "plane_light.toml")
    image, points = render_plain(device, scene, DirectLight(), (23, 17), 200, "independent")
    error = image.pixels[..., 0].ravel() - exact_radiance(scene, points)[0]
    z = error / np.sqrt(image.variance[..., 0].ravel())
    assert np.abs(z).max() < 4.5
    assert abs(z.mean()) < 4 / np.sqrt(len(z))
    assert 0.85 < z.std() < 1.15


def test_several_lights_add_up(device):
    triangles = np.concatenate([FLOOR, quad([-0.5, 0, 0.5], [1, 0, 0], [0, 1, 0])])
    arguments = DirectLight(), (13, 9), 256, "independent"
    images = [
        render_plain(device, mesh_scene(triangles, CAMERA, lights), *arguments, seed)[0]
        for seed, lights in enumerate([LIGHTS, *((one,) for one in LIGHTS)])
    ]
    difference = images[0].pixels - sum(image.pixels for image in images[1:])
    z = difference / np.sqrt(sum(image.variance for image in images))
    assert np.abs(z).max() < 4.5
    assert 0.8 < z.std() < 1.2


@pytest.mark.parametrize("two_sided", [False, True])
def test_a_light_that_faces_away_gives_nothing_unless_two_sided(device, two_sided):
    up = light_at([-1, 2, -1], [0, 0, 2], [2, 0, 0], 5, two_sided)
    scene = floor_scene((up,))
    points, source, rays = sampling(device, scene, DirectLight(), (5, 3), 1024)
    batch = source.draw(range(points.active), range(1024), 0)
    mean = shadowed_values(batch, 3).mean(axis=-1)
    np.testing.assert_allclose(mean, exact_radiance(scene, points), rtol=1e-3)
    traced = 1024 * points.active if two_sided else 0
    assert (batch_arrays(batch, 3)["value"].any(axis=0) == two_sided).all()
    assert (source.rays.traced, source.rays.skipped) == (traced, 1024 * points.active - traced)
    assert len(rays.answers) == traced


def test_what_lies_below_the_horizon_gives_nothing(device):
    sunk = light_at([-1, -1, -3], [2, 0, 0], [0, 2, 0], 5)
    points, source, rays = sampling(device, floor_scene((sunk,)), DirectLight(), (5, 3), 256)
    arrays = batch_arrays(source.draw(range(points.active), range(256), 0), 3)
    end = np.array([
        light_samples(sunk, position, u.astype(float), v.astype(float))[0][:, 1]
        for position, u, v in zip(
            points.rows("position").T.astype(float), arrays["u"], arrays["v"], strict=True
        )
    ])  # fmt: skip
    risen, clear = end > 0, np.abs(end) > 1e-5
    np.testing.assert_array_equal((arrays["value"] != 0).all(axis=0)[clear], risen[clear])
    assert rays.answers.all() and 0.4 < len(rays.answers) / clear.size < 0.6


def test_an_occluder_casts_its_shadow(device):
    light = light_at([-0.1, 2, -0.1], [0.2, 0, 0], [0, 0, 0.2], 5)
    roof = quad([-1, 1, -1], [2, 0, 0], [0, 0, 2])
    camera = camera_at([0, 0.5, 0], [0, 0, 0.01], 60)
    scene = mesh_scene(np.concatenate([FLOOR, roof]), camera, (light,))
    points, source, rays = sampling(device, scene, DirectLight(), (5, 5), 64)
    batch = source.draw(range(points.active), range(64), 0)
    assert len(rays.answers) == 64 * 25 and not rays.answers.any()
    assert batch_arrays(batch, 3)["value"].min() > 0


def test_lights_that_are_off_cost_and_give_nothing(device):
    off = replace(LIGHTS[1], radiance=np.zeros(3, np.float32))
    scene = floor_scene((off, LIGHTS[0], off))
    assert light_rows(scene).strips[0].tolist() == [[0, 0], [0, 1], [1, 0]]
    assert np.isfinite(DirectLight().data(scene)).all()
    points, source, _ = sampling(device, scene, DirectLight(), (4, 3), 4096)
    mean = shadowed_values(source.draw(range(points.active), range(4096), 0), 3).mean(axis=-1)
    np.testing.assert_allclose(mean, exact_radiance(scene, points), rtol=2e-5)
    # Of two without power nothing is asked but a picture, which is black.
    dark = floor_scene((off, off))
    assert light_rows(dark).widths.tolist() == [[0.5, 0.5]]
    assert not render_plain(device, dark, DirectLight(), (4, 3), 16)[0].pixels.any()


def test_lights_that_cannot_light_a_point_take_none_of_its_samples(device):
    """Each side of a roof is lit by one of two lamps."""
    roof = np.concatenate(
        [quad([-2, 0, -2], [0, 0, 4], [2, 2, 0]), quad([0, 2, -2], [0, 0, 4], [2, -2, 0])]
    )
    lamps = (
        light_at([-4, 2, -0.5], [0, 0.5, 0], [0, 0, 1], 30),
        light_at([4, 2, -0.5], [0, 0, 1], [0, 0.5, 0], 300),
    )
    scene = mesh_scene(roof, camera_at([0, 6, 0.01], [0, 0, 0], 30), lamps)
    points, source, _ = sampling(device, scene, DirectLight(), (12, 8), 256)
    values = batch_arrays(source.draw(range(points.active), range(256), 0), 3)["value"]
    side = points.rows("position")[0]
    assert (side > 0).any() and (side < 0).any()
    # If both had a strip everywhere, a half or more would be zero on one side.
    assert (values > 0).all()
    mean = values.astype(float).mean(axis=-1)
    exact = [exact_radiance(mesh_scene(roof, scene.camera, (lamp,)), points) for lamp in lamps]
    np.testing.assert_allclose(mean, np.where(side < 0, *exact), rtol=2e-3)


def test_a_hidden_sun_does_not_starve_a_lamp(device):
    """The sun is behind a roof: nothing that the camera sees is lit by it."""
    lamp = light_at([-0.1, 2, -0.1], [0.2, 0, 0], [0, 0, 0.2], 100)
    sun = light_at([-50, 200, -50], [100, 0, 0], [0, 0, 100], 1000)
    roof = quad([-20, 3, -20], [40, 0, 0], [0, 0, 40])
    triangles = np.concatenate([FLOOR, roof])
    for lights in ((lamp, sun), (sun, lamp)):
        scene = mesh_scene(triangles, CAMERA, lights)
        image, points = render_plain(device, scene, DirectLight(), (9, 7), 256)
        exact = exact_radiance(mesh_scene(triangles, CAMERA, (lamp,)), points)
        np.testing.assert_allclose(image.pixels.reshape(-1, 3).T, exact, rtol=2e-3)


def test_strips_off_a_coarse_grid_would_ruin_sobol_points(device, monkeypatch):
    """What the grid is for: two smooth lights, 1024 points, the same shares on it and off it."""
    lights = (LIGHTS[0], light_at([2, 2, -1], [2, 0, 0], [0, 0, 2], (5, 4, 3)))

    def error(steps, first):
        monkeypatch.setattr("ncv_cl.integrands.lights.FEWEST_STRIP_STEPS", steps)
        monkeypatch.setattr(
            "ncv_cl.integrands.lights.strip_widths",
            lambda brings: np.broadcast_to([first / steps, 1 - first / steps], brings.shape),
        )
        scene = floor_scene(lights)
        image, points = render_plain(device, scene, DirectLight(), (9, 7), 1024)
        return np.mean((image.pixels.reshape(-1, 3).T - exact_radiance(scene, points)) ** 2)

    assert error(16, 7) < 0.1 * error(4096, 1769)


@pytest.mark.parametrize("sampler", ["independent", "sobol"])
def test_forty_lights_of_very_different_power_add_up(device, sampler):
    generator = np.random.default_rng(4)
    lights = tuple(
        light_at([x, 4, z], [0.5, 0, 0], [0, 0, 0.5], 10 ** generator.uniform(-3, 3, 3))
        for x, z in generator.uniform(-5, 5, (40, 2))
    )
    scene = floor_scene(lights)
    image, points = render_plain(device, scene, DirectLight(), (9, 7), 4096, sampler)
    error = image.pixels.reshape(-1, 3).T - exact_radiance(scene, points)
    z = error / np.sqrt(image.variance.reshape(-1, 3).T)
    assert np.abs(z).max() < 4.5
    assert z.std() < 1.2 and (sampler == "sobol" or z.std() > 0.8)


def test_emitted_radiance_follows_the_side(one_device):
    scene = floor_scene(LIGHTS)
    outgoing = np.stack([sign * one.normal for one in LIGHTS for sign in (1, -1)], axis=1)
    emitted = DirectLight().emitted(scene, np.repeat([0, 1, 2], 2), outgoing)
    one, other, both_sides = (light.radiance for light in LIGHTS)
    np.testing.assert_array_equal(emitted, [one, 0 * one, other, 0 * other, both_sides, both_sides])


@pytest.mark.parametrize("call", ["data", "defines"])
def test_a_scene_without_lights_is_refused(call):
    with pytest.raises(IntegrandError, match=r"test has no light.*add a \[\[lights\]\]"):
        getattr(DirectLight(), call)(floor_scene(()))
