"""Lines on lights: what is free of them against embree, closed forms, pictures that stay the same."""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from fitting import fitting
from hypothesis import given, settings
from hypothesis import strategies as st
from reference import (
    bare_kernel,
    batch_arrays,
    camera_at,
    grey,
    light_at,
    mesh_scene,
    quad,
    sampling,
    shadowed_values,
)
from test_shaft import CAMERA, FLOOR, LIGHTS, SEVERAL_LIGHTS, soup

sys.path.insert(0, str(Path(__file__).parent.parent / "bench"))
from visibility_case import cut_in_four

from ncv_cl.host.clock import Stopwatch
from ncv_cl.integrands import DirectLight
from ncv_cl.integrands.lights import LIGHT_FILES
from ncv_cl.opencl.device import open_device
from ncv_cl.opencl.memory import HostArray
from ncv_cl.points.points import surface_defines
from ncv_cl.rendering.prepare import prepare
from ncv_cl.rendering.render import render
from ncv_cl.sampling.samples import NO_RAY, SEEN
from ncv_cl.settings.options import Sampling
from ncv_cl.settings.settings import Settings
from ncv_cl.visibility.lines import LINE_FILES, line_defines, lines_pay
from ncv_cl.visibility.tuning import OCCLUDERS_A_LINE

# Of samples (u, v): whether v is in a gap of its line, and how far from the next end of one.
KERNEL = """
kernel void free_of_lines(const uint samples, const uint point_count, const uint total_points,
                          const float tolerance, global const float *surface, global const float *lights,
                          global const uint *levels, global const float *boxes,
                          global const float *triangles, global const uint *starts,
                          global const uint *occluders, global const float *u,
                          global const float *v, global float *is_free, global float *margin) {
  const uint blocks = samples / VEC;
  const uint point = (uint)get_global_id(0) / blocks;
  const ulong at = (ulong)get_global_id(0) * VEC;
  if (point >= point_count) return;
  global const uint *own = occluders + starts[point];
  const ShadingPoint p = load_shading_point(surface, total_points, point);
  real found = (real)0.0f;
  real apart = (real)FAR_AWAY;
  real across;
  const whole light_of = light_of_line(lights, &p, LOAD(u + at), &across);
  for (int light = 0; light < LIGHT_COUNT; ++light) {
    const whole here = light_of == light;
    const LightLines lines = lines_of(&p, lights, light);
    Block block[BLOCKS_A_ITEM];
    begin_block(&lines, across, here, &block[0]);
    if (own[0] != TOO_MANY)
      cut_lines(&lines, own, triangles, ray_origin(&p), 1, block);
    else
      walk_lines(&lines, levels, boxes, triangles, tolerance, ray_origin(&p), 1, block);
    const Gaps *gaps = &block[0].gaps;
    const LightView *view = &lines.view;
    const real squared = FMA(block[0].x, block[0].x, view->z * view->z);
    const real all = sine_between(squared, block[0].begin, block[0].begin + view->length);
    for (uint k = 0; k < gaps->used; ++k) {
      const whole is_gap = here && (gaps->low[k] < gaps->high[k]);
      real low = (gaps->low[k] - block[0].begin) / view->length;
      real high = (gaps->high[k] - block[0].begin) / view->length;
      if (lines.large) {
        low = sine_between(squared, block[0].begin, gaps->low[k]) / all;
        high = sine_between(squared, block[0].begin, gaps->high[k]) / all;
      }
      const real own_v = LOAD(v + at);
      found = SELECT(found, (real)1.0f, is_gap && (own_v >= low) && (own_v <= high));
      apart = SELECT(apart, min(apart, min(fabs(own_v - low), fabs(own_v - high))), is_gap);
    }
    /* What no line could hold is left to points. */
    found = SELECT(found, (real)2.0f, here && gaps->refused);
  }
  STORE(found, is_free + at);
  STORE(apart, margin + at);
}
"""


@dataclass(frozen=True)
class Compared:
    """Of samples that bring light but for shadows: who sees it, and how far in v the next edge is.

    `walked` of the points had no list.
    """

    embree: np.ndarray
    lines: np.ndarray
    margin: np.ndarray
    refused: int
    walked: int

    @property
    def disagreements(self) -> np.ndarray:
        """Distances of those about which they disagree."""
        return self.margin[self.embree != self.lines]


