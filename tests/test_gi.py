"""Global illumination: closed forms, an independent path tracer, its parts against each other."""

from __future__ import annotations

import numpy as np
import pytest
from reference import (
    camera_at,
    grey,
    intersect,
    light_at,
    mesh_scene,
    quad,
    sampling,
    shadowed_values,
    unit,
)

from ncv_cl import DirectLight, GlobalIllumination, IntegrandError, Material, render

CAMERA = camera_at([0.1, 0.2, 0.4], [-0.3, -0.4, -1], 60)


def glowing(albedo, emission, reflectance=0.0, roughness=1.0):
    albedo, reflectance, emission = (
        np.array(np.broadcast_to(c, 3), np.float32) for c in (albedo, reflectance, emission)
    )
    return Material(albedo, reflectance, roughness, emission, name="glowing")


def closed_box(material, lights=()):
    """The cube from -1 to 1."""
    sides = []
    for axis in range(3):
        edges = np.delete(2 * np.eye(3), axis, 0)
        for corner in (-np.ones(3), -np.ones(3) + 2 * np.eye(3)[axis]):
            sides.append(quad(corner, *edges))
    return mesh_scene(np.concatenate(sides), CAMERA, lights, (material,))


ALBEDO = np.array([0.2, 0.5, 0.8])
EMISSION = np.array([1.0, 2.0, 0.5])


@pytest.mark.parametrize("depth", [2, 3])
def test_a_furnace_is_a_geometric_series(device, depth):
    scene = closed_box(glowing(ALBEDO, EMISSION))
    options = {"sampler": "independent", "spp": 1024, "size": (5, 4), "device": device}
    image = render(scene, GlobalIllumination(depth), "mc", **options)
    expected = EMISSION * (1 - ALBEDO**depth) / (1 - ALBEDO)
    z = (image.pixels - expected) / np.sqrt(image.variance)
    assert np.abs(z).max() < 4.5 and np.mean(z**2) < 1 + 5 * np.sqrt(2 / 20)
    assert np.sqrt(image.variance.mean()) < 0.02


@pytest.mark.parametrize("depth, sampler", [(5, "sobol"), (None, "independent"), (None, "sobol")])
def test_roulette_leaves_a_furnace_as_bright_as_it_is(device, depth, sampler):
    scene = closed_box(glowing(ALBEDO, EMISSION))
    images = [
        render(
            scene,
            GlobalIllumination(depth),
            "mc",
            sampler=sampler,
            spp=256,
            size=(8, 8),
            seed=s,
            device=device,
        )
        for s in range(3)
    ]
    found = np.concatenate([image.pixels.reshape(-1, 3) for image in images])
    error = found.mean(axis=0) - EMISSION * (1 - ALBEDO ** (depth or 1000)) / (1 - ALBEDO)
    assert (np.abs(error) < 4 * found.std(axis=0) / np.sqrt(len(found))).all()
    assert (found.std(axis=0) > 0).all()


@pytest.mark.parametrize(
    "method, allocation", [("mc", "uniform"), ("ncv", "uniform"), ("ncv", "magnitude")]
)
def test_a_bright_furnace_has_no_pixel_far_off(one_device, method, allocation):
    """Where nearly all light is reflected, weights of long paths must not grow without bound."""
    scene = closed_box(glowing(0.98, 1.0))
    options = {"spp": 32, "size": (24, 24), "allocation": allocation, "device": one_device}
    for seed in range(3):
        image = render(scene, "gi", method, seed=seed, **options)
        assert image.pixels.min() > 20 and image.pixels.max() < 120
        assert image.pixels.mean() == pytest.approx(50, rel=0.02)


# ------------------------------------------------------------------------- an independent path tracer


def room(material, lights=None):
    """A floor and two walls under a light; what the light does not reach is lit by them."""
    surfaces = [
        quad([-2, -1, -2], [0, 0, 4], [4, 0, 0]),
        quad([-2, -1, -2], [4, 0, 0], [0, 3, 0]),
        quad([-2, -1, -2], [0, 3, 0], [0, 0, 4]),
        quad([-1, 0.2, -1.8], [1.5, 0, 0], [0, 0, 1.5]),
    ]
    lights = lights or (light_at([-1, 1.5, -1], [2, 0, 0], [0, 0, 2], (5, 4, 3)),)
    camera = camera_at([1.5, 1, 2], [-0.5, -0.7, -1], 50)
    return mesh_scene(np.concatenate(surfaces), camera, lights, (material,))


