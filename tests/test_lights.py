"""Points on lights as a position sees them: densities, solid angles, and pictures by closed forms."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from reference import (
    bare_kernel,
    camera_at,
    grey,
    light_at,
    light_corners,
    light_samples,
    mesh_scene,
    polygon_irradiance,
    quad,
    render_plain,
    unit,
)
from scipy import stats

from ncv_cl import GlobalIllumination, render
from ncv_cl.integrands import DirectLight
from ncv_cl.integrands.lights import LIGHT_FILES, light_defines, light_records
from ncv_cl.integrands.tuning import SMALL_LIGHT
from ncv_cl.opencl.memory import HostArray
from ncv_cl.points.points import surface_defines
from ncv_cl.scene.load import QuadLight

KERNEL = """
kernel void samples(const uint count, global const float *lights, global const float *numbers,
                    global float *result) {
  const uint first = (uint)get_global_id(0) * VEC;
  if (first >= count) return;
  const triple position = {LOAD(numbers + first), LOAD(numbers + count + first),
                           LOAD(numbers + 2 * count + first)};
  const real u = LOAD(numbers + 3 * count + first);
  const real v = LOAD(numbers + 4 * count + first);
  const LightSample found = sample_lights(lights, all_strips(lights), position, position, u, v);
  const triple segment = found.segment;
  const real facing = fabs(dot_triple(found.towards, to_triple(vload3(0, lights + LIGHT_NORMAL))));
  const real density = light_density(lights, all_strips(lights), (whole)0, position, segment, facing);
  const real lit = SELECT((real)0.0f, (real)1.0f, found.lit);
  const real row[7] = {segment.x, segment.y, segment.z, found.radiance[0], found.density, density, lit};
  for (uint k = 0; k < 7; ++k) STORE(row[k], result + k * count + first);
}
"""
UPRIGHT = light_at([-1, 2, -1], [2, 0, 0], [0, 0, 3], 5)
SKEW = light_at([-1, 2, -1], [2, 0, 1.5], [-1.2, 0, 3], 5)
# Position and light: by name, what is special about it.
SEEN = {
    "below": (UPRIGHT, (0.2, 0, 0.4)),
    "beside": (UPRIGHT, (3, 0.5, 2)),
    "skew": (SKEW, (0.3, 0.5, 0.7)),
    "skew, beside": (SKEW, (-2.5, 1.5, 3)),
    "close": (UPRIGHT, (0.2, 1.999, 0.4)),
    "close, beside": (UPRIGHT, (1.3, 1.9999, 1.0)),
    "along the first edge's line": (UPRIGHT, (4, 1.9, -1)),
    "along the second edge's line": (UPRIGHT, (-1, 1.9, 5)),
    "huge": (light_at([-1e4, 2, -1e4], [2e4, 0, 0], [0, 0, 2e4], 5), (3, 0.5, 2)),
    "a long strip": (light_at([-1e3, 2, -0.01], [2e3, 0, 0], [0, 0, 0.02], 5), (3, 1.5, 2)),
    "a long strip across": (light_at([-0.01, 2, -1e3], [0.02, 0, 0], [0, 0, 2e3], 5), (0.5, 1.5, 2)),
    "tiny, close": (light_at([-1e-4, 2, -1e-4], [2e-4, 0, 0], [0, 0, 3e-4], 5), (1e-4, 1.9999, 0)),
    "small and far": (UPRIGHT, (30, 0, 40)),
    "just large": (UPRIGHT, (0.0, -1.59, 0.5)),
    "just small": (UPRIGHT, (0.0, -1.62, 0.5)),
    "in the wall": (light_at([0, 0, -1], [0, 3, 0], [0, 0, 2], 5), (0.5, 0, 0.3)),
}


@dataclass(frozen=True)
class Found:
    """What the kernel says of samples: ends (n, 3), and a number each."""

    ends: np.ndarray
    radiance: np.ndarray
    density: np.ndarray
    again: np.ndarray
    lit: np.ndarray


def sampled(device, light: QuadLight, position: np.ndarray, u: np.ndarray, v: np.ndarray) -> Found:
    scene = mesh_scene(quad([0, -1, 0], [0, 0, 1], [1, 0, 0]), camera_at([0, 1, 3], [0, 0, 0]), (light,))
    files = ("common", "surface", *LIGHT_FILES)
    kernel = bare_kernel(device, files, {**surface_defines(), **light_defines(scene)}, KERNEL, "samples")
    rows = np.concatenate([np.repeat(np.array(position, float)[:, None], len(u), axis=1), [u, v]])
    result = HostArray(device, (7, len(u)), np.float32)
    kernel(
        len(u) // device.vector_width,
        count=len(u),
        lights=HostArray.of(device, light_records(scene)),
        numbers=HostArray.of(device, rows.astype(np.float32)),
        result=result,
    )
    found = result.read().astype(float)
    return Found(found[:3].T + position, *found[3:])


def grid(side: int) -> tuple[np.ndarray, np.ndarray]:
    """The middles of side² cells, as float32 has them."""
    middle = ((np.arange(side) + 0.5) / side).astype(np.float32).astype(float)
    return np.repeat(middle, side), np.tile(middle, side)


def solid_angle(light: QuadLight, position: np.ndarray) -> float:
    """By Van Oosterom and Strackee (1983), of both triangles."""
    corners = light_corners(light) - position
    whole = 0.0
    for a, b, c in (corners[[0, 1, 2]], corners[[0, 2, 3]]):
        la, lb, lc = (np.linalg.norm(x) for x in (a, b, c))
        below = la * lb * lc + (a @ b) * lc + (a @ c) * lb + (b @ c) * la
        whole += 2 * np.arctan2(abs(a @ np.cross(b, c)), below)
    return whole


@pytest.mark.parametrize("name", SEEN)
def test_samples_are_on_the_light_and_stand_for_all_of_it(device, name):
    light, place = SEEN[name]
    position = np.array(place, np.float32).astype(float)
    u, v = grid(32)
    found = sampled(device, light, position, u, v)
    ends, stands_for = light_samples(light, position, u, v)
    assert found.lit.all()
    distance = np.linalg.norm(ends - position, axis=1)
    # Ends are a few roundings off the light's plane.
    apart = found.ends - ends
    off = apart @ light.normal.astype(float)
    wanted, got = (unit(at - position) for at in (ends, found.ends - off[:, None] * light.normal))
    np.testing.assert_allclose(got, wanted, atol=1e-5)
    assert (np.abs(off) < 1e-5 * (np.abs(position).max() + distance + 4)).all()
    np.testing.assert_allclose(1 / found.density, stands_for, rtol=3e-5)
    np.testing.assert_allclose(found.radiance, 5 * stands_for, rtol=3e-5)
    # What a ray that finds the light weighs it by; where it is found is rounded.
    clear = (u > 0.02) & (u < 0.98)
    np.testing.assert_allclose(found.again[clear], found.density[clear], rtol=3e-3)
    # All samples together are the light as it is seen: a rule of middles, exact where it is smooth.
    u, v = grid(256)
    whole = light_samples(light, position, u, v)[1].mean()
    np.testing.assert_allclose(whole, solid_angle(light, position), rtol=1e-3)


# Where a quadrature of few points is good.
SMOOTH = [name for name in SEEN if "huge" not in name and "strip" not in name and "close" not in name]


@pytest.mark.parametrize("name", [*SMOOTH, "tiny, close"])
def test_samples_follow_their_density(device, name):
    """Chi-square of independent samples over cells of the light, expected from the density alone."""
    light, place = SEEN[name]
    position = np.array(place, np.float32).astype(float)
    corner, edge1, edge2 = (np.asarray(e, float) for e in (light.corner, light.edge1, light.edge2))
    count, cells, fine = 1 << 14, 4, 256
    random = np.random.default_rng(11).random((2, count), np.float32).astype(float)
    found = sampled(device, light, position, *random)
    along = np.linalg.pinv(np.stack([edge1, edge2], axis=1)) @ (found.ends - corner).T
    # Cells of the light itself, finer where it is dense, so that all have samples.
    bounds = [np.quantile(row, np.linspace(0, 1, cells + 1)[1:-1]) for row in along]
    bounds = [np.concatenate([[0], inner, [1]]) for inner in bounds]
    counted = np.histogram2d(*np.clip(along, 0, 1), bins=bounds)[0]
    expected = np.zeros((cells, cells))
    for i, j in np.ndindex(cells, cells):
        widths = [bound[k + 1] - bound[k] for bound, k in zip(bounds, (i, j), strict=True)]
        s, t = (b[k] + w * g for b, k, w, g in zip(bounds, (i, j), widths, grid(fine), strict=True))
        at = corner + s[:, None] * edge1 + t[:, None] * edge2 - position
        distance = np.linalg.norm(at, axis=1)
        cosine = np.abs(at @ unit(np.cross(edge1, edge2))) / distance
        by_area = density_at(light, position, at) * cosine / distance**2
        expected[i, j] = by_area.mean() * light.area * widths[0] * widths[1]
    np.testing.assert_allclose(expected.sum(), 1, rtol=1e-3)
    score = np.sum((counted - count * expected) ** 2 / (count * expected))
    # Quantiles of the samples themselves take some freedom from the cells.
    assert stats.chi2.sf(score, cells**2 - 1) > 1e-5
    assert counted.min() > 100


def density_at(light: QuadLight, position: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Of directions to `at` from the position, per solid angle."""
    edge1, edge2 = light.edge1.astype(float), light.edge2.astype(float)
    st = np.linalg.pinv(np.stack([edge1, edge2], axis=1)) @ (at + position - light.corner).T
    middle = light.corner + (edge1 + edge2) / 2 - position
    if edge1 @ edge1 + edge2 @ edge2 <= SMALL_LIGHT**2 * (middle @ middle):
        distance = np.linalg.norm(at, axis=1)
        return distance**3 / np.abs(at @ unit(np.cross(edge1, edge2))) / light.area
    # The sampled line's range of sines, and the light's of angles about the axis.
    along = unit(edge2)
    across = np.cross(along, unit(np.cross(edge1, edge2)))
    z = abs((light.corner - position) @ unit(np.cross(edge1, edge2)))
    begin = light.corner + st[0][:, None] * edge1 - position
    ends = [begin @ along, (begin + edge2) @ along]
    radius = np.hypot(begin @ across, z)
    sines = [end / np.hypot(end, radius) for end in ends]
    sides = [(light.corner + edge - position) @ across for edge in (0 * edge1, edge1)]
    angle = np.arctan2(sides[1], z) - np.arctan2(sides[0], z)
    return 1 / (angle * (sines[1] - sines[0]))


