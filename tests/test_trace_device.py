"""Rays through boxes on the device: embree's answers and float64's, and none slips through edges."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from reference import bare_kernel, camera_at, grey, intersect, mesh_scene, unit
from test_shadow import CAMERA, rays_in, soup
from test_trace import convex_shapes

from ncv_cl.opencl.device import open_device
from ncv_cl.opencl.memory import HostArray
from ncv_cl.opencl.program import source
from ncv_cl.points.points import find_points
from ncv_cl.points.trace import Tracer
from ncv_cl.scene.load import load_scene
from ncv_cl.visibility.hierarchy import Hierarchy
from ncv_cl.visibility.trace import DeviceTracer

KERNEL = """
kernel void trace(const uint count, const float extent, global const uint *levels,
                  global const float *boxes, global const float *triangles, global const uint *numbers,
                  global const float *origins, global const float *directions,
                  global const float *farthest, global int *triangle, global float *found,
                  global uchar *blocked) {
  const uint ray = (uint)get_global_id(0);
  if (ray >= count) return;
  const Tree tree = {levels, boxes, triangles, extent};
  const float3 origin = vload3(ray, origins);
  const float3 direction = vload3(ray, directions);
  const Met met = first_met(&tree, origin, direction);
  triangle[ray] = met.place < 0 ? -1 : (int)numbers[met.place];
  vstore3((float3)(met.u, met.v, met.distance), ray, found);
  blocked[ray] = is_blocked(&tree, origin, direction, farthest[ray]) ? 1 : 0;
}
"""
DIFFERENCES = """
kernel void differences(global const float *numbers, global float *result) {
  const uint at = (uint)get_global_id(0) * VEC;
  STORE(signed_difference(LOAD(numbers + at), LOAD(numbers + COUNT + at), LOAD(numbers + 2 * COUNT + at),
                          LOAD(numbers + 3 * COUNT + at)), result + at);
}
"""
# Of an edge or a corner, in barycentric coordinates, and of a distance: within what rounding may move.
NEAR_EDGE, NEAR = 2e-5, 2e-5


def traced(device, scene, origin, direction, farthest=None, hierarchy=None):
    """Triangle, u, v, distance of first hits, and whether anything is met before `farthest` (1)."""
    tracer = DeviceTracer(device, hierarchy or Hierarchy(device, scene))
    kernel = bare_kernel(device, ("common", "trace"), tracer.defines(), KERNEL, "trace")
    count = len(origin)
    farthest = np.ones(count, np.float32) if farthest is None else farthest
    triangle, blocked = HostArray(device, count, np.int32), HostArray(device, count, np.uint8)
    found = HostArray(device, (count, 3), np.float32)
    kernel(
        count,
        count=count,
        **tracer.arguments,
        numbers=tracer.numbers,
        origins=HostArray.of(device, origin.astype(np.float32)),
        directions=HostArray.of(device, direction.astype(np.float32)),
        farthest=HostArray.of(device, farthest.astype(np.float32)),
        triangle=triangle,
        found=found,
        blocked=blocked,
    )
    return triangle.read(), *found.read().T, blocked.read().astype(bool)


def exact(scene, origin, direction, triangle):
    """Least barycentric coordinate and distance, float64, where rays meet the planes of triangles."""
    a, b, c = scene.vertices[scene.triangles[triangle]].astype(np.float64).transpose(1, 0, 2)
    origin, direction = origin.astype(np.float64), direction.astype(np.float64)
    normal = np.cross(b - a, c - a)
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = np.sum(normal * (a - origin), 1) / np.sum(normal * direction, 1)
        sides = [
            np.sum(direction * np.cross(p - origin, q - origin), 1) for p, q in ((b, c), (c, a), (a, b))
        ]
        weights = np.array(sides) / np.sum(sides, axis=0)
    return weights.min(axis=0), distance


def rounding_alone(scene, origin, direction, ours, theirs):
    """Whether two answers differ because a ray grazes an edge or two triangles are equally far."""
    least, distance = zip(*(exact(scene, origin, direction, np.maximum(k, 0)) for k in (ours, theirs)),
                          strict=True)  # fmt: skip
    grazes = [(np.abs(one) < NEAR_EDGE) & (k >= 0) for one, k in zip(least, (ours, theirs), strict=True)]
    # Coordinates are rounded as well, so a ray may begin on either side of what it begins at.
    size = np.abs(origin).max(axis=1) / np.linalg.norm(direction.astype(np.float64), axis=1)
    slack = NEAR * np.maximum(np.abs(distance[1]), size)
    ties = (ours >= 0) & (theirs >= 0) & (np.abs(distance[0] - distance[1]) < slack)
    begins = [(np.abs(d) < slack) & (k >= 0) for d, k in zip(distance, (ours, theirs), strict=True)]
    return np.any([*grazes, ties, *begins], axis=0)


def scene_rays(device, scene, count):
    """Rays from points of surfaces, as samples leave them, and from anywhere in the scene's box."""
    points = find_points(device, scene, Tracer(scene, 1), 64, 64, 1, True)
    start = points.rows("position") + points.rows("offset") * points.rows("geometric_normal")
    generator = np.random.default_rng(7)
    chosen = generator.integers(0, points.active, count)
    towards = generator.normal(size=(count, 3)) + 1.5 * points.rows("geometric_normal").T[chosen]
    origin, segment = rays_in(scene, count)
    return (
        np.concatenate([start.T[chosen], origin]).astype(np.float32),
        np.concatenate([towards, segment]).astype(np.float32),
    )