def traced(scene, points, depth, paths, generator):
    """Radiance by matte paths that meet lights by chance alone: means, their variances (3, points)."""
    albedo = scene.materials[0].albedo.astype(float)
    count = points.active
    position = np.repeat(points.rows("position").T[:count].astype(float), paths, 0)
    normal = np.repeat(points.rows("normal").T[:count].astype(float), paths, 0)
    throughput = np.ones((count * paths, 3))
    radiance = np.zeros_like(throughput)
    alive = np.arange(count * paths)
    for _ in range(depth - 1):
        direction = unit(normal + unit(generator.normal(size=normal.shape)))
        throughput[alive] *= albedo
        triangle, u, v, _ = intersect(scene, position + 1e-5 * normal, direction)
        light = np.where(triangle >= 0, scene.triangle_light[triangle], -2)
        for index, one in enumerate(scene.lights):
            met = (light == index) & (one.two_sided | (direction @ one.normal.astype(float) < 0))
            radiance[alive[met]] += throughput[alive[met]] * one.radiance
        on = light == -1
        corners = scene.vertices[scene.triangles[triangle[on]]].astype(float)
        edge1, edge2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        position = corners[:, 0] + u[on, None] * edge1 + v[on, None] * edge2
        normal = unit(np.cross(edge1, edge2))
        normal *= -np.sign(np.sum(normal * direction[on], 1))[:, None]
        alive = alive[on]
    each = radiance.reshape(count, paths, 3)
    return each.mean(1).T, (each.var(1) / paths).T


def estimates(device, scene, integrand, samples, sampler="independent"):
    """The samples' means and their variances, (3, points), and the points."""
    points, source, _ = sampling(device, scene, integrand, (4, 3), samples, sampler)
    values = shadowed_values(source.draw(range(points.active), range(samples), 0), 3)
    return values.mean(2), values.var(2) / samples, points


def assert_same(first, second, variance):
    z = ((first - second) / np.sqrt(np.maximum(variance, 1e-30)))[variance > 0]
    # Channels err together: a third of the numbers are independent.
    assert z.size and np.mean(z**2) < 1 + 5 * np.sqrt(2 / (z.size / 3)), np.mean(z**2)
    assert np.abs(z).max() < 5


SEVERAL_LIGHTS = (
    light_at([-1, 1.5, -1], [2, 0, 0], [0, 0, 2], (5, 4, 3)),
    light_at([1.5, 0, -1.5], [0, 1, 0], [0, 0, 1], 4, two_sided=True),
)
# One hangs under the shelf, a strong one is behind the floor, another behind a wall, one stands at the
# other; and so many that kernels gather their records.
SEEN_AND_HIDDEN = (
    light_at([-0.5, 0.1, -1.5], [0.5, 0, 0], [0, 0, 0.5], 9),
    light_at([-2, -1.5, -2], [4, 0, 0], [0, 0, 4], 900, two_sided=True),
    light_at([-2.5, 0, -1], [0, 1, 0], [0, 0, 1], (400, 10, 10), two_sided=True),
    light_at([1.5, 0, -1.5], [0, 1, 0], [0, 0, 1], 4, two_sided=True),
    light_at([-1, 0.6, -1.9], [0, 0.8, 0], [1, 0, 0], (2, 3, 9)),
)
MANY = SEEN_AND_HIDDEN + tuple(
    light_at([x, 1.6, z], [0.2, 0, 0], [0, 0, 0.2], 3.0**k)
    for k, (x, z) in enumerate([(-1.5, -1.5), (1, -1.5), (-1.5, 1), (1, 1), (0, 0), (-0.5, 1.5)])
)


@pytest.mark.parametrize("depth", [2, 3, 4])
@pytest.mark.parametrize("lights", [None, SEVERAL_LIGHTS, SEEN_AND_HIDDEN, MANY])
def test_matte_scenes_match_an_independent_path_tracer(device, depth, lights):
    scene = room(grey((0.3, 0.6, 0.9)), lights)
    mean, variance, points = estimates(device, scene, GlobalIllumination(depth), 1000)
    other, others = traced(scene, points, depth, 10000, np.random.default_rng(depth))
    assert_same(mean, other, variance + others)


GLOSSY = grey((0.3, 0.2, 0.4), (0.5, 0.3, 0.7), 0.4)


@pytest.mark.parametrize("lights", [None, SEEN_AND_HIDDEN, MANY])
@pytest.mark.parametrize("material", [grey((0.3, 0.6, 0.9)), GLOSSY])
def test_depth_two_is_direct_light(device, material, lights):
    scene = room(material, lights)
    mean, variance, _ = estimates(device, scene, GlobalIllumination(2), 1000)
    other, others, _ = estimates(device, scene, DirectLight(), 1000, "sobol")
    assert_same(mean, other, variance + others / 50)


@pytest.mark.parametrize("lights", [None, MANY])
@pytest.mark.parametrize("material", [grey((0.3, 0.6, 0.9)), GLOSSY])
def test_parts_add_up(device, material, lights):
    scene = room(material, lights)
    whole, variance, _ = estimates(device, scene, GlobalIllumination(5), 1000)
    direct, directs, _ = estimates(device, scene, DirectLight(), 1000)
    rest, rests, _ = estimates(device, scene, GlobalIllumination(5, direct=False), 1000)
    assert (rest > 0).any()
    assert_same(whole, direct + rest, variance + directs + rests)