FLOOR = quad([-3, 0, -3], [0, 0, 6], [6, 0, 0])
ABOVE = camera_at([0, 1, 0.001], [0, 0, 0], 40, up=(0, 0, -1))
LIGHTS = {
    "a sky": light_at([-100, 2, -100], [200, 0, 0], [0, 0, 200]),
    "a sky of 20 km": light_at([-1e4, 2, -1e4], [2e4, 0, 0], [0, 0, 2e4]),
    "a skew sky": light_at([-100, 2, -100], [200, 0, 80], [-60, 0, 200]),
    "a wall that touches the floor": light_at([-0.6, 0, -5], [0, 0, 10], [0, 4, 0]),
    "a wall, turned": light_at([-0.6, 0, -5], [0, 4, 0], [0, 0, 10]),
    "a slanted wall": light_at([-0.7, 0, -3], [0, 0, 6], [0.5, 2, 0.4]),
    "a low strip": light_at([-0.5, 0.02, -0.05], [1, 0, 0], [0, 0, 0.1]),
    "a speck": light_at([-1e-4, 0.3, -1e-4], [2e-4, 0, 0], [0, 0, 2e-4], 1e7),
    "a far one": light_at([-20, 500, -20], [40, 0, 0], [0, 0, 40], 100),
    "edge on": light_at([0.4, 1e-3, -1], [2, 1e-3, 0], [0, 0, 2], 1, two_sided=True),
}


