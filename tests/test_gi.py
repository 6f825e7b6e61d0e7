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
from ncv_cl.estimation import tuning
from ncv_cl.estimation.direct import direct_edges, direct_samples

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
    image = render(scene, GlobalIllumination(depth), "mc", spp=4, size=(5, 4), device=device)
    expected = EMISSION * (1 - ALBEDO**depth) / (1 - ALBEDO)
    # Every path brings the same: nothing is left to chance before roulette.
    np.testing.assert_allclose(image.pixels, np.broadcast_to(expected, image.pixels.shape), rtol=1e-5)


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


def test_scenes_that_do_not_suit_are_refused():
    dark = mesh_scene(quad([-1, 0, -1], [2, 0, 0], [0, 0, 2]), CAMERA)
    with pytest.raises(IntegrandError, match="no light"):
        GlobalIllumination().data(dark)
    lamps = (light_at([-0.5, 0.9, -0.5], [1, 0, 0], [0, 0, 1]),)
    with pytest.raises(IntegrandError, match="emits"):
        DirectLight().data(closed_box(glowing(0.5, 1.0), lamps))


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


# ------------------------------------------------------------------------------- direct light apart


def against(images, truth, variance):
    """The mean of images of several seeds is the truth, pixel by pixel."""
    found = np.array([image.pixels for image in images], float)
    own = np.mean([image.variance for image in images], axis=0)
    between = np.maximum(found.var(axis=0, ddof=1), own)
    assert_same(found.mean(axis=0), truth, between / len(images) + variance)


@pytest.mark.parametrize("method", ["mc", "ncv"])
@pytest.mark.parametrize("lights", [None, SEVERAL_LIGHTS, SEEN_AND_HIDDEN])
def test_direct_light_apart_matches_an_independent_path_tracer(one_device, method, lights):
    scene = room(grey((0.3, 0.6, 0.9)), lights)
    size, device = (4, 3), one_device
    images = [
        render(scene, GlobalIllumination(4), method, spp=128, size=size, seed=s, device=device)
        for s in range(8)
    ]
    assert all("direct" in image.stats for image in images)
    points, _, _ = sampling(device, scene, GlobalIllumination(4), size, 1)
    mean, variance = (np.zeros((size[1] * size[0], 3)) for _ in range(2))
    for values, into in zip(
        traced(scene, points, 4, 8000, np.random.default_rng(3)), (mean, variance), strict=True
    ):
        into[points.cell[: points.active]] = values.T
    emitted = np.zeros((points.total, 3))
    on = points.light >= 0
    emitted[on] = GlobalIllumination().emitted(scene, points.light[on], points.rows("outgoing")[:, on])
    mean[points.cell] += emitted
    against(images, mean.reshape(*size[::-1], 3), variance.reshape(*size[::-1], 3))


MIRROR = grey(0.05, 0.8, 0.03)


def emissive_room():
    """The room with a shelf that glows, under a light."""
    scene = room(GLOSSY)
    surfaces = scene.vertices[scene.triangles[scene.triangle_light < 0]]
    index = np.zeros(len(surfaces), int)
    index[-2:] = 1
    lights = (light_at([-1, 1.5, -1], [2, 0, 0], [0, 0, 2], (5, 4, 3)),)
    return mesh_scene(surfaces, scene.camera, lights, (GLOSSY, glowing(0.4, 0.7)), material=index)


SCENES = {
    "glossy": lambda: room(GLOSSY),
    "mirror": lambda: room(MIRROR),
    "emissive": emissive_room,
    "many lights": lambda: room(GLOSSY, MANY),
    "hidden": lambda: room(grey(0.6), SEEN_AND_HIDDEN),
}


@pytest.mark.parametrize("method", ["mc", "ncv"])
@pytest.mark.parametrize("name", SCENES)
def test_direct_light_apart_is_the_same_image(one_device, name, method):
    scene, depth = SCENES[name](), 5
    common = {"size": (6, 5), "device": one_device}
    whole = [
        render(scene, GlobalIllumination(depth), "mc", spp=512, seed=s, split_direct="off", **common)
        for s in range(4)
    ]
    images = [
        render(
            scene, GlobalIllumination(depth), method, spp=256, seed=10 + s, split_direct="on", **common
        )
        for s in range(4)
    ]
    truth = np.array([image.pixels for image in whole], float)
    own = np.mean([image.variance for image in whole], axis=0)
    against(images, truth.mean(axis=0), np.maximum(truth.var(axis=0, ddof=1), own) / 4)
    assert all("direct" not in image.stats for image in whole)
    assert all(image.stats["direct"]["samples_per_point"] > 1 for image in images)


