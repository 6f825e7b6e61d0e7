"""Directions of the environment: orientation, densities, and irradiance by closed forms."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from reference import bare_kernel, camera_at, grey, light_at, mesh_scene, quad, unit
from scipy import stats

import ncv_cl as ncv
from ncv_cl.integrands.environment import FEW_NORMALS, rows_of
from ncv_cl.integrands.light_cells import cell_of
from ncv_cl.integrands.lights import LIGHT_FILES, light_defines, light_records, light_rows
from ncv_cl.opencl.memory import HostArray
from ncv_cl.points.points import surface_defines, surface_window
from ncv_cl.sampling.callable import function_points
from ncv_cl.scene.load import Scene
from ncv_cl.scene.sky.environment import Environment, Sun

FLOOR = quad([-5, 0, -5], [0, 0, 10], [10, 0, 0])
FILES = ("common", "surface", "bsdf", "bounce", *LIGHT_FILES, "environment")
KERNEL = """
kernel void samples(const uint count, global const float *lights, global const float *numbers,
                    global float *result) {
  const uint first = (uint)get_global_id(0) * VEC;
  if (first >= count) return;
  const triple normal = {LOAD(numbers + first), LOAD(numbers + count + first),
                         LOAD(numbers + 2 * count + first)};
  const real u = LOAD(numbers + 3 * count + first);
  const real v = LOAD(numbers + 4 * count + first);
  const triple at = {(real)0.0f, (real)0.0f, (real)0.0f};
  const whole strips = strips_of(lights, at, normal);
  const LightSample found = sample_emitters(lights, strips, at, at, u, v);
  const SkySeen seen = sky_seen(lights, strips, found.towards, (whole)NO_STRIP);
  const real row[9] = {found.towards.x, found.towards.y, found.towards.z,
                       found.radiance[0], found.density, SELECT((real)0.0f, (real)1.0f, found.lit),
                       seen.density, seen.radiance.x, environment_share(lights, strips)};
  for (uint k = 0; k < 9; ++k) STORE(row[k], result + k * count + first);
}
"""
SEEN_KERNEL = """
kernel void seen(const uint count, global const float *lights, global const float *numbers,
                 global float *result) {
  const uint first = (uint)get_global_id(0) * VEC;
  if (first >= count) return;
  const triple towards = {LOAD(numbers + first), LOAD(numbers + count + first),
                          LOAD(numbers + 2 * count + first)};
  const triple up = {(real)0.0f, (real)1.0f, (real)0.0f};
  const triple at = {(real)0.0f, (real)0.0f, (real)0.0f};
  const SkySeen own = sky_seen(lights, strips_of(lights, at, up), towards, (whole)NO_STRIP);
  const SkySeen all = sky_seen(lights, all_strips(lights), towards, (whole)NO_STRIP);
  const real row[5] = {own.radiance.x, own.radiance.y, own.radiance.z, own.density, all.density};
  for (uint k = 0; k < 5; ++k) STORE(row[k], result + k * count + first);
}
"""


def picture(height: int = 16, seed: int = 1) -> np.ndarray:
    """An image with everything in it: noise, dark parts, and a pixel 10,000 times as bright."""
    pixels = np.random.default_rng(seed).gamma(0.5, 1.0, (height, 2 * height, 3)).astype(np.float32)
    pixels[height // 3, height // 2] = 1e4
    pixels[:, -2:] = 0.0
    return pixels


SKIES = {
    "constant": Environment(np.array([1.0, 2.0, 4.0])),
    "image": Environment(picture(), 30.0, (1.0, 2.0, -0.5)),
    "overcast": Environment.overcast(2.0),
    "suns": Environment(
        np.zeros(3), suns=(Sun((0.3, 1, 0.2), np.ones(3)), Sun((-1, 1, 0), np.full(3, 3.0), 8.0))
    ),
    "clear, with the sun": Environment.clear(Sun((1, 1, 0.5), np.full(3, 5.0)), 0.3),
}


def under(environment: Environment, lights=(), floor=FLOOR, albedo: object = 1.0) -> Scene:
    scene = mesh_scene(floor, camera_at([0, 3, 6], [0, 0, 0]), lights, (grey(albedo),))
    return ncv.build_scene(
        scene.camera,
        {"grey": ncv.Material(np.full(3, albedo))},
        [ncv.TriangleMesh(*_indexed(floor), "grey")],
        lights,
        environment=environment,
    )


def _indexed(triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    vertices = np.asarray(triangles, float).reshape(-1, 3)
    return vertices, np.arange(len(vertices)).reshape(-1, 3)


@dataclass(frozen=True)
class Found:
    towards: np.ndarray
    radiance: np.ndarray
    density: np.ndarray
    lit: np.ndarray
    again: np.ndarray
    seen: np.ndarray
    share: np.ndarray


def sampled(device, scene: Scene, normal: object, u: np.ndarray, v: np.ndarray) -> Found:
    kernel = bare_kernel(
        device,
        FILES,
        {**surface_defines(), **light_defines(scene), "HAS_SPECULAR": 0},
        KERNEL,
        "samples",
    )
    rows = np.concatenate([np.repeat(np.array(normal, float)[:, None], len(u), axis=1), [u, v]])
    result = HostArray(device, (9, len(u)), np.float32)
    kernel(
        len(u) // device.vector_width,
        count=len(u),
        lights=HostArray.of(device, light_records(scene)),
        numbers=HostArray.of(device, rows.astype(np.float32)),
        result=result,
    )
    found = result.read().astype(float)
    return Found(found[:3].T, *found[3:])


def seen(device, scene: Scene, towards: np.ndarray) -> np.ndarray:
    """Radiance (3), density of the floor's strips, and that of those without a cell: (5, n)."""
    kernel = bare_kernel(
        device,
        FILES,
        {**surface_defines(), **light_defines(scene), "HAS_SPECULAR": 0},
        SEEN_KERNEL,
        "seen",
    )
    result = HostArray(device, (5, len(towards)), np.float32)
    kernel(
        len(towards) // device.vector_width,
        count=len(towards),
        lights=HostArray.of(device, light_records(scene)),
        numbers=HostArray.of(device, towards.T.astype(np.float32)),
        result=result,
    )
    return result.read().astype(float)


