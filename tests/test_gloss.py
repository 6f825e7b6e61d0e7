"""The lobe's strip of direct light's unit square: every sample, expectations, and variances."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import pytest
from lobe_reference import expected_samples
from reference import (
    batch_arrays,
    camera_at,
    grey,
    intersect,
    light_at,
    mesh_scene,
    quad,
    sampling,
    scattering,
    shadowed_values,
    tangent_frame,
    unit,
)
from scipy import stats

from ncv_cl import GlobalIllumination, render
from ncv_cl.integrands import DirectLight, tuning
from ncv_cl.opencl.choose import choose_device
from ncv_cl.sampling.samples import NO_RAY
from ncv_cl.scene.load import load_scene

FLOOR = quad([-10, 0, -10], [0, 0, 20], [20, 0, 0])
CAMERA = camera_at([0, 1.5, 4], [0, 0, 0.5], 35)
# Seen in the floor, behind it a large one, and a small bright one above.
LARGE = light_at([-2, 0.2, -2], [4, 0, 0], [0, 2.5, 0], (1, 2, 3))
SMALL = light_at([0.2, 1.2, -1], [0.02, 0, 0], [0, 0.02, 0.02], (1e4, 8e3, 2e4), two_sided=True)
# Small as seen from some points, and seen from behind by others.
TURNED = light_at([0.2, 0.6, -1], [0.8, 0, 0.2], [0, 0.8, 0.6], (3, 2, 1))
ROUGHNESS = [0.01, 0.05, 0.2, 0.5, 1.0]


def glossy(roughness, albedo=(0.3, 0.1, 0.5), reflectance=(0.4, 0.9, 0.05)):
    return grey(albedo, reflectance, roughness)


@pytest.mark.parametrize("roughness", [0.1, 0.3, 1.0])
@pytest.mark.parametrize("light", [LARGE, replace(LARGE, two_sided=True), TURNED])
def test_every_sample_matches_float64(device, light, roughness, monkeypatch):
    share, samples, material = 0.75, 204, glossy(roughness)
    monkeypatch.setattr(tuning, "LOBE_SHARES", (share,))
    scene = mesh_scene(FLOOR, CAMERA, (light,), (material,))
    points, source, rays = sampling(device, scene, DirectLight(), (5, 4), samples)
    arrays = batch_arrays(source.draw(range(points.active), range(samples), 0), 3)
    assert (points.rows("lobe_share")[0, : points.active] == share).all()
    rows = [points.rows(name).T.astype(float) for name in ("position", "normal", "outgoing")]
    met = 0
    for point in range(points.active):
        u, v = (arrays[name][point].astype(float) for name in "uv")
        wanted = expected_samples(light, material, [row[point] for row in rows], u, v, share)
        got, clear = arrays["value"][:, point].T, wanted.clear
        tolerance = 1e-3 + 3e-6 / roughness**2
        np.testing.assert_allclose(got[clear], wanted.value[clear], rtol=tolerance, atol=1e-6)
        slot = arrays["slot"][point]
        traced = (slot != NO_RAY) & clear
        np.testing.assert_array_equal(traced, wanted.lit & clear)
        end = rays.origins[slot[traced]].astype(float) + rays.directions[slot[traced]]
        np.testing.assert_allclose(end, wanted.end[traced], atol=3e-4)
        met += np.count_nonzero(traced & (u < share))
    assert met > 10


# --------------------------------------------------------------------------------- expectations

# Hides the small light from a part of the floor, and a part of the large one.
BOARD = quad([-0.3, 0.5, -0.7], [0.8, 0, 0], [0, 0.5, 0.1])
CASES = {
    "two lights": (LARGE, SMALL),
    "the large one seen from both sides": (replace(LARGE, two_sided=True), SMALL),
    "the small one from behind": (LARGE, light_at([0.2, 1.2, -1], [0, 0.02, 0.02], [0.02, 0, 0], 1e5)),
    "one before the other": (LARGE, light_at([-0.2, 0.4, -1.5], [0.5, 0, 0], [0, 0.4, 0], 20)),
}


def half_vector_directions(normal, outgoing, roughness, u, v):
    """GGX's normals by their projected area (Walter et al. 2007), reflected, and that density."""
    alpha2 = roughness**4
    cosine = np.sqrt((1 - u) / (1 + (alpha2 - 1) * u))
    sine = np.sqrt(np.maximum(1 - cosine**2, 0))
    local = np.stack([sine * np.cos(2 * np.pi * v), sine * np.sin(2 * np.pi * v), cosine], -1)
    half = local @ np.stack([*tangent_frame(normal), normal])
    return 2 * (half @ outgoing)[:, None] * half - outgoing