@pytest.mark.parametrize("name", ["cornell_box", "interior", "knot", "occluders", "veach_plates"])
def test_answers_are_embrees_but_for_rounding(device, scenes, name):
    scene = load_scene(scenes / f"{name}.toml")
    origin, direction = scene_rays(device, scene, 100_000)
    farthest = np.random.default_rng(3).uniform(0, 2, len(origin)).astype(np.float32)
    triangle, u, v, distance, blocked = traced(device, scene, origin, direction, farthest)
    tracer = Tracer(scene, 1)
    hits, visible = tracer.closest(origin, direction), np.zeros(len(origin), np.uint8)
    tracer.visible(origin, direction, farthest, visible)
    differ = triangle != hits.triangle
    assert differ.mean() < 0.01 and (triangle >= 0).mean() > 0.1
    arguments = (scene, origin[differ], direction[differ], triangle[differ], hits.triangle[differ])
    assert rounding_alone(*arguments).all()
    # Where answers are alike, so are the places, but for rays that lie in the triangle's plane.
    same = ~differ & (triangle >= 0)
    for ours, theirs in ((u, hits.u), (v, hits.v), (distance, hits.distance)):
        error = np.abs(ours - theirs)[same]
        assert np.median(error) < 1e-6 and np.mean(error > 1e-3) < 1e-4
    other = blocked == (visible != 0)
    least, at = exact(scene, origin, direction, np.maximum(hits.triangle, 0))
    grazes = (np.abs(least) < NEAR_EDGE) | (np.abs(at - farthest) < NEAR * np.maximum(1, np.abs(at)))
    assert (grazes | differ)[other].all() and other.mean() < 1e-3


@hypothesis_settings(max_examples=12, deadline=None)
@given(
    count=st.sampled_from([1, 2, 15, 16, 17, 100, 255, 300]),
    place=st.sampled_from([0.0, -300.0, 1e4]),
    scale=st.sampled_from([1e-3, 1.0, 1e3]),
    seed=st.integers(0, 2**20),
)
def test_hits_are_those_of_double_precision(device, count, place, scale, seed):
    scene = soup(count, place if scale >= 1 else 0.0, scale, seed)
    origin, direction = rays_in(scene, 1024, seed + 1)
    smaller, larger = (intersect(scene, origin, direction, slack) for slack in (-1e-4, 1e-4))
    near = np.minimum(smaller[3], larger[3]) < 1e-4
    sure = (smaller[0] == larger[0]) & ~near
    assert sure.mean() > 0.9
    triangle, _, _, distance, blocked = traced(device, scene, origin, direction)
    np.testing.assert_array_equal(triangle[sure], smaller[0][sure])
    ends = sure & (np.abs(smaller[3] - 1) > 1e-4)
    np.testing.assert_array_equal(blocked[ends], smaller[3][ends] < 1)
    met = sure & (triangle >= 0)
    error = np.abs(distance / smaller[3] - 1)[met]
    assert not met.any() or (np.median(error) < 1e-4 and np.mean(error > 1e-2) < 0.01)