def grid(side: int) -> tuple[np.ndarray, np.ndarray]:
    middle = ((np.arange(side) + 0.5) / side).astype(np.float32).astype(float)
    return np.repeat(middle, side), np.tile(middle, side)


def sphere(environment: Environment, side: int) -> tuple[np.ndarray, float]:
    """Directions (side², 3) in the image's axes, of equal solid angles, and what each stands for."""
    u, v = grid(side)
    height, azimuth = 2 * u - 1, 2 * np.pi * v
    radius = np.sqrt(1 - height**2)
    own = np.stack([radius * np.sin(azimuth), height, -radius * np.cos(azimuth)], axis=1)
    return own @ environment.axes, 4 * np.pi / len(u)


def without_suns(environment: Environment) -> Environment:
    return replace(environment, suns=())


@pytest.mark.parametrize("name", SKIES)
def test_the_kernel_sees_what_the_description_says(device, name):
    scene = under(SKIES[name])
    towards = unit(np.random.default_rng(3).normal(size=(4096, 3))).astype(np.float32).astype(float)
    poles = np.array([[0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1], [1, 0, 0], [-1, 0, 0]], float)
    towards[:6] = poles
    found = seen(device, scene, towards)
    wanted = scene.environment.radiance_of(towards)
    slack = np.zeros_like(wanted)
    # What rounding makes of a direction counts where the image is steep.
    for step in 4e-7 * np.concatenate([np.eye(3), -np.eye(3)]):
        slack = np.maximum(slack, np.abs(scene.environment.radiance_of(unit(towards + step)) - wanted))
    assert (np.abs(found[:3].T - wanted) <= 1e-5 * wanted + 2 * slack + 1e-30).all()