def compared(device, scene, size=(12, 10), samples=64, most=None) -> Compared:
    points, source, _ = sampling(device, scene, DirectLight(), size, samples)
    arrays = batch_arrays(batch := source.draw(range(points.active), range(samples), 0), 3)
    embree = (shadowed_values(batch, 3) > 0).any(axis=0)
    live = (arrays["value"] > 0).any(axis=0)
    _, on_lines, _ = sampling(device, scene, DirectLight(), size, samples, lines=True, most=most)
    occluders = on_lines.occluders
    defines = {
        **surface_defines(), **occluders.defines(), **line_defines(), **DirectLight().defines(scene),
    }  # fmt: skip
    files = ("common", "surface", "bsdf", *LIGHT_FILES, "shaft", *LINE_FILES)
    kernel = bare_kernel(device, files, defines, KERNEL, "free_of_lines")
    found = [HostArray(device, live.shape, np.float32) for _ in range(2)]
    kernel(
        live.size // device.vector_width,
        samples=samples,
        point_count=points.active,
        total_points=points.total,
        surface=points.surface,
        lights=HostArray.of(device, DirectLight().data(scene)),
        **occluders.arguments,
        **occluders.walked,
        u=HostArray.of(device, arrays["u"]),
        v=HostArray.of(device, arrays["v"]),
        is_free=found[0],
        margin=found[1],
    )
    is_free, margin = (array.read() for array in found)
    asked = live & (is_free < 2)
    return Compared(
        embree[asked],
        is_free[asked] == 1,
        margin[asked],
        int((is_free[live] == 2).sum()),
        occluders.unknown,
    )


# By lists, and by a walk through boxes at every point that has something before the lights.
BY_LISTS_OR_WALKS = pytest.mark.parametrize("most", [None, 0], ids=["lists", "walks"])


@BY_LISTS_OR_WALKS
@pytest.mark.parametrize("count", [0, 3, 40, 600])
@pytest.mark.parametrize("lights", [LIGHTS, SEVERAL_LIGHTS], ids=["one-light", "two-lights"])
def test_lines_are_free_where_embree_sees_the_light(device, count, lights, most):
    found = compared(device, soup(count, lights, 3 / (2 + count**0.5)), most=most)
    assert found.walked > 0 or most is None or count == 0
    assert found.embree.size > 2000 and (count == 0 or 0 < found.embree.mean() < 1)
    # Where a ray grazes an edge rounding decides.
    assert len(found.disagreements) < 1e-4 * found.embree.size
    assert (found.disagreements < 1e-4).all()
    assert found.refused < 0.02 * found.embree.size


def test_walks_find_all_that_blocks_among_many_triangles(device):
    """Dust so fine that lists are long, and in it a ball of many triangles that is closed."""
    generator = np.random.default_rng(8)
    dust = generator.uniform([-2.5, -0.8, -2.5], [2.5, 3.5, 2.5], (25_000, 1, 3))
    dust = dust + 0.002 * generator.normal(size=(len(dust), 3, 3))
    u, v = np.meshgrid(np.linspace(0, 2 * np.pi, 181), np.linspace(0, np.pi, 91), indexing="ij")
    ball = np.stack([np.sin(v) * np.cos(u), np.cos(v), np.sin(v) * np.sin(u)], axis=-1) * 0.7 + [0, 1, 0]
    corners = [ball[:-1, :-1], ball[1:, :-1], ball[1:, 1:], ball[:-1, 1:]]
    halves = [np.stack([corners[0], corners[k], corners[k + 1]], axis=2) for k in (1, 2)]
    triangles = np.concatenate([FLOOR, dust, *(half.reshape(-1, 3, 3) for half in halves)])
    # At the poles there are triangles without area.
    area = np.linalg.norm(
        np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1
    )
    scene = mesh_scene(triangles[area > 1e-12], CAMERA, LIGHTS, (grey(),))
    found = compared(device, scene, (12, 10), 64)
    assert found.walked > 20 and found.embree.size > 3000 and 0.2 < found.embree.mean() < 0.95
    assert len(found.disagreements) < 1e-3 * found.embree.size
    # Products of corners as far as 5 are rounded to 25 * 2^-24, which moves an edge as long as 0.002 so
    # far on a light as long as 2.
    assert (found.disagreements < 25 * 2**-24 / 0.002 / 2).all()
    assert found.refused < 0.05 * found.embree.size