def exact(scene, points) -> np.ndarray:
    """Reflected radiance of the floor of albedo 0.5, each light above it, (points,)."""
    positions = points.rows("position").T.astype(float)
    total = np.zeros(len(positions))
    for light in scene.lights:
        for index, position in enumerate(positions):
            if light.two_sided or (position - light.corner) @ light.normal > 0:
                form = polygon_irradiance(light_corners(light), position, np.array([0.0, 1, 0]))
                total[index] += light.radiance[0] * form * 0.5 / np.pi
    return total


def light_facing_floor(light: QuadLight) -> QuadLight:
    if light.normal[1] > 0 or (light.normal[1] == 0 and light.normal[0] < 0):
        return light_at(light.corner, light.edge2, light.edge1, light.radiance, light.two_sided)
    return light


@pytest.mark.parametrize("name", LIGHTS)
def test_large_low_tiny_and_touching_lights_give_lamberts_formula(device, name):
    scene = mesh_scene(FLOOR, ABOVE, (light_facing_floor(LIGHTS[name]),), (grey(),))
    image, points = render_plain(device, scene, DirectLight(), (9, 9), 1024)
    assert points.active == 81 or "strip" in name or "edge" in name or "speck" in name
    active = points.active
    error = image.pixels.reshape(-1, 3)[points.cell[:active], 0] / exact(scene, points)[:active] - 1
    assert np.sqrt(np.mean(error**2)) < 0.01 and abs(error.mean()) < 2e-3