@pytest.mark.parametrize("name", SKIES)
@pytest.mark.parametrize("normal", [(0, 1, 0), (0, -1, 0)])
def test_samples_bring_radiance_over_density(device, name, normal):
    scene = under(SKIES[name])
    u, v = grid(64)
    found = sampled(device, scene, normal, u, v)
    if not found.share.any():
        # Nothing of it is seen from below.
        assert normal[1] < 0 and not found.lit.any()
        return
    assert found.lit.all() and (found.share == 1).all()
    np.testing.assert_allclose(np.linalg.norm(found.towards, axis=1), 1, rtol=1e-6)
    wanted = scene.environment.radiance_of(found.towards)[:, 0]
    # Rounding may move a direction over the edge of a sun's disc or of a map's cell.
    value = found.radiance * found.density
    assert np.mean(np.abs(value - wanted) > 2e-3 * wanted + 1e-4 * wanted.max()) < 0.01
    assert np.mean(np.abs(found.again / found.density - 1) > 1e-4) < 0.01


@pytest.mark.parametrize("name", ["constant", "image", "overcast", "clear, with the sun"])
def test_densities_integrate_to_one(one_device, name):
    scene = under(without_suns(SKIES[name]))
    # Cells of the map begin and end with cells of the grid, over which densities are linear.
    towards, solid_angle = sphere(scene.environment, 1024)
    found = seen(one_device, scene, towards)
    assert found[3:].sum(axis=1) * solid_angle == pytest.approx([1, 1], abs=1e-4)


@pytest.mark.parametrize("name", SKIES)
def test_strips_fill_the_square(name):
    rows = light_rows(under(SKIES[name])).sky
    assert rows[0, 0] == 1
    np.testing.assert_array_equal(rows[:, 0], rows[:, 1] + rows[:, 3:].sum(axis=1))


def test_suns_have_their_strip_of_equal_solid_angles(device):
    sun = Sun((0.3, 1, 0.2), np.full(3, 2.0), 5.0)
    scene = under(Environment(np.zeros(3), suns=(sun,)))
    u, v = grid(128)
    found = sampled(device, scene, (0, 1, 0), u, v)
    cosine = found.towards @ sun.towards
    assert (cosine >= np.cos(sun.half_angle) - 1e-6).all()
    np.testing.assert_allclose(found.density, 1 / sun.solid_angle, rtol=1e-5)
    # 1 - cosine is uniform.
    part = (1 - cosine) / (1 - np.cos(sun.half_angle))
    assert stats.kstest(part, "uniform").statistic < 2e-2
    assert (sun.radiance * np.pi * np.sin(sun.half_angle) ** 2) == pytest.approx(2.0)


@pytest.mark.parametrize("name", ["image", "clear, with the sun"])
def test_samples_fall_as_their_density_says(one_device, name):
    scene = under(without_suns(SKIES[name]))
    axes = scene.environment.axes
    u, v = np.random.default_rng(5).random((2, 1 << 18)).astype(np.float32).astype(float)
    found = sampled(one_device, scene, (0, 1, 0), u, v)
    bins = 16

    def bin_of(towards: np.ndarray) -> np.ndarray:
        x, y, z = axes @ towards.T
        height = np.clip((1 - y) / 2 * bins, 0, bins - 1).astype(int)
        azimuth = np.arctan2(x, -z) / (2 * np.pi) % 1.0
        return height * bins + np.clip(azimuth * bins, 0, bins - 1).astype(int)

    counts = np.bincount(bin_of(found.towards), minlength=bins**2)
    towards, solid_angle = sphere(scene.environment, 1024)
    expected = np.bincount(bin_of(towards), seen(one_device, scene, towards)[3], bins**2)
    expected *= solid_angle * len(u)
    used = expected > 20
    statistic = ((counts - expected)[used] ** 2 / expected[used]).sum()
    assert stats.chi2.sf(statistic, used.sum() - 1) > 1e-4
    rest = counts[~used].sum(), expected[~used].sum()
    assert abs(rest[0] - rest[1]) <= 5 * np.sqrt(rest[1] + 1)