def test_what_is_cut_into_many_triangles_blocks_the_same(device):
    """The light and the floor too: most triangles then lie in the light's plane, or in the surface's."""
    scene = soup(8, LIGHTS, 1.0)
    for _ in range(6):
        scene = cut_in_four(scene)
    found = compared(device, scene, most=0)
    assert found.walked > 20 and found.embree.size > 3000 and 0.2 < found.embree.mean() < 0.95
    assert len(found.disagreements) < 1e-3 * found.embree.size
    assert (found.disagreements < 1e-4).all()


def moved(triangles: np.ndarray, *by: float) -> np.ndarray:
    return np.asarray(triangles) + by


GRID = np.linspace(-2, 2, 5)
SHEET = [quad([x, 1, z], [0, 0, 1], [1, 0, 0]) for x in GRID[:-1] for z in GRID[:-1]]
BOX = [
    quad([0, 0, 0], [1, 0, 0], [0, 1, 0]), quad([0, 0, 1], [1, 0, 0], [0, 1, 0]),
    quad([0, 0, 0], [0, 0, 1], [0, 1, 0]), quad([1, 0, 0], [0, 0, 1], [0, 1, 0]),
    quad([0, 0, 0], [1, 0, 0], [0, 0, 1]), quad([0, 1, 0], [1, 0, 0], [0, 0, 1]),
]  # fmt: skip
RANDOM = np.random.default_rng(5).normal(size=(30, 3, 3)) * 0.6 + [0, 1.5, 0]
NEEDLES = RANDOM.copy()
NEEDLES[:, 2] = NEEDLES[:, 1] + 1e-4 * NEEDLES[:, 2]
SPECIAL = {
    "shared edges": [moved(one, 0.3, 0, 0.1) for one in SHEET[::2]],
    "duplicates": [RANDOM, RANDOM, RANDOM[:, ::-1]],
    "coplanar": [quad([x, 1, -x], [0, 0, 0.7], [0.9, 0, 0.2]) for x in np.linspace(-1, 1, 9)],
    "T-junctions": [quad([-2, 1, 0], [0, 0, 2], [4, 0, 0]), *SHEET[:2], *SHEET[4:6], *SHEET[8:10]],
    "interpenetrating": [moved(s * one, -t, 0, 0.2 * t) for s, t in ((1, 0), (1.3, 0.4)) for one in BOX],
    "needles": [NEEDLES],
    "through the light's plane": [moved(RANDOM, 0, 2.5, 0), quad([-0.5, 3, 0], [0, 1, 0], [1, 0, 0])],
    "in the light's plane": [quad([x, 4, -3], [0, 0, 6], [0.3, 0, 0]) for x in (-1.2, 0.2)],
    "through the surface's plane": [moved(RANDOM, 0, -2.5, 0), quad([0, -2, 0], [0, 2, 0], [1, 0, 1])],
    "in the surface's plane": [quad([-1, -1, -1], [0, 0, 2], [2, 0, 0]), moved(BOX[0], 1, -1, 0)],
    "along the light's edges": [quad([-0.5, y, -2], [0, 0, 4], [y / 3, 0, 0]) for y in (1, 2, 3)],
}  # fmt: skip


@BY_LISTS_OR_WALKS
@pytest.mark.parametrize("name", SPECIAL)
@pytest.mark.parametrize("light", ["upright", "skew", "in a wall"])
def test_special_triangles_block_what_they_block_for_embree(device, name, light, most):
    lights = {
        "upright": LIGHTS[0],
        "skew": light_at([-1, 4, -1], [2, 0, 0.7], [0.5, 0, 2], 5),
        "in a wall": light_at([-4, 0, -1], [0, 2, 0], [0, 0, 2], 5),
    }
    triangles = np.concatenate([FLOOR, *SPECIAL[name]])
    found = compared(device, mesh_scene(triangles, CAMERA, (lights[light],), (grey(),)), most=most)
    assert found.embree.size > 1000
    assert len(found.disagreements) < 1e-3 * found.embree.size
    assert (found.disagreements < 2e-4).all()