def half_vector_density(normal, outgoing, incident, roughness):
    half, alpha2 = unit(incident + outgoing), roughness**4
    slope = np.sum(np.cross(normal, half) ** 2, -1) + alpha2 * (half @ normal) ** 2
    cosine = np.maximum(half @ normal, 0)
    return alpha2 * cosine / (np.pi * slope**2) / (4 * np.abs(half @ outgoing))


def traced_radiance(scene, point, side, generator):
    """One estimate of a point's reflected radiance, (3,): half vectors and areas of lights, jittered.

    The first triangle that a direction meets says which light it counts for, wherever it comes from;
    both ways to find that light weigh it.
    """
    position, normal, outgoing = point
    material = scene.materials[0]
    cell = np.stack(np.meshgrid(np.arange(side), np.arange(side)), -1).reshape(-1, 2)

    def square():
        return ((cell + generator.uniform(size=cell.shape)) / side).T

    drawn = [half_vector_directions(normal, outgoing, material.roughness, *square())]
    for light in scene.lights:
        s, t = square()[:, :, None]
        drawn.append(unit(light.corner + s * light.edge1 + t * light.edge2 - position))
    towards, technique = np.concatenate(drawn), np.repeat(np.arange(len(drawn)), side**2)
    start = np.repeat((position + 1e-6 * normal)[None], len(towards), 0)
    triangle, _, _, distance = intersect(scene, start, towards)
    met = np.where(triangle >= 0, scene.triangle_light[triangle], -1)
    total = np.zeros(3)
    for k, light in enumerate(scene.lights):
        facing = -towards @ unit(np.cross(light.edge1, light.edge2))
        cosine = towards @ normal
        own = (met == k) & ((technique == 0) | (technique == k + 1)) & (cosine > 0)
        own &= (facing > 0) | light.two_sided
        by_area = distance[own] ** 2 / np.abs(facing[own]) / light.area
        by_half = half_vector_density(normal, outgoing, towards[own], material.roughness)
        f_r = scattering(
            normal, outgoing, towards[own], material.albedo, material.reflectance, material.roughness
        )
        total += (f_r * (cosine[own] / (by_area + by_half))[:, None]).sum(axis=0) * light.radiance
    return total / side**2


@functools.cache
def traced(case, roughness, size=(4, 3)):
    """Mean of several estimates of each point, and its variance, (points, 3)."""
    scene = mesh_scene(np.concatenate([FLOOR, BOARD]), CAMERA, CASES[case], (glossy(roughness),))
    device = choose_device(None)
    points, _, _ = sampling(device, scene, DirectLight(), size, 4)
    rows = [points.rows(name).T.astype(float) for name in ("position", "normal", "outgoing")]
    generator = np.random.default_rng(5)
    found = np.array([
        [traced_radiance(scene, [row[k] for row in rows], 48, generator) for k in range(points.active)]
        for _ in range(6)
    ])  # fmt: skip
    return scene, found.mean(axis=0), found.var(axis=0, ddof=1) / len(found)


def independent_moments(device, scene, size, samples, seed=2):
    """Shading points, and of each one's samples the mean and the variance, (points, 3)."""
    points, source, _ = sampling(device, scene, DirectLight(), size, 1024, "independent", seed)
    total, squares = np.zeros((2, 3, points.active))
    for first in range(0, samples, 1024):
        for part in source.batches():
            values = shadowed_values(source.draw(part, range(first, first + 1024), 0), 3)
            assert np.isfinite(values).all() and (values >= 0).all()
            total[:, part.start : part.stop] += values.sum(axis=-1)
            squares[:, part.start : part.stop] += (values**2).sum(axis=-1)
    mean = (total / samples).T
    return points, mean, (squares / samples).T - mean**2