def test_errors_of_independent_samples_are_as_large_as_the_variance_says(device):
    lights = [light_facing_floor(LIGHTS[name]) for name in ("a sky", "a slanted wall", "a speck")]
    for seed, light in enumerate(lights):
        alone = mesh_scene(FLOOR, ABOVE, (light,), (grey(),))
        image, points = render_plain(device, alone, DirectLight(), (15, 15), 400, "independent", seed)
        found = image.pixels.reshape(-1, 3)[points.cell[: points.active], 0]
        deviation = np.sqrt(image.variance.reshape(-1, 3)[points.cell[: points.active], 0])
        wanted = exact(alone, points)[: points.active]
        # A speck's samples differ by little more than rounding.
        z = (found - wanted) / np.hypot(deviation, 1e-5 * wanted)
        assert np.abs(z).max() < 5 and z.std() < 1.2


@pytest.mark.parametrize("roughness", [0.2, 0.6])
def test_light_found_by_points_and_by_directions_is_the_same(device, roughness):
    """Global illumination at depth 2 weights both; direct light has points alone."""
    lights = (
        light_facing_floor(LIGHTS["a slanted wall"]),
        light_at([1, 0.8, -1], [0, 0.4, 2], [0.5, 0.6, 0.2], 4, two_sided=True),
    )
    scene = mesh_scene(FLOOR, ABOVE, lights, (grey(0.3, 0.4, roughness),))
    options = {"sampler": "independent", "spp": 2048, "size": (9, 9), "device": device}
    both = render(scene, GlobalIllumination(2), "mc", seed=1, **options)
    direct = render(scene, "direct", "mc", seed=2, **options)
    z = (both.pixels - direct.pixels) / np.sqrt(both.variance + direct.variance + 1e-12)
    assert both.pixels.max() > 0.1
    assert np.abs(z).max() < 6 and np.mean(z**2) < 1 + 5 * np.sqrt(2 / (z.size / 3))
