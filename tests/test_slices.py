"""Ambient occlusion by slices: free heights against embree's, closed forms, and pictures."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from reference import (
    bare_kernel,
    batch_arrays,
    camera_at,
    mesh_scene,
    polygon_irradiance,
    quad,
    sampling,
    shadowed_values,
    tangent_frame,
)

from ncv_cl import load_scene
from ncv_cl.integrands import AmbientOcclusion
from ncv_cl.integrands.ao import MAPPINGS
from ncv_cl.opencl.device import open_device
from ncv_cl.opencl.memory import HostArray
from ncv_cl.points.points import surface_defines
from ncv_cl.points.trace import Tracer
from ncv_cl.rendering.render import render
from ncv_cl.sampling.samples import SEEN
from ncv_cl.visibility import hierarchy, tuning
from ncv_cl.visibility.hierarchy import CHILDREN, packed_order
from ncv_cl.visibility.slices import Slices

CAMERA = camera_at([0, 3, 7], [0, 0, 0], 45)
FLOOR = quad([-4, -1, -4], [0, 0, 8], [8, 0, 0])
AO = AmbientOcclusion()

# Writes, of each point and turn, whether there was room, and what is blocked: lowest, highest, others.
INTERVALS = """
kernel void intervals(const uint point_count, const uint total_points, const uint turn_count,
                      const float radius, global const float *restrict surface,
                      global const float *restrict turns, const float unit,
                      global const uint *restrict levels,
                      global const float *restrict boxes, global const float *restrict triangles,
                      global int *restrict room, global float *restrict blocked) {
  const uint item = (uint)get_global_id(0);
  if (item >= point_count * turn_count) return;
  const ShadingPoint p = load_shading_point(surface, total_points, item / turn_count);
  Slice slice = slice_at(&p, radius, unit, turns[item]);
  room[item] = walk_slice(&slice, levels, boxes, triangles) ? 1 : 0;
  global float *restrict own = blocked + item * (2 * (MOST_BLOCKED + 2));
  own[0] = 0.0f;
  own[1] = squared_height(slice.low);
  own[2] = squared_height(slice.high);
  own[3] = 1.0f;
  for (uint k = 0; k < MOST_BLOCKED; ++k) {
    own[4 + 2 * k] = k < slice.count ? squared_height(slice.first[k]) : -1.0f;
    own[5 + 2 * k] = k < slice.count ? squared_height(slice.last[k]) : -1.0f;
  }
}
"""


@dataclass
class Found:
    """Slices of some points: arrays (points, turns, ...)."""

    turns: np.ndarray
    room: np.ndarray
    blocked: np.ndarray
    """Intervals (points, turns, MOST_BLOCKED + 2, 2) of squared heights; -1 where there is none."""
    seen: np.ndarray
    """By embree, at `heights`."""
    heights: np.ndarray

    @property
    def free(self) -> np.ndarray:
        """Whether the slices' intervals leave `heights` free."""
        first, last = self.blocked[..., None, :, 0], self.blocked[..., None, :, 1]
        height = self.heights[..., None]
        return ~((first <= height) & (height <= last) & (first < last)).any(axis=-1)

    @property
    def disagreements(self) -> np.ndarray:
        """How far from an end of an interval the heights lie at which the two differ."""
        wrong = self.free != self.seen
        ends = self.blocked.reshape(*self.blocked.shape[:2], 1, -1)
        distance = np.abs(ends - self.heights[..., None]).min(axis=-1)
        return distance[wrong & self.room[..., None]]


