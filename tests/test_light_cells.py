"""Cells of a scene and their rows of strips: what may be left out, shares, and what kernels read."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from reference import (
    bare_kernel,
    batch_arrays,
    camera_at,
    light_at,
    light_corners,
    mesh_scene,
    polygon_irradiance,
    quad,
    sampling,
    unit,
)

from ncv_cl.integrands import DirectLight
from ncv_cl.integrands.light_cells import cell_of, may_light, mean_irradiance, scene_cells
from ncv_cl.integrands.light_sources import Lights
from ncv_cl.integrands.lights import (
    LIGHT,
    LIGHT_FILES,
    light_defines,
    light_records,
    light_rows,
    narrowest_strip,
    strip_widths,
)
from ncv_cl.integrands.tuning import EQUAL_PART
from ncv_cl.opencl.memory import HostArray
from ncv_cl.points.points import surface_defines

CAMERA = camera_at([0, 1, 3], [0, 0, 0])
KERNEL = """
kernel void rows(const uint count, global const float *lights, global const float *numbers,
                 global float *result) {
  const uint first = (uint)get_global_id(0) * VEC;
  if (first >= count) return;
  real number[7];
  for (uint k = 0; k < 7; ++k) number[k] = LOAD(numbers + k * count + first);
  const triple position = {number[0], number[1], number[2]};
  const triple normal = {number[3], number[4], number[5]};
  const whole row = strips_of(lights, position, normal);
  real begin, width;
  const whole record = light_at(lights, row, number[6], &begin, &width);
  STORE(TO_REAL(row), result + first);
  STORE(TO_REAL(record), result + count + first);
  STORE(begin, result + 2 * count + first);
  STORE(width, result + 3 * count + first);
  for (int k = 0; k < LIGHT_FLOATS; ++k)
    STORE(light_number(lights, record, k), result + (4 + k) * count + first);
}
"""


def some_lights(count: int, generator: np.random.Generator) -> tuple:
    """Of very different power, in all directions, one in five two-sided and one in nine off."""
    return tuple(
        light_at(
            generator.uniform(-3, 3, 3),
            *generator.normal(size=(2, 3)) * 10 ** generator.uniform(-2, 0.5),
            0.0 if k % 9 == 8 else 10 ** generator.uniform(-4, 4),
            two_sided=k % 5 == 4,
        )
        for k in range(count)
    )


def crumpled(generator: np.random.Generator, count: int = 60) -> np.ndarray:
    """Triangles of all sizes and directions, some along the axes, float32 (triangles, 3, 3)."""
    corners = generator.uniform(-3, 3, (count, 1, 3))
    sizes = 10 ** generator.uniform(-1.5, 0.7, (count, 1, 1))
    triangles = corners + sizes * generator.normal(size=(count, 3, 3))
    flat = np.concatenate([quad([-3, y, -3], [6, 0, 0], [0, 0, 6]) for y in (-2, 0.37, 3)])
    ridge = quad([-1, -1, -1], [2, 0, 0], [0, 2, 2])
    return np.concatenate([triangles, flat, ridge]).astype(np.float32)


def on_triangles(triangles: np.ndarray, each: int, generator) -> tuple[np.ndarray, np.ndarray]:
    """Points and unit normals of either side, float32 (points, 3)."""
    weights = generator.dirichlet([0.7, 0.7, 0.7], (len(triangles), each))
    points = np.einsum("tek,tkc->tec", weights, triangles.astype(float)).reshape(-1, 3)
    edges = triangles[:, 1:].astype(float) - triangles[:, :1]
    normals = np.repeat(unit(np.cross(edges[:, 0], edges[:, 1])), each, axis=0)
    normals *= generator.choice([-1, 1], (len(normals), 1))
    return points.astype(np.float32), normals.astype(np.float32)


@pytest.mark.parametrize("count", [2, 3, 4, 5, 16, 17, 1000, 5000])
@pytest.mark.parametrize("ratio", [1.0, 1.3, 1e6, 1e30])
def test_strips_are_dyadic_and_none_is_starved(count, ratio):
    brings = ratio ** np.random.default_rng(count).uniform(-0.5, 0.5, (3, count))
    widths = strip_widths(brings)
    steps = max(16, 1 << int(4 * count - 1).bit_length())
    whole = widths * steps
    np.testing.assert_array_equal(whole, np.rint(whole))
    assert (whole.sum(axis=1) == steps).all() and whole.min() >= 1
    wanted = (1 - EQUAL_PART) * brings / brings.sum(axis=1, keepdims=True) + EQUAL_PART / count
    assert np.abs(widths - wanted).max() < 1 / steps
    # Those that bring nothing have none, whatever the others bring.
    widths = strip_widths(np.where(np.arange(count) % 2 == 0, brings, 0.0))
    assert not widths[:, 1::2].any() and (widths.sum(axis=1) == 1).all() and widths[:, ::2].min() > 0


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("side", [1, 5, 16])
def test_no_light_is_left_out_that_lights_a_point(seed, side):
    generator = np.random.default_rng(seed)
    lights, triangles = some_lights(40, generator), crumpled(generator)
    scene = mesh_scene(triangles, CAMERA, lights)
    cells, arrays = scene_cells(scene, side), Lights.of(lights)
    may = may_light(cells, arrays)
    position, normal = on_triangles(triangles, 300, generator)
    number = cell_of(cells, position, normal)
    index = np.searchsorted(cells.number, number)
    # Every surface's cell is known.
    np.testing.assert_array_equal(cells.number[np.minimum(index, len(cells.number) - 1)], number)
    lit = np.zeros((len(position), 40), bool)
    for k, light in enumerate(lights):
        to = light_corners(light) - position[:, None].astype(float)
        above = (to * normal[:, None]).sum(axis=2).max(axis=1) > 0
        lit[:, k] = above & (light.two_sided | (to[:, 0] @ light.normal.astype(float) < 0))
    assert not (lit & ~may[index]).any()
    # What is left out is worth it: of fine cells most of what does not light a point.
    assert side < 16 or (lit | ~may[index]).mean() > 0.8


def test_cells_at_the_edge_of_rounding_are_known():
    """Points on the very faces of boxes, and normals between two directions."""
    generator = np.random.default_rng(3)
    triangles = crumpled(generator)
    scene = mesh_scene(triangles, CAMERA, some_lights(3, generator))
    cells = scene_cells(scene, 16)
    position, normal = on_triangles(triangles, 100, generator)
    number = set(cells.number.tolist())
    for _ in range(20):
        moved = position * (1 + generator.uniform(-3e-7, 3e-7, position.shape)).astype(np.float32)
        turned = normal + generator.uniform(-3e-7, 3e-7, normal.shape).astype(np.float32)
        assert set(cell_of(cells, moved, turned).tolist()) <= number


def test_what_lights_bring_is_lamberts_irradiance_where_cells_are_small():
    floor = np.concatenate(
        [quad([x, 0, z], [0, 0, 0.01], [0.01, 0, 0]) for x in (-2, 0, 1) for z in (-1, 0.5)]
    )
    lights = (
        light_at([-1, 2, -1], [2, 0, 0], [0, 0, 2], 1),
        light_at([-100, 2, -100], [200, 0, 0], [0, 0, 200], 1),
        light_at([4, 0.5, 1], [0, 0, 1], [0, 1, 0.3], 1, two_sided=True),
        light_at([-20, 90, -20], [40, 0, 0], [0, 0, 40], 1),
    )
    scene = mesh_scene(floor, CAMERA, lights)
    cells = scene_cells(scene, 300)
    above = cells.normals[:, 0, 1] > 0.5
    found = mean_irradiance(cells, Lights.of(lights))[above]
    assert len(found) >= 6
    for place, row in zip(cells.places[above, 0], found, strict=True):
        exact = [polygon_irradiance(light_corners(one), place, np.eye(3)[1]) for one in lights]
        np.testing.assert_allclose(row, exact, rtol=0.25)
    # The floor's other side sees no light that is above it.
    assert not mean_irradiance(cells, Lights.of(lights))[~above][:, [0, 1, 3]].any()


@pytest.mark.parametrize("count", [2, 8, 9, 100, 1000])
def test_kernels_find_the_rows_strips_and_records_that_were_made(device, count):
    generator = np.random.default_rng(count)
    lights, triangles = some_lights(count, generator), crumpled(generator)
    scene = mesh_scene(triangles, CAMERA, lights)
    rows, records, defines = light_rows(scene), light_records(scene), light_defines(scene)
    position, normal = on_triangles(triangles, 32, generator)
    u = generator.random(len(position), np.float32)
    u[:64] = np.arange(64) / np.float32(64)
    number = len(position) // 16 * 16
    numbers = np.concatenate([position.T, normal.T, u[None]])[:, :number].astype(np.float32)
    files = ("common", "surface", *LIGHT_FILES)
    kernel = bare_kernel(device, files, {**surface_defines(), **defines}, KERNEL, "rows")
    result = HostArray(device, (4 + LIGHT.size, number), np.float32)
    kernel(
        number // device.vector_width,
        count=number,
        lights=HostArray.of(device, records),
        numbers=HostArray.of(device, np.ascontiguousarray(numbers)),
        result=result,
    )
    row, record, first, width, *fields = result.read()
    own = rows.table[cell_of(rows.cells, position[:number], normal[:number])]
    row_floats = defines["STRIP_STEPS"] + 2 * count
    begin = count * LIGHT.size + defines["FRAME_FLOATS"]
    # Rounding may take a point for one of the box beside its own.
    same = row == begin + own * row_floats
    assert same.mean() > 0.999
    strips = rows.strips[((row - begin) / row_floats).astype(int)]
    light = (record / LIGHT.size).astype(int)
    lane = np.arange(number)
    np.testing.assert_array_equal(first, strips[lane, light, 0])
    np.testing.assert_array_equal(width, strips[lane, light, 1])
    assert ((u[:number] >= first) & (u[:number] < first + width) & (width > 0)).all()
    expected = records[: count * LIGHT.size].reshape(count, LIGHT.size)[light]
    np.testing.assert_array_equal(np.array(fields).T, expected)


@pytest.mark.parametrize("count", [2, 1000, 5000])
def test_rows_are_exact_in_single_precision_and_fit_their_memory(count):
    generator = np.random.default_rng(count)
    scene = mesh_scene(crumpled(generator), CAMERA, some_lights(count, generator))
    rows, records = light_rows(scene), light_records(scene)
    assert records.nbytes < 40 << 20
    single = rows.strips.astype(np.float32)
    np.testing.assert_array_equal(single, rows.strips)
    np.testing.assert_array_equal(single[:, :-1].sum(axis=2), single[:, 1:, 0])
    assert (single[:, -1].sum(axis=1) == 1).all()
    off = [not one.radiance.any() for one in scene.lights]
    assert not rows.widths[:, off].any() and rows.table.max() == len(rows.widths) - 1
    assert narrowest_strip(scene) == rows.widths[rows.widths > 0].min() > 0


def test_surfaces_that_no_light_reaches_have_the_row_of_power():
    above, below = quad([-1, 0, -1], [0, 0, 2], [2, 0, 0]), quad([-1, 5, -1], [0, 0, 2], [2, 0, 0])
    lights = tuple(light_at([x, 2, 0], [0.1, 0, 0], [0, 0, 0.1], 5) for x in (0, 0.5))
    rows = light_rows(mesh_scene(np.concatenate([above, below]), CAMERA, lights))
    up = np.array([[0.0, 1, 0]], np.float32)
    places = np.array([[[0.1, 0, 0.2]], [[0.1, 5, 0.2]]], np.float32)
    cells = [cell_of(rows.cells, place, sign * up)[0] for place in places for sign in (1, -1)]
    found = rows.table[cells].tolist()
    assert found[0] > 0 and found[1:] == [0, 0, 0]
    # A scene of lights alone has rows too.
    alone = mesh_scene(np.zeros((0, 3, 3)), CAMERA, lights)
    assert np.isfinite(light_records(alone)).all()


def hall(count: int, generator: np.random.Generator):
    """A floor of 40 x 40 under many small lamps of very different power."""
    lamps = tuple(
        light_at([x, y, z], [0.2, 0, 0], [0, 0, 0.2], 10 ** generator.uniform(0, 2))
        for x, y, z in generator.uniform([-20, 3, -20], [20, 5, 20], (count, 3))
    )
    return mesh_scene(
        quad([-20, 0, -20], [0, 0, 40], [40, 0, 0]), camera_at([0, 8, 15], [0, 0, 0], 60), lamps
    )


def test_a_thousand_lamps_are_sampled_by_what_they_bring(one_device):
    """With shares by irradiance at each point the variance would be next to zero."""
    scene = hall(1000, np.random.default_rng(0))
    points, source, _ = sampling(one_device, scene, DirectLight(), (8, 8), 1024, "independent")
    values = batch_arrays(source.draw(range(points.active), range(1024), 0), 3)["value"][0].astype(float)
    position = points.rows("position").T[: points.active].astype(float)
    lights = Lights.of(scene.lights)
    to = lights.corner + lights.edges.sum(axis=1) / 2 - position[:, None]
    height = to[..., 1]
    irradiance = height**2 / (to**2).sum(axis=2) ** 2 * lights.area * lights.radiance[:, 0]
    exact = irradiance.sum(axis=1) * 0.5 / np.pi
    mean, variance = values.mean(axis=1), values.var(axis=1)
    # Lamps are small: their middles stand for them.
    z = (mean - exact) / np.hypot(np.sqrt(variance / 1024), 2e-3 * exact)
    assert np.abs(z).max() < 4.5
    assert np.median(variance / exact**2) < 0.5
    # Shares by power alone would be far worse.
    widths = light_rows(scene).widths[0]
    by_power = ((irradiance * 0.5 / np.pi) ** 2 / widths).sum(axis=1) - exact**2
    assert np.median(variance) < 0.1 * np.median(by_power)


def test_rows_are_made_once_and_do_not_keep_their_scene():
    scene = hall(20, np.random.default_rng(1))
    assert light_rows(scene) is light_rows(scene)
    assert light_rows(replace(scene)) is not light_rows(scene)