def plausible(z):
    """Whether scores (points, channels) are those of a normal distribution, which channels share."""
    return np.abs(z).max() < 5.5 and stats.chi2.sf(np.sum(z**2, axis=0), len(z)).min() > 1e-5


@pytest.mark.parametrize("roughness", ROUGHNESS)
@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("shares", [tuning.LOBE_SHARES, (0.5,)])
def test_expectations_are_those_of_a_path_tracer(device, case, roughness, shares, monkeypatch):
    monkeypatch.setattr(tuning, "LOBE_SHARES", shares)
    scene, wanted, variance = traced(case, roughness)
    samples = 1 << 14
    points, mean, own = independent_moments(device, scene, (4, 3), samples)
    deviation = np.sqrt(own / samples + variance + (1e-5 * wanted) ** 2 + 1e-12)
    z = (mean - wanted) / deviation
    assert plausible(z)
    assert not plausible((1.05 * mean - wanted) / deviation)
    used = points.rows("lobe_share")[0, : points.active]
    assert (used == 0.5).all() if shares == (0.5,) else used.any() or roughness >= 0.5


@pytest.mark.parametrize("roughness", [0.05, 0.3])
@pytest.mark.parametrize("method", ["mc", "ncv"])
def test_global_illumination_at_depth_2_is_direct_light(device, roughness, method):
    scene = mesh_scene(np.concatenate([FLOOR, BOARD]), CAMERA, CASES["two lights"], (glossy(roughness),))
    options = {"sampler": "independent", "size": (9, 7), "device": device}
    training = {"train_spp": 16} if method == "ncv" else {}
    both = render(scene, GlobalIllumination(2), "mc", spp=4096, seed=1, **options)
    alone = render(scene, "direct", method, spp=1024, seed=2, **options, **training)
    z = (both.pixels - alone.pixels) / np.sqrt(both.variance + alone.variance + 1e-10)
    assert both.pixels.max() > 0.1
    assert plausible(z.reshape(-1, 3))


ROOM = (
    light_at([-3, 4, -3], [6, 0, 0], [0, 0, 6]),
    light_at([-3, 0, -3], [0, 4, 0], [0, 0, 6]),
    light_at([3, 0, -3], [0, 0, 6], [0, 4, 0]),
    light_at([-3, 0, -3], [6, 0, 0], [0, 4, 0]),
    light_at([-3, 0, 3], [0, 4, 0], [6, 0, 0]),
)


def reflected_part(material, normal, outgoing, side=128):
    """What a surface under a sky of radiance 1 reflects, (3,), by half vectors and cosines at once."""
    cell = (np.arange(side) + 0.5) / side
    u, v = (grid.ravel() for grid in np.meshgrid(cell, cell))
    angle = 2 * np.pi * v
    local = np.stack([np.sqrt(u) * np.cos(angle), np.sqrt(u) * np.sin(angle), np.sqrt(1 - u)], -1)
    towards = np.concatenate([
        half_vector_directions(normal, outgoing, material.roughness, u, v),
        local @ np.stack([*tangent_frame(normal), normal]),
    ])  # fmt: skip
    towards = towards[towards @ normal > 0]
    cosine = towards @ normal
    density = half_vector_density(normal, outgoing, towards, material.roughness) + cosine / np.pi
    f_r = scattering(
        normal, outgoing, towards, material.albedo, material.reflectance, material.roughness
    )
    return (f_r * (cosine / density)[:, None]).sum(axis=0) / side**2


@pytest.mark.parametrize("roughness", ROUGHNESS)
@pytest.mark.parametrize("colours", [(0, 1), (0.6, 0.2)])
def test_a_floor_between_walls_of_light_reflects_its_own_part(device, roughness, colours):
    material = grey(*colours, roughness)
    floor = quad([-3, 0, -3], [0, 0, 6], [6, 0, 0])
    scene = mesh_scene(floor, camera_at([0, 2, 2], [0, 0, 0]), ROOM, (material,))
    samples = 4096
    points, mean, own = independent_moments(device, scene, (4, 3), samples)
    rows = [points.rows(name).T.astype(float) for name in ("normal", "outgoing")]
    wanted = np.array([reflected_part(material, *pair) for pair in zip(*rows, strict=True)])
    z = (mean - wanted) / np.sqrt(own / samples + 1e-8)
    assert plausible(z)
    if roughness <= 0.05 and colours == (0, 1):
        np.testing.assert_allclose(wanted, 1, atol=2e-3)