# Corners on a grid of whole numbers lie in planes of each other, of the light and of the floor.
CORNERS = st.tuples(st.integers(-3, 3), st.integers(-1, 4), st.integers(-3, 3))


@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(CORNERS, CORNERS, CORNERS), min_size=1, max_size=12))
def test_triangles_with_corners_on_a_grid(one_device, triangles):
    scene = mesh_scene(np.concatenate([FLOOR, np.array(triangles, float)]), CAMERA, LIGHTS, (grey(),))
    for most in (None, 0):
        found = compared(one_device, scene, (8, 6), 32, most)
        assert (found.disagreements < 2e-4).all()


@BY_LISTS_OR_WALKS
def test_no_line_slips_through_a_sheet(device, most):
    """Common edges, of which some lie along the lines, and corners."""
    light = light_at([-0.25, 3, -0.25], [0.5, 0, 0], [0, 0, 0.5])
    camera = camera_at([0, 0.5, 0], [0, -1, 0], 20, up=(0, 0, 1))
    scene = mesh_scene(np.concatenate([FLOOR, *SHEET]), camera, (light,), (grey(),))
    points, source, _ = sampling(device, scene, DirectLight(), (16, 16), 256, lines=True, most=most)
    arrays = batch_arrays(source.draw(range(points.active), range(256), 0), 3)
    assert not arrays["value"].any() and (arrays["slot"] == NO_RAY).all()
    assert source.rays.off_lines == 0


@pytest.mark.parametrize("samples, chosen", [(1, "points"), (64, "lines")])
def test_auto_draws_lines_where_samples_are_many_for_the_triangles(one_device, samples, chosen):
    scene, drawn = soup(600, LIGHTS, 0.15), {}
    for visibility in ("auto", "lines", "points"):
        sampled = Sampling(visibility=visibility)
        settings = Settings(DirectLight(), "mc", samples, (12, 10), 0, sampled)
        source = prepare(one_device, scene, settings, 2, Stopwatch()).source
        drawn[visibility] = batch_arrays(source.draw(range(source.points.active), range(64), 0), 3)[
            "value"
        ]
    occluders = source.occluders.mean_count
    assert OCCLUDERS_A_LINE < occluders < 64 * OCCLUDERS_A_LINE
    assert lines_pay(occluders, samples) == (chosen == "lines")
    np.testing.assert_array_equal(drawn["auto"], drawn[chosen])
    assert not np.array_equal(drawn["lines"], drawn["points"])


def test_points_that_see_all_of_the_light_are_sampled_as_ever(device):
    points, source, _ = sampling(device, soup(0), DirectLight(), (12, 10), 64)
    plain = batch_arrays(source.draw(range(points.active), range(64), 0), 3)
    points, source, _ = sampling(device, soup(0), DirectLight(), (12, 10), 64, lines=True)
    on_lines = batch_arrays(source.draw(range(points.active), range(64), 0), 3)
    for name in ("u", "v", "value"):
        np.testing.assert_array_equal(plain[name], on_lines[name])
    assert (on_lines["slot"] == SEEN).all() and source.rays.traced == 0


@BY_LISTS_OR_WALKS
def test_lines_with_too_many_gaps_are_left_to_points(device, most):
    """A comb of more bars than a line has room for gaps; what is refused is as embree has it."""
    bars = [quad([-3, 1, z], [0, 0, 0.015], [6, 0, 0]) for z in np.arange(-2, 2, 0.05)]
    scene = mesh_scene(np.concatenate([FLOOR, *bars]), CAMERA, LIGHTS, (grey(),))
    points, source, _ = sampling(device, scene, DirectLight(), (12, 10), 64)
    plain = shadowed_values(source.draw(range(points.active), range(64), 0), 3)
    points, source, _ = sampling(device, scene, DirectLight(), (12, 10), 64, lines=True, most=most)
    on_lines = shadowed_values(source.draw(range(points.active), range(64), 0), 3)
    assert source.rays.off_lines > 1000 and source.rays.on_device > 1000
    assert source.rays.traced == (source.rays.off_lines if most == 0 else 0)
    same = (plain == on_lines).all(axis=0) & (plain[0] > 0)
    assert same.sum() > 100
    # Both have the same mean: Z of their difference over points, whose errors are independent.
    difference = (on_lines - plain).mean(axis=(0, 2))
    assert abs(difference.mean()) < 4 * difference.std() / np.sqrt(len(difference))
    assert np.abs(difference).max() > 0


