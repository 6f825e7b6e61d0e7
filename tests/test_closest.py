"""What rays of scenes of few triangles hit first: the answers of every triangle, in double precision."""

from __future__ import annotations

import numpy as np
import pytest
from reference import bare_kernel, grey, intersect, mesh_scene, quad
from test_shadow import CAMERA, rays_in, soup

from ncv_cl.opencl.memory import HostArray
from ncv_cl.points.points import surface_defines
from ncv_cl.visibility.shadow import shadow_casters, shadow_defines
from ncv_cl.visibility.tuning import MOST_CASTERS

KERNEL = """
kernel void closest(const uint count, global const float *casters, global const float *rays,
                    global float *result) {
  const uint first = (uint)get_global_id(0) * VEC;
  if (first >= count) return;
  const triple origin = {LOAD(rays + first), LOAD(rays + count + first), LOAD(rays + 2 * count + first)};
  const triple direction = {LOAD(rays + 3 * count + first), LOAD(rays + 4 * count + first),
                            LOAD(rays + 5 * count + first)};
  const Hit hit = closest_hit(casters, origin, direction, origin.x < 1e30f);
  STORE(TO_REAL(hit.triangle), result + first);
  STORE(hit.u, result + count + first);
  STORE(hit.v, result + 2 * count + first);
  STORE(hit.distance, result + 3 * count + first);
}
"""


def closest(device, scene, origin, direction):
    """Triangles, u, v and distances of rays (n, 3), n a multiple of 16."""
    defines = {**shadow_defines(len(scene.triangles)), **surface_defines()}
    kernel = bare_kernel(device, ("common", "surface", "shadow", "closest"), defines, KERNEL, "closest")
    count = len(origin)
    result = HostArray(device, (4, count), np.float32)
    kernel(
        count // device.vector_width,
        count=count,
        casters=HostArray.of(device, shadow_casters(scene)),
        rays=HostArray.of(device, np.concatenate([origin.T, direction.T]).astype(np.float32)),
        result=result,
    )
    triangle, u, v, distance = result.read()
    return triangle.astype(int), u, v, distance


@pytest.mark.parametrize(("place", "scale"), [(0.0, 1.0), (1e4, 1.0), (0.0, 1e-3), (-300.0, 1e3)])
@pytest.mark.parametrize("count", [1, 20, MOST_CASTERS - 2])
def test_hits_are_those_of_double_precision(device, count, place, scale):
    scene = soup(count, place, scale)
    origin, direction = rays_in(scene, 4096)
    # A ray that passes an edge by less than rounding may go either way.
    smaller, larger = (intersect(scene, origin, direction, slack) for slack in (-1e-4, 1e-4))
    exact = intersect(scene, origin, direction)
    # What is hit nearly at once lies before a rounded origin or behind it.
    near = np.minimum(smaller[3], larger[3]) < 1e-4
    sure = (smaller[0] == larger[0]) & ~near
    met = sure & (exact[0] >= 0)
    assert sure.mean() > 0.95 and met.any() and (exact[0][sure] < 0).any()
    triangle, u, v, distance = closest(device, scene, origin, direction)
    np.testing.assert_array_equal(triangle[sure], exact[0][sure])
    # Rays that graze a triangle lose digits, as their distance does.
    for found, true in ((u, exact[1]), (v, exact[2]), (distance, exact[3])):
        error = np.abs(found - true)[met]
        assert np.median(error) < 1e-5 and np.mean(error > 1e-3) < 5e-3


def test_of_two_triangles_the_nearer_is_hit_from_either_side(device):
    sheets = [quad([-1, -1, z], [2, 0, 0], [0, 2, 0]) for z in (0.0, 1.0)]
    scene = mesh_scene(np.concatenate(sheets), CAMERA, (), (grey(),))
    side = np.repeat([2.5, -1.5], 8)
    origin = np.stack([np.linspace(-0.9, 0.8, 16), np.full(16, 0.3), side], 1).astype(np.float32)
    direction = np.array([[0, 0, -2.0]]).repeat(16, 0).astype(np.float32)
    direction[8:] *= -1
    triangle, _, _, distance = closest(device, scene, origin, direction)
    np.testing.assert_array_equal(triangle >= 2, side > 0)
    np.testing.assert_allclose(distance, 0.75)
    # Away from both, and along them.
    for other in (-direction, direction[:, [2, 1, 0]]):
        assert (closest(device, scene, origin, other)[0] == -1).all()


def test_rays_that_are_not_asked_for_hit_nothing(device):
    scene = soup(20)
    origin, direction = rays_in(scene, 16)
    origin[::2] = 2e30
    assert (closest(device, scene, origin, direction)[0][::2] == -1).all()


def test_no_ray_leaves_a_closed_box(device):
    """Through points of all edges of its triangles, and corners."""
    sides = []
    for axis in range(3):
        edges = np.delete(2 * np.eye(3), axis, 0)
        for corner in (-np.ones(3), -np.ones(3) + 2 * np.eye(3)[axis]):
            sides.append(quad(corner, *edges))
    sheet = np.concatenate(sides).astype(np.float32)
    scene = mesh_scene(sheet, CAMERA, (), (grey(),))
    generator = np.random.default_rng(4)
    along = generator.uniform(0, 1, (64, len(sheet), 3, 1))
    along[:8] = 0
    targets = (sheet + along * (np.roll(sheet, 1, axis=1) - sheet)).reshape(-1, 3).astype(np.float32)
    origin = generator.uniform(-0.9, 0.9, targets.shape).astype(np.float32)
    triangle, _, _, distance = closest(device, scene, origin, (targets - origin).astype(np.float32))
    assert (triangle >= 0).all()
    np.testing.assert_allclose(distance, 1, rtol=1e-4)