# ------------------------------------------------------------------------------- strips and shares


def test_without_a_lobe_samples_are_what_they_were(device):
    """A matte floor: alone, and beside a glossy board whose kernels know of lobes."""
    values = []
    for second in (grey(0.3), glossy(0.05)):
        scene = mesh_scene(
            np.concatenate([FLOOR, BOARD]), CAMERA, CASES["two lights"], (grey(0.5), second),
            material=np.array([0, 0, 1, 1]),
        )  # fmt: skip
        points, source, _ = sampling(device, scene, DirectLight(), (8, 6), 64)
        matte = points.material[: points.active] == 0
        assert not points.rows("lobe_share")[0, : points.active][matte].any()
        arrays = batch_arrays(source.draw(range(points.active), range(64), 0), 3)
        values.append(arrays["value"][:, matte])
    np.testing.assert_allclose(values[1], values[0], rtol=1e-6)
    assert values[0].any() and not matte.all()


def test_shares_follow_the_lobe_and_the_light():
    assert all(share * 8 == int(share * 8) for share in tuning.LOBE_SHARES)
    assert tuning.LOBE_SHARES[0] == 0 and max(tuning.LOBE_SHARES) < 1


@pytest.mark.parametrize(
    "light, roughness, least, most",
    [(LARGE, 0.05, 0.75, 0.875), (LARGE, 1.0, 0, 0), (SMALL, 0.5, 0, 0), (SMALL, 0.05, 0, 0)],
)
def test_narrow_lobes_before_large_lights_have_the_most(device, light, roughness, least, most):
    camera = camera_at([0, 0.8, 2], [0, 0, 0], 10)
    scene = mesh_scene(FLOOR, camera, (light,), (grey(0, 0.9, roughness),))
    points, _, _ = sampling(device, scene, DirectLight(), (6, 5), 4)
    share = points.rows("lobe_share")[0, : points.active]
    assert least <= share.min() and share.max() <= most


def test_a_dim_light_in_the_mirror_has_the_lobe_however_bright_another(device):
    bright = light_at([-1, 3, 1], [2, 0, 0], [0, 0, 2], 1e3)
    scene = mesh_scene(FLOOR, camera_at([0, 0.8, 2], [0, 0, 0], 10), (LARGE, bright), (glossy(0.05),))
    points, _, _ = sampling(device, scene, DirectLight(), (6, 5), 4)
    assert points.rows("lobe_share")[0, : points.active].all()


def test_occluders_and_embree_agree(device, scenes):
    images = [
        render(
            scenes / "veach_plates.toml", "direct", "mc", spp=32, size=(32, 24), visibility=visibility,
            device=device,
        )
        for visibility in ("points", "embree")
    ]  # fmt: skip
    np.testing.assert_array_equal(images[0].pixels, images[1].pixels)
    assert images[0].stats["rays_on_device"] > 0


def test_variances_are_those_of_the_better_of_light_and_lobe(device, scenes, monkeypatch):
    """Veach's plates, in four parts each. Second moments, of which what the other keeps costs a part."""
    scene = load_scene(scenes / "veach_plates.toml")
    rule, found = tuning.LOBE_SHARES, {}
    for name, shares in {"lights": (0.0,), "lobe": (1.0,), "both": rule}.items():
        monkeypatch.setattr(tuning, "LOBE_SHARES", shares)
        points, mean, variance = independent_moments(device, scene, (40, 30), 4096)
        found[name] = (variance + mean**2).mean(axis=-1), variance.mean(axis=-1)
    roughness, reflectance, x = (
        points.rows(name)[0, : points.active] for name in ("roughness", "reflectance", "position")
    )
    for plate in np.unique(roughness[reflectance > 0]):
        on_plate = (reflectance > 0) & (roughness == plate)
        total = {name: variance[on_plate].mean() for name, (_, variance) in found.items()}
        assert total["both"] < 1.2 * min(total["lights"], total["lobe"])
        for part in range(4):
            here = on_plate & (np.floor(x / 2 + 2) == part)
            moment = {name: second[here].mean() for name, (second, _) in found.items()}
            assert moment["both"] < 1.2 * min(moment["lights"], moment["lobe"])