@pytest.mark.parametrize("depth", [2, 3])
def test_emission_is_found_where_direct_light_is_apart_and_paths_are_short(one_device, depth):
    scene = emissive_room()
    options = {
        "method": "mc",
        "sampler": "independent",
        "spp": 1024,
        "size": (6, 5),
        "device": one_device,
    }
    whole, apart = (
        render(scene, GlobalIllumination(depth), split_direct=split, seed=s, **options)
        for s, split in enumerate(("off", "on"))
    )
    z = (whole.pixels - apart.pixels) / np.sqrt(whole.variance + apart.variance + 1e-12)
    assert np.mean(z**2) < 1 + 5 * np.sqrt(2 / (z.size / 3)) and np.abs(z).max() < 6


def test_the_layers_of_the_parts_add_up(one_device):
    image = render(
        room(GLOSSY), "gi", "ncv", spp=64, train_spp=1, size=(8, 6), preset="slides", device=one_device,
        supersample=2,
    )  # fmt: skip
    parts = image.layers["G"] + image.layers["residual"] + image.layers["direct"]
    lit = image.layers["direct"].sum(axis=2) > 0
    # Training samples count too, each as one sample.
    assert lit.any() and np.abs(parts - image.pixels)[lit].max() < 0.2 * image.pixels[lit].mean()
    assert image.metadata["direct_spp"] == image.stats["direct"]["samples_per_point"]


def test_many_lights_are_sampled_with_the_paths_unless_asked_for(one_device):
    scene = room(grey(0.5), MANY)
    options = {"method": "mc", "spp": 4, "size": (6, 4), "device": one_device}
    assert "direct" not in render(scene, "gi", **options).stats
    assert "direct" in render(scene, "gi", split_direct="on", **options).stats
    for visibility in ("points", "embree"):
        image = render(room(grey(0.5)), "gi", visibility=visibility, **options)
        assert "direct" not in image.stats and "direct" not in image.layers


@pytest.mark.parametrize(
    "integrand", ["direct", "ao", GlobalIllumination(direct=False), GlobalIllumination(2)]
)
def test_what_cannot_be_split_is_refused(one_device, integrand):
    with pytest.raises(ValueError, match="split"):
        render(room(GLOSSY), integrand, spp=1, size=(4, 4), split_direct="on", device=one_device)


def test_depth_two_is_not_split(one_device):
    image = render(room(GLOSSY), GlobalIllumination(2), "mc", spp=4, size=(4, 4), device=one_device)
    assert "direct" not in image.stats


def test_samples_of_direct_light_follow_those_of_paths():
    assert [direct_samples(n) for n in (1, 16, 64, 256, 1024)] == [8, 32, 64, 128, 256]
    for first, samples in ((1, 1), (8, 16), (128, 512), (3, 1000)):
        edges = direct_edges(first, samples)
        assert edges[0] == 0 and edges[2] == 2 * edges[1] == direct_samples(first)
        assert np.all(np.diff(np.log2(edges[1:])) == 1)
        assert max(direct_samples(samples), 4 * samples) / 2 < edges[-1] or edges[-1] == edges[2]
        assert edges[-1] <= max(direct_samples(first), direct_samples(samples), 4 * samples)
        # A checkpoint's own edges are gone on from.
        assert direct_edges(first, samples, [0, 3, 6])[:4] == [0, 3, 6, 12]


def test_direct_light_gets_more_samples_where_its_error_counts(one_device, scenes, monkeypatch):
    """On glossy plates all of the error is that of highlights; in a matte box it is that of paths."""
    monkeypatch.setattr(tuning, "DIRECT_SAMPLES", 1.0)
    shares = []
    for name in ("veach_plates", "cornell_box"):
        image = render(scenes / f"{name}.toml", "gi", "mc", spp=64, size=(24, 24), device=one_device)
        direct = image.stats["direct"]
        shares.append(direct["samples_per_point"])
        enough = direct["estimated_mse"] <= tuning.DIRECT_ERROR * image.stats["estimated_mse"]
        assert enough or direct["samples_per_point"] >= tuning.MOST_DIRECT * 64
    assert shares[0] > 4 * shares[1]