def compared(device, scene, size=(12, 10), turns=32, heights=16, radius=math.inf, seed=5, at=None):
    """Slices of the scene's points at random turns, and embree's answers at random heights."""
    points, _, _ = sampling(device, scene, AO, size, 1)
    generator = np.random.default_rng(seed)
    shape = (points.active, turns)
    turn = generator.random(shape).astype(np.float32) if at is None else np.broadcast_to(at, shape)
    turn = np.ascontiguousarray(turn, np.float32)
    boxes = Slices(device, scene)
    kernel = bare_kernel(
        device, ("common", "surface", "slices"), {**surface_defines(), **boxes.defines()}, INTERVALS,
        "intervals",
    )  # fmt: skip
    room = HostArray(device, shape, np.int32)
    blocked = HostArray(device, (*shape, tuning.MOST_BLOCKED + 2, 2), np.float32)
    kernel(
        turn.size, point_count=points.active, total_points=points.total, turn_count=turns, radius=radius,
        surface=points.surface, turns=HostArray.of(device, turn), **boxes.arguments, room=room,
        blocked=blocked,
    )  # fmt: skip
    height = generator.random((*shape, heights))
    axes = [tangent_frame(normal) for normal in points.rows("normal").T[: points.active].astype(float)]
    tangent, bitangent = (np.array(axis)[:, None, None] for axis in zip(*axes, strict=True))
    up, across_up = (
        points.rows("normal").T[: points.active, None, None],
        2 * np.pi * turn[..., None, None],
    )
    across = np.cos(across_up) * tangent + np.sin(across_up) * bitangent
    direction = np.sqrt(1 - height)[..., None] * across + np.sqrt(height)[..., None] * up
    origin = (points.rows("position") + points.rows("offset") * points.rows("geometric_normal")).T
    rays = direction.reshape(-1, 3).astype(np.float32)
    origins = np.repeat(origin[: points.active], turns * heights, axis=0).astype(np.float32)
    answers = np.empty(len(rays), np.uint8)
    Tracer(scene, 2).visible(origins, rays, np.full(len(rays), radius, np.float32), answers)
    above = np.einsum("ptha,pa->pth", direction, points.rows("geometric_normal").T[: points.active])
    seen = answers.reshape(height.shape).astype(bool) & (above > 0)
    return Found(turn, room.read() != 0, blocked.read(), seen, height)


def soup(count, size=0.4, seed=3):
    """A floor, and triangles of any shape and place above it."""
    generator = np.random.default_rng(seed)
    centres = generator.uniform([-2.5, -0.8, -2.5], [2.5, 3.5, 2.5], (count, 1, 3))
    return mesh_scene(
        np.concatenate([FLOOR, centres + size * generator.normal(size=(count, 3, 3))]), CAMERA
    )


def openness(device, scene, integrand=AO, spp=256, size=(5, 4)):
    """Positions (points, 3) and mean values (points,) of a picture by slices."""
    points, source, _ = sampling(device, scene, integrand, size, spp, sliced=True)
    values = shadowed_values(source.draw(range(points.active), range(spp), 0), 1)[0]
    assert source.rays.traced == source.rays.off_lines == 0
    return points.rows("position").T[: points.active].astype(float), values.mean(axis=1)


@pytest.mark.parametrize("radius", [math.inf, 1.3])
@pytest.mark.parametrize("count", [0, 1, 15, 40, 600, 9000])
def test_free_heights_are_those_that_embree_sees(device, count, radius):
    found = compared(device, soup(count, 3 / (2 + count**0.5)), radius=radius)
    assert count == 0 or 0.05 < found.seen.mean() < 0.999
    # In so dense a soup many slices have more gaps than there is room for.
    assert found.room.mean() > (0.98 if count < 100 else 0.4)
    assert len(found.disagreements) < 2e-4 * found.seen.size
    assert (found.disagreements < 2e-5).all()


@pytest.mark.parametrize("name", ["knot", "occluders", "cornell_box", "interior"])
def test_free_heights_of_shipped_scenes(one_device, scenes, name):
    found = compared(one_device, load_scene(scenes / f"{name}.toml"), (24, 18))
    assert found.room.mean() > 0.999
    assert len(found.disagreements) < 2e-4 * found.seen.size
    assert (found.disagreements < 2e-5).all()


# Corners on a grid of whole numbers lie in planes of each other, of the floor and of points' normals.
CORNERS = st.tuples(st.integers(-3, 3), st.integers(-1, 4), st.integers(-3, 3))


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(CORNERS, CORNERS, CORNERS), min_size=1, max_size=12), st.booleans())
def test_triangles_with_corners_on_a_grid(one_device, triangles, twice):
    triangles = np.array(triangles * 2 if twice else triangles, float)
    found = compared(one_device, mesh_scene(np.concatenate([FLOOR, triangles]), CAMERA), (8, 6))
    assert (found.disagreements < 5e-5).all()