def test_light_and_its_double_of_quads_agree(device):
    """A surface that emits is found by rays alone, a light of its radiance by its points as well."""
    lamp = quad([-1, 1.5, -1], [2, 0, 0], [0, 0, 2])
    scene = room(GLOSSY, (light_at([-1, 1.5, -1], [2, 0, 0], [0, 0, 2], 4, two_sided=True),))
    surfaces = scene.vertices[scene.triangles[scene.triangle_light < 0]]
    materials = (GLOSSY, glowing(0.0, 4.0))
    double = mesh_scene(
        np.concatenate([surfaces, lamp]), scene.camera, (), materials,
        material=np.repeat([0, 1], [len(surfaces), 2]),
    )  # fmt: skip
    first, variance, _ = estimates(device, scene, GlobalIllumination(4), 2000)
    second, others, _ = estimates(device, double, GlobalIllumination(4), 8000)
    assert_same(first, second, variance + others)


# --------------------------------------------------------------------------------- options and images


@pytest.mark.parametrize("sampler", ["independent", "sobol"])
def test_control_variate_and_plain_monte_carlo_agree(device, sampler):
    scene, integrand = room(GLOSSY), GlobalIllumination(6)
    plain = render(scene, integrand, "mc", sampler=sampler, spp=256, size=(10, 8), seed=1, device=device)
    other = render(
        scene,
        integrand,
        "ncv",
        sampler=sampler,
        spp=128,
        train_spp=16,
        size=(10, 8),
        seed=2,
        device=device,
    )
    assert "G" in other.layers
    z = (plain.pixels - other.pixels) / np.sqrt(plain.variance + other.variance + 1e-12)
    assert np.abs(z.mean()) < 5 / np.sqrt(z.shape[0] * z.shape[1])
    assert np.mean(z**2) < 2.5


def test_clamping_takes_light_away_and_says_so(device):
    scene = room(GLOSSY)
    free, clamped = (
        render(scene, GlobalIllumination(clamp=c), "mc", spp=64, size=(8, 6), device=device)
        for c in (None, 0.05)
    )
    assert (clamped.pixels <= free.pixels + 1e-6).all() and clamped.pixels.mean() < free.pixels.mean()
    assert clamped.metadata["clamp"] == 0.05 and "clamp" not in free.metadata


def test_depth_is_in_the_metadata(one_device):
    image = render(room(GLOSSY), GlobalIllumination(3), "mc", spp=1, size=(2, 2), device=one_device)
    assert image.metadata["max_depth"] == 3


@pytest.mark.parametrize("options", [{"max_depth": 1}, {"max_depth": 2.5}, {"clamp": 0.0}])
def test_bad_options_are_refused(options):
    with pytest.raises(IntegrandError, match=next(iter(options))):
        GlobalIllumination(**options)


def test_batches_beyond_exact_floats_are_refused(one_device, monkeypatch):
    monkeypatch.setattr("ncv_cl.sampling.paths.MOST_PLACES", 1 << 6)
    with pytest.raises(ValueError, match="64 places at most, not "):
        render(room(GLOSSY), GlobalIllumination(3), "mc", spp=16, size=(4, 4), device=one_device)


def test_scenes_that_do_not_suit_are_refused():
    dark = mesh_scene(quad([-1, 0, -1], [2, 0, 0], [0, 0, 2]), CAMERA)
    with pytest.raises(IntegrandError, match="no light"):
        GlobalIllumination().data(dark)
    with pytest.raises(IntegrandError, match="no light"):
        DirectLight().data(dark)


def test_a_bright_lamp_that_is_hidden_does_not_starve_the_next_bounce(device):
    """What is outside the room shares the square with the lamp inside; the picture is that one's."""
    lamp = light_at([-0.5, 0.9, -0.5], [1, 0, 0], [0, 0, 1], 3)
    outside = light_at([-30, 50, -30], [60, 0, 0], [0, 0, 60], 1e4)
    options = {"method": "mc", "sampler": "independent", "size": (6, 5), "device": device}
    gi = GlobalIllumination(4)
    alone = render(closed_box(grey(0.6), (lamp,)), gi, spp=2048, seed=1, **options)
    both = render(closed_box(grey(0.6), (lamp, outside)), gi, spp=2048, seed=2, **options)
    z = (both.pixels - alone.pixels) / np.sqrt(alone.variance + both.variance + 1e-12)
    assert alone.pixels.min() > 0 and np.abs(z).max() < 5
    np.testing.assert_allclose(both.pixels.mean(), alone.pixels.mean(), rtol=0.02)