@pytest.mark.parametrize("name", ["image", "overcast", "clear, with the sun"])
def test_directions_do_not_jump_where_rows_of_the_map_meet(one_device, name):
    scene = under(without_suns(SKIES[name]))
    rows = light_rows(scene)
    floor = rows.table[cell_of(rows.cells, np.zeros((1, 3)), np.array([[0, 1.0, 0]]))]
    edges = rows.maps[int(rows.sky[floor, 2][0])][: rows_of(rows.maps) + 1].astype(float)
    edges = edges[(edges > 1e-3) & (edges < 1 - 1e-3)]
    assert len(edges) > 20
    u, v = (one.ravel() for one in np.meshgrid(np.linspace(0.01, 0.99, 64), edges))
    here, there = (sampled(one_device, scene, (0, 1, 0), u, v + sign * 2.0**-20) for sign in (-1, 1))
    assert np.linalg.norm(there.towards - here.towards, axis=1).max() < 4e-3


def test_the_seam_joins_and_the_poles_are_points(one_device):
    scene = under(without_suns(SKIES["clear, with the sun"]))
    v = np.linspace(0.01, 0.99, 64)
    ends = [
        sampled(one_device, scene, (0, 1, 0), np.full(64, u), v).towards for u in (0.0, 1 - 2.0**-24)
    ]
    assert np.linalg.norm(ends[0] - ends[1], axis=1).max() < 1e-3
    # With all directions in the map v = 0 is the image's upper pole.
    scene = under(Environment(picture()[:, :1]), floor=quad([-5, 0, -5], [0, 0, 10], [10, 0, 0]))
    top = sampled(one_device, scene, (0, 1, 0), np.linspace(0, 0.99, 64), np.zeros(64)).towards
    assert np.linalg.norm(top - [0, 1, 0], axis=1).max() < 1e-3


@pytest.mark.parametrize(
    ("environment", "irradiance"),
    [
        (Environment(np.ones(3)), np.pi),
        (Environment.overcast(3.0), 3 * 7 / 9 * np.pi),
        (Environment(np.zeros(3), suns=(Sun((0, 1, 1), np.full(3, 2.0)),)), 2 / np.sqrt(2)),
    ],
    ids=["constant", "overcast", "sun"],
)
@pytest.mark.parametrize("integrand", ["direct", "gi"])
def test_irradiance_of_an_open_floor(one_device, environment, irradiance, integrand):
    scene = under(environment)
    at, up = np.array([[0.3, 0, 0.2], [0.1, 1.0, 0.3]]), np.array([[0, 1.0, 0]] * 2)
    found = ncv.irradiance(
        scene, at, up, integrand=integrand, method="mc", spp=256, device=one_device, seed=3
    )
    error = np.maximum(found.standard_error, 2e-5 * irradiance)
    assert (np.abs(found.values - irradiance) < 5 * error).all()
    assert (found.standard_error < 5e-3 * irradiance).all()
    below = ncv.irradiance(scene, at[:1], -up[:1], method="mc", spp=64, device=one_device)
    # The floor's back; a constant environment is below, too.
    expected = irradiance if environment.radiance.shape == (3,) and environment.radiance.any() else 0.0
    assert below.values == pytest.approx(expected, abs=2e-2 * irradiance)