BOX = quad([0, 0, 0], [1, 0, 0], [0, 1, 0])
SPECIAL = {
    "duplicates": [*[quad([-1, 0, -1], [2, 0, 0], [0, 0, 2])] * 3],
    "walls on the floor": [
        quad([-2, -1, 0], [4, 0, 0], [0, 1, 0]),
        quad([0, -1, -2], [0, 0, 4], [0, 2, 0]),
    ],
    "through the floor": [quad([-1, -2, -1], [2, 0, 0.3], [0, 2, 0.2])],
    "in the floor's plane": [quad([-1, -1, -1], [2, 0, 0], [0, 0, 2])],
    "needles": [quad([-3, y, -1], [6, 1e-4, 0], [0, 1e-4, 1e-4]) for y in (-0.9, 0, 1)],
    "points and lines": [np.array([[[0, 1, 0]] * 3, [[0, 0, 0], [1, 1, 1], [2, 2, 2]]], float)],
    "a T": [quad([-1, 0, -1], [2, 0, 0], [0, 0, 1]), quad([-1, 0, 0], [1, 0, 0], [0, 0, 1])],
    "interpenetrating": [
        quad([-1, 0, -1], [2, 1, 0], [0, 0, 2]),
        quad([-1, 1, -1], [2, -1, 0], [0, 0, 2]),
    ],
}  # fmt: skip


@pytest.mark.parametrize("name", SPECIAL)
@pytest.mark.parametrize("radius", [math.inf, 1.0])
def test_special_triangles_block_what_they_block_for_embree(device, name, radius):
    scene = mesh_scene(np.concatenate([FLOOR, *SPECIAL[name]]), CAMERA)
    found = compared(device, scene, radius=radius)
    assert found.room.all()
    assert len(found.disagreements) < 1e-3 * found.seen.size
    assert (found.disagreements < 5e-5).all()


@pytest.mark.parametrize("at", [0.0, 0.25, 0.125, None])
def test_nothing_is_seen_from_inside_a_closed_room(device, at):
    """Slices along common edges and through corners, and through triangles' own planes."""
    grid = np.linspace(-1, 1, 5)
    steps = [(a, b) for a in grid[:-1] for b in grid[:-1]]
    room = [quad([a, y, b], [0.5, 0, 0], [0, 0, 0.5]) for y in (-1, 1) for a, b in steps]
    room += [quad([x, a, b], [0, 0.5, 0], [0, 0, 0.5]) for x in (-1, 1) for a, b in steps]
    room += [quad([a, b, z], [0.5, 0, 0], [0, 0.5, 0]) for z in (-1, 1) for a, b in steps]
    scene = mesh_scene(np.concatenate(room), camera_at([0, 0.5, 0], [0, -1, 0], 80, up=(0.2, 0, 1)))
    found = compared(device, scene, (8, 8), turns=16, at=at)
    first, last = found.blocked[..., 0], found.blocked[..., 1]
    left = 1 - np.maximum(last - first, 0).sum(axis=-1)
    assert found.room.all() and left.max() < 2e-6


def test_an_open_point_sees_everything(device):
    for radius in (math.inf, 2.0):
        _, values = openness(device, mesh_scene(FLOOR, CAMERA), AmbientOcclusion(radius))
        np.testing.assert_array_equal(values, 1)


@pytest.mark.parametrize("mapping", MAPPINGS)
@pytest.mark.parametrize("height, radius", [(0.5, 0.4), (0.5, 0.6), (0.2, 1.0), (0.3, 3.0)])
def test_under_a_wide_plate_by_radius(device, mapping, height, radius):
    plates = [quad([-9, -9, z], [18, 0, 0], [0, 18, 0]) for z in (0, height)]
    camera = camera_at([0, 0, height / 2], [0, 0, 0], 20, up=[0, 1, 0])
    scene = mesh_scene(np.concatenate(plates), camera)
    _, values = openness(device, scene, AmbientOcclusion(radius, mapping), 16)
    np.testing.assert_allclose(values, min(1.0, (height / radius) ** 2), rtol=1e-5)