def test_signs_of_differences_are_exact(device):
    """Of products that differ by less than their rounding, too, which decides between two neighbours."""
    count = 1 << 14
    a, b = np.random.default_rng(6).uniform(1, 2, (2, count)).astype(np.float32)
    c, d = np.nextafter(a, np.float32(3)), np.nextafter(b, np.float32(0))
    c[::3], d[::3] = b[::3], a[::3]
    signs = np.sign(a.astype(np.float64) * b - c.astype(np.float64) * d)
    rounded = np.sign(a * b - c * d)
    assert np.mean(rounded != signs) > 0.1 and (signs == 0).any()
    defines = {"CHILDREN": "16u", "BOX_LEVELS": "1u", "COUNT": count}
    kernel = bare_kernel(device, ("common", "trace"), defines, DIFFERENCES, "differences")
    result = HostArray(device, count, np.float32)
    numbers = HostArray.of(device, np.array([a, b, c, d]))
    kernel(count // device.vector_width, numbers=numbers, result=result)
    np.testing.assert_array_equal(np.sign(result.read()), signs)


def closed_shapes():
    """Closed meshes about the origin: flat faces with common edges along the axes, and round ones."""
    box = trimesh.creation.box((2, 2, 2))
    for _ in range(3):
        box = box.subdivide()
    turned = box.copy()
    turned.apply_transform(trimesh.transformations.rotation_matrix(0.7, [1, 2, 3]))
    return {"box": box, "turned box": turned, "sphere": trimesh.creation.icosphere(subdivisions=4)}


@pytest.mark.parametrize("shape", list(closed_shapes()))
@pytest.mark.parametrize(("scale", "place"), [(1.0, 0.0), (1e-3, 0.0), (1e3, 0.0), (1.0, 50.0)])
def test_no_ray_leaves_a_closed_mesh(device, shape, scale, place):
    """Aimed at corners and at points of edges, from within and from the middle itself."""
    mesh = closed_shapes()[shape]
    corners = (mesh.triangles * scale + place).astype(np.float32)
    scene = mesh_scene(corners, CAMERA, (), (grey(),))
    generator = np.random.default_rng(4)
    along = generator.uniform(0, 1, (8, len(corners), 3, 1))
    along[:2], along[2] = 0, 0.5
    targets = corners + along * (np.roll(corners, 1, axis=1).astype(float) - corners)
    targets = targets.reshape(-1, 3).astype(np.float32)
    origin = generator.uniform(-0.4, 0.4, targets.shape) * scale + place
    origin[::3] = place
    origin = origin.astype(np.float32)
    direction = targets - origin
    far = np.full(len(origin), np.inf)
    triangle, _, _, distance, blocked = traced(device, scene, origin, direction, far)
    assert (triangle >= 0).all() and blocked.all()
    np.testing.assert_allclose(distance, 1, rtol=1e-3)


def test_no_ray_passes_a_closed_mesh_from_far_away(device):
    """The mesh is far smaller than what coordinates are rounded to, seen from there."""
    mesh = trimesh.creation.icosphere(subdivisions=4)
    scene = mesh_scene(mesh.triangles.astype(np.float32), CAMERA, (), (grey(),))
    generator = np.random.default_rng(5)
    # Through corners of the mesh that are well inside its outline.
    away = unit(generator.normal(size=(20_000, 3)))
    target = mesh.vertices[generator.integers(0, len(mesh.vertices), len(away))]
    kept = np.sum(away * target, 1) > 0.3
    origin = (1000 * away[kept]).astype(np.float32)
    direction = (target[kept] - origin).astype(np.float32)
    triangle, _, _, _, blocked = traced(device, scene, origin, direction, np.full(len(origin), np.inf))
    assert (triangle >= 0).all() and blocked.all()


@pytest.mark.parametrize("shape", list(convex_shapes()))
@pytest.mark.parametrize(("scale", "offset"), [(1e-3, 0), (1e-3, 1), (1, 100), (1, 1e4), (1e4, 1e4)])
def test_no_ray_hits_the_convex_surface_it_leaves(device, shape, scale, offset):
    """In the tangent plane up to rounding, each way round, from where samples start."""
    triangles, normals = convex_shapes()[shape]
    shift = offset * np.array([1.0, -0.3, 0.7])
    camera = camera_at(np.array([0.4, 0.7, 4]) * scale + shift, shift, 30)
    scene = mesh_scene(triangles * scale + shift, camera, normals=normals)
    points = find_points(device, scene, Tracer(scene, 1), 23, 17, 1, True)
    normal = np.repeat(points.rows("geometric_normal").T.astype(float), 16, axis=0)
    start = points.rows("position") + points.rows("offset") * points.rows("geometric_normal")
    tangent = np.cross(normal, np.random.default_rng(3).normal(size=normal.shape))
    tangent = unit(tangent + 1e-7 * normal)
    far = np.full(len(tangent), np.inf)
    origin = np.repeat(start.T, 16, axis=0)
    triangle, *_, blocked = traced(device, scene, origin, tangent, far)
    assert (triangle == -1).all() and not blocked.any()


def test_all_widths_give_the_same_bits(one_device, scenes):
    scene = load_scene(scenes / "knot.toml")
    origin, direction = scene_rays(one_device, scene, 20_000)
    widths = [width for width in (1, 4, 8, 16) if width <= one_device.vector_width]
    assert len(widths) > 1 or not one_device.is_cpu
    found = [
        traced(open_device(one_device.cl_device, one_device.index, vector_width=width), scene, origin,
               direction)
        for width in widths
    ]  # fmt: skip
    for other in found[1:]:
        for ours, theirs in zip(found[0], other, strict=True):
            np.testing.assert_array_equal(ours, theirs)


def test_a_walk_goes_on_in_a_second_word(device, scenes, monkeypatch):
    """As with more than 16 million triangles: of words of one level, three levels need two."""
    scene = load_scene(scenes / "knot.toml")
    origin, direction = scene_rays(device, scene, 20_000)
    hierarchy = Hierarchy(device, scene)
    assert hierarchy.levels.shape == (3,)
    usual = traced(device, scene, origin, direction, hierarchy=hierarchy)

    def with_short_words(files):
        text = source(files)
        for usual, short in (("WORD_BITS 64", "WORD_BITS 16"), ("ulong word", "ushort word")):
            assert usual in text
            text = text.replace(usual, short)
        return text

    monkeypatch.setattr("reference.source", with_short_words)
    for ours, theirs in zip(
        traced(device, scene, origin, direction, hierarchy=hierarchy), usual, strict=True
    ):
        np.testing.assert_array_equal(ours, theirs)