def test_the_clear_sky_is_the_standard_one():
    sun = Sun((1, 1, 0), np.ones(3))
    environment = Environment.clear(sun, 2.0)
    zenith, horizon = environment.radiance_of(np.array([[0, 1, 0.0], [0.6, 0.8, 0.0]]))
    assert zenith == pytest.approx(2.0, rel=1e-3)
    # By hand: Z = 36.87°, χ = 8.13°, Zs = 45°.
    f = [
        0.91 + 10 * np.exp(-3 * np.radians(a)) + 0.45 * np.cos(np.radians(a)) ** 2
        for a in (8.130102, 45)
    ]
    phi = [1 - np.exp(-0.32 / c) for c in (0.8, 1.0)]
    assert horizon == pytest.approx(2 * f[0] * phi[0] / (f[1] * phi[1]), rel=1e-3)
    assert environment.radiance_of(np.array([[0, -1, 0.0], [0.8, -0.6, 0]])).max() == 0


def test_axes_follow_up_and_rotation():
    assert Environment(np.ones(3)).axes == pytest.approx(np.eye(3))
    x, y, z = Environment(np.ones(3), up=(0, 0, 2.0)).axes
    assert (x, y, z) == (pytest.approx([1, 0, 0]), pytest.approx([0, 0, 1]), pytest.approx([0, -1, 0]))
    x, y, z = Environment(np.ones(3), 90.0).axes
    assert (x, y, z) == (pytest.approx([0, 0, -1]), pytest.approx([0, 1, 0]), pytest.approx([1, 0, 0]))
    assert Environment(np.ones(3), up=(0, -1.0, 0)).axes[1] == pytest.approx([0, -1, 0])


def test_many_normals_share_maps(one_device):
    sphere_mesh = np.concatenate(
        [quad([0.5 * x, 0.2 * x * x, z], [0, 0, 1], [0.5, 0.1 * x, 0.01 * z]) for x in range(-6, 6)
         for z in range(-4, 4)]
    )  # fmt: skip
    scene = under(SKIES["image"], floor=sphere_mesh)
    rows = light_rows(scene)
    assert 2 < len(rows.maps) < 2 * FEW_NORMALS
    assert set(rows.sky[:, 2]) <= set(range(len(rows.maps)))


def test_lights_and_environment_share_the_square(one_device):
    light = light_at([-1, 2, -1], [2, 0, 0], [0, 0, 2], 1.0)
    for radiance, share in ((1e-3, 0.25), (1e3, 0.875)):
        scene = under(Environment(np.full(3, radiance)), (light,))
        u, v = grid(64)
        found = sampled(one_device, scene, (0, 1, 0), u, v)
        assert (found.share == share).all()
        assert np.mean(found.towards[:, 1] < 0) < 0.01
        # Both come to what they bring alone: radiance times cosine over density.
        value = np.where(found.lit, found.radiance * np.maximum(found.towards[:, 1], 0), 0.0)
        outside = u < share
        assert value[outside].sum() / len(u) == pytest.approx(np.pi * radiance, rel=1e-2)
        alone = under(Environment(np.zeros(3)), (light,))
        assert "HAS_ENVIRONMENT" in light_defines(alone) and not light_defines(alone)["HAS_ENVIRONMENT"]
        of_light = ncv.irradiance(
            alone, [[0, 0, 0]], [[0, 1, 0]], method="mc", spp=64, device=one_device
        )
        assert value[~outside].sum() / len(u) == pytest.approx(of_light.values[0, 0], rel=2e-2)


def test_points_that_no_sun_reaches_are_dark(one_device):
    scene = under(SKIES["suns"])
    normals = unit(np.array([[0, 1, 0], [0, -1, 0], [0.7, -0.7, 0.0]]))
    points = function_points(one_device, np.zeros((3, 3)))
    for name in ("normal", "geometric_normal"):
        window = surface_window(points.surface, name)
        with points.surface.mapped(write=True, window=window) as rows:
            rows[...] = normals.T
    assert ncv.DirectLight().dark(scene, points).tolist() == [False, True, True]
    assert not ncv.DirectLight().dark(under(SKIES["constant"]), points).any()