@pytest.mark.parametrize("mapping", MAPPINGS)
@pytest.mark.parametrize("plate", ["above", "aslant", "far"])
def test_under_a_plate_by_lamberts_formula(device, mapping, plate):
    corners = {
        "above": ([-1, 0.5, -1], [2, 0, 0], [0, 0, 2]),
        "aslant": ([-0.5, -0.8, -1], [2, 1.5, 0.2], [0.3, 0.1, 2]),
        "far": ([3, 0, -5], [0, 2, 0], [0, 0, 9]),
    }[plate]
    camera = camera_at([-3, 2, 0], [-1, -1, 0], 40)
    positions, values = openness(
        device,
        mesh_scene(np.concatenate([FLOOR, quad(*corners)]), camera),
        AmbientOcclusion(mapping=mapping),
        1024,
    )
    corner, edge1, edge2 = np.array(corners, float)
    polygon = np.array([corner, corner + edge1, corner + edge1 + edge2, corner + edge2])
    floor = np.abs(positions[:, 1] + 1) < 1e-5
    expected = [1 - polygon_irradiance(polygon, at, [0, 1, 0]) / np.pi for at in positions[floor]]
    assert floor.sum() > 8 and min(expected) < 0.97
    # Where an edge runs along the normal, what is free jumps with the azimuth.
    np.testing.assert_allclose(values[floor], expected, atol=5e-4 if plate == "far" else 2e-5)


@pytest.mark.parametrize("walls, expected", [(1, 1 / 2), (2, 1 / 4)])
def test_in_a_corner(device, walls, expected):
    planes = [
        quad([-1, 0, -1], [0, 0, 1e5], [1e5, 0, 0]),
        quad([-1, -1, -1e5], [0, 0, 2e5], [0, 1e5, 0]),
        quad([-1e5, -1, -1], [2e5, 0, 0], [0, 1e5, 0]),
    ]
    camera = camera_at([1, 1, 1], [0, 0, 0], 20)
    _, values = openness(device, mesh_scene(np.concatenate(planes[: walls + 1]), camera), spp=512)
    # The wall's top and its ends are 10^5 away; azimuths are equidistant.
    np.testing.assert_allclose(values, expected, atol=1 / 512 + 1e-4)


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_the_unit_of_length_does_not_matter(device, scale):
    def scaled(scale):
        found = soup(40)
        camera = replace(found.camera, position=found.camera.position * scale)
        return replace(found, vertices=(found.vertices * np.float32(scale)), camera=camera)

    for radius in (math.inf, 1.0):
        pictures = [
            openness(device, scaled(one), AmbientOcclusion(radius * one), 64)[1] for one in (1.0, scale)
        ]
        np.testing.assert_allclose(*pictures, atol=1e-3)
        np.testing.assert_allclose(pictures[0].mean(), pictures[1].mean(), atol=1e-4)


def test_square_errors_fall_like_the_cube_of_slices(one_device):
    scene = soup(40)
    truth = openness(one_device, scene, spp=4096, size=(12, 10))[1]
    errors = [
        np.mean((openness(one_device, scene, spp=n, size=(12, 10))[1] - truth) ** 2) for n in (16, 256)
    ]
    # With rays it is n to -1.5.
    assert errors[0] / errors[1] > 16**2.4


def test_samples_are_equidistant_under_one_shift_a_point(device):
    points, source, _ = sampling(device, soup(3), AO, (5, 4), 64, sliced=True)
    shifts = set()
    for samples in (range(64), range(64, 128)):
        batch = batch_arrays(source.draw(range(points.active), samples, 0), 1)
        v = np.sort(batch["v"], axis=1)
        np.testing.assert_allclose(np.diff(v, axis=1), 1 / 64, atol=1e-6)
        shifts |= set(v[:, 0].tolist())
        assert np.abs(batch["u"].mean() - 0.5) < 0.01
    assert len(shifts) == 2 * points.active