@BY_LISTS_OR_WALKS
def test_beside_the_lobe_of_a_glossy_surface(device, most):
    """The lobe's samples are points, those of the lights lie on lines: the mean stays the same."""
    plain = soup(12, SEVERAL_LIGHTS)
    scene = replace(plain, materials=(grey(0.2, 0.6, 0.15),))
    means = []
    for lines in (False, True):
        points, source, _ = sampling(
            device, scene, DirectLight(), (12, 10), 1024, lines=lines, most=most
        )
        values = [
            shadowed_values(source.draw(part, range(1024), int(lines)), 3) for part in source.batches()
        ]
        means.append(np.concatenate(values, axis=1).mean(axis=2))
    rays, share = source.rays, points.rows("lobe_share")[0, : points.active]
    assert share.max() > 0.2 and 0 < rays.off_lines < rays.on_device
    assert (rays.traced > 0) == (most == 0)
    # Z over points, whose errors are independent.
    difference = means[1] - means[0]
    scores = difference.mean(axis=1) / (difference.std(axis=1) / np.sqrt(difference.shape[1]))
    assert (np.abs(scores) < 4).all() and difference.any()
    close = np.abs(difference) < 0.05 * means[0].max(axis=1, keepdims=True)
    assert close.all()


@BY_LISTS_OR_WALKS
def test_all_vector_widths_draw_the_same(one_device, most):
    scene, found = soup(40, SEVERAL_LIGHTS), []
    for width in (1, 4, 8, 16):
        shaped = open_device(one_device.cl_device, one_device.index, width, 1)
        points, source, _ = sampling(shaped, scene, DirectLight(), (12, 10), 64, lines=True, most=most)
        found.append(batch_arrays(source.draw(range(points.active), range(64), 0), 3))
    for other in found[1:]:
        for name in "uv":
            np.testing.assert_array_equal(other[name], found[0][name])
        np.testing.assert_allclose(other["value"], found[0]["value"], rtol=2e-4, atol=1e-4)


def test_lists_and_walks_draw_the_same(device):
    """A walk meets triangles in another order, and looks at fewer."""
    found = []
    for most in (None, 0):
        points, source, _ = sampling(
            device, soup(600, SEVERAL_LIGHTS, 0.1), DirectLight(), (12, 10), 64, lines=True, most=most
        )
        found.append(batch_arrays(source.draw(range(points.active), range(64), 0), 3))
        assert source.rays.on_device > 4000
    same = np.abs(found[1]["v"] - found[0]["v"]) < 1e-4
    assert same.mean() > 0.999
    close = np.isclose(found[1]["value"], found[0]["value"], rtol=1e-3, atol=1e-3)
    assert close[:, same].mean() > 0.999


@pytest.mark.parametrize("method", ["mc", "ncv"])
def test_a_picture_by_lines_traces_no_shadow_ray(device, scenes, method):
    options = {"spp": 32, "size": (24, 24), "device": device, **fitting(method, train_spp=4)}
    scene = scenes / "cornell_box.toml"
    image = render(scene, "direct", visibility="lines", **options)
    again = render(scene, "direct", visibility="lines", **options)
    points = render(scene, "direct", visibility="embree", **options)
    assert image.stats["rays_traced"] == 0 < points.stats["rays_traced"]
    assert image.stats["samples_off_lines"] == 0
    np.testing.assert_array_equal(image.pixels, again.pixels)
    assert 0 < np.abs(image.pixels - points.pixels).max() < 0.1