def test_slices_without_room_are_left_to_rays(device):
    """A comb of more bars than there is room for: the mean is embree's all the same."""
    bars = [quad([-6, 0, z], [0, 0, 0.03], [12, 0, 0]) for z in np.arange(-4, 4, 0.1)]
    scene = mesh_scene(np.concatenate([FLOOR, *bars]), camera_at([0, -0.2, 3], [0, -1, 0], 40))
    spp, means = 512, []
    for sliced in (False, True):
        points, source, _ = sampling(
            device, scene, AO, (12, 10), spp, "independent", 2 + sliced, sliced=sliced
        )
        batch = source.draw(range(points.active), range(spp), 0)
        means.append(shadowed_values(batch, 1)[0].mean(axis=1))
    rays = source.rays
    assert 0 < rays.traced <= rays.off_lines and rays.on_device > 0
    assert rays.traced + rays.on_device + rays.skipped == spp * points.active
    slot = batch_arrays(batch, 1)["slot"]
    assert np.count_nonzero(slot < SEEN) == rays.traced
    difference = means[1] - means[0]
    assert abs(difference.mean()) < 4 * difference.std() / np.sqrt(len(difference))
    assert difference.std() < 0.05


def test_all_vector_widths_draw_the_same(one_device):
    scene, found = soup(60), []
    for width in (1, 4, 8, 16):
        shaped = open_device(one_device.cl_device, one_device.index, width, 1)
        points, source, _ = sampling(shaped, scene, AO, (12, 10), 48, sliced=True)
        found.append(batch_arrays(source.draw(range(points.active), range(48), 0), 1))
    for other in found[1:]:
        np.testing.assert_array_equal(other["v"], found[0]["v"])
        np.testing.assert_allclose(other["value"], found[0]["value"], atol=2e-6)


@pytest.mark.parametrize("count", [1, 2, 16, 17, 255, 256, 257, 4096, 5000])
def test_nodes_hold_what_their_children_hold(count):
    generator = np.random.default_rng(count)
    corners = (generator.normal(size=(count, 1, 3)) + 0.1 * generator.normal(size=(count, 3, 3))).astype(
        np.float32
    )
    lower, upper = corners.min(axis=1), corners.max(axis=1)
    order = packed_order(lower, upper)
    np.testing.assert_array_equal(np.sort(order), np.arange(count))
    levels = hierarchy.box_levels(lower[order], upper[order])
    boxes = np.concatenate([lower[order], upper[order]], axis=1)
    for nodes in levels:
        own = nodes.transpose(0, 2, 1).reshape(-1, 6)
        for k in range(-(-len(boxes) // CHILDREN)):
            children = boxes[k * CHILDREN : (k + 1) * CHILDREN]
            np.testing.assert_array_equal(own[k, :3], children[:, :3].min(axis=0))
            np.testing.assert_array_equal(own[k, 3:], children[:, 3:].max(axis=0))
        assert (own[-(-len(boxes) // CHILDREN) :, 0] > own[-(-len(boxes) // CHILDREN) :, 3]).all()
        boxes = own
    assert len(levels[-1]) == 1


def test_the_order_keeps_near_triangles_together():
    """Surfaces of leaves beside those of triangles in order of one axis."""
    generator = np.random.default_rng(1)
    centres = generator.random((20000, 3)).astype(np.float32)
    order = packed_order(centres, centres)

    def surface(rows):
        extent = np.ptp(centres[rows].astype(float), axis=1)
        return (extent * np.roll(extent, 1, axis=1)).sum()

    packed = surface(order[: 20000 // CHILDREN * CHILDREN].reshape(-1, CHILDREN))
    sliced = surface(np.argsort(centres[:, 0])[: 20000 // CHILDREN * CHILDREN].reshape(-1, CHILDREN))
    assert packed < 0.1 * sliced


@pytest.mark.parametrize(
    "options", [{"method": "mc"}, {"method": "ncv", "train_spp": 4}], ids=["mc", "ncv"]
)
def test_a_picture_by_slices_traces_no_shadow_ray(device, scenes, options):
    options = {"spp": 32, "size": (24, 24), "device": device, **options}
    scene = scenes / "cornell_box.toml"
    image = render(scene, "ao", visibility="lines", **options)
    again = render(scene, "ao", visibility="lines", **options)
    rays = render(scene, "ao", visibility="embree", **options)
    assert (
        image.stats["rays_traced"] == image.stats["samples_off_lines"] == 0 < rays.stats["rays_traced"]
    )
    np.testing.assert_array_equal(image.pixels, again.pixels)
    assert 0 < np.abs(image.pixels - rays.pixels).max() < 0.25
