"""Shadow rays of scenes of few triangles: the answers of every triangle, tested in double precision."""

from __future__ import annotations

import numpy as np
import pytest
from reference import (
    bare_kernel,
    camera_at,
    grey,
    intersect,
    light_at,
    mesh_scene,
    quad,
    sampling,
    shadowed_values,
)

from ncv_cl.integrands import GlobalIllumination
from ncv_cl.opencl.memory import HostArray
from ncv_cl.points.points import surface_defines
from ncv_cl.scene.load import load_scene
from ncv_cl.visibility.shadow import shadow_casters, shadow_defines
from ncv_cl.visibility.tuning import MOST_CASTERS

KERNEL = """
kernel void reaches(const uint count, global const float *casters, global const float *rays,
                    global int *result) {
  const uint first = (uint)get_global_id(0) * VEC;
  if (first >= count) return;
  const triple origin = {LOAD(rays + first), LOAD(rays + count + first), LOAD(rays + 2 * count + first)};
  const triple segment = {LOAD(rays + 3 * count + first), LOAD(rays + 4 * count + first),
                          LOAD(rays + 5 * count + first)};
  const whole open = LOAD(rays + first) < 1e30f;
  STORE(SELECT((whole)0, (whole)1, reaches_light(casters, origin, segment, open)), result + first);
}
"""
CAMERA = camera_at([0, 1, 6], [0, 0, 0], 45)
LIGHT = light_at([-0.5, 1.9, -0.5], [1, 0, 0], [0, 0, 1], (5, 4, 3))


def soup(count, place=0.0, scale=1.0, seed=3):
    """Triangles of any shape in a cube, beside a light's two."""
    generator = np.random.default_rng(seed)
    centres = generator.uniform(-1, 1, (count, 1, 3))
    triangles = scale * (centres + 0.5 * generator.normal(size=(count, 3, 3))) + place
    lamp = light_at(scale * LIGHT.corner + place, scale * LIGHT.edge1, scale * LIGHT.edge2, 1)
    return mesh_scene(triangles, CAMERA, (lamp,), (grey(),))


def reaches(device, scene, origin, segment):
    """What the kernel says of rays (n, 3), n a multiple of 16."""
    defines = {**shadow_defines(len(scene.triangles)), **surface_defines()}
    kernel = bare_kernel(device, ("common", "surface", "shadow"), defines, KERNEL, "reaches")
    rays = HostArray.of(device, np.concatenate([origin.T, segment.T]).astype(np.float32))
    result = HostArray(device, len(origin), np.int32)
    kernel(
        -(-len(origin) // device.vector_width),
        count=len(origin),
        casters=HostArray.of(device, shadow_casters(scene)),
        rays=rays,
        result=result,
    )
    return result.read().astype(bool)


def rays_in(scene, count, seed=5):
    """Segments between points of the scene's box."""
    lower, upper = (np.asarray(bound, float) for bound in scene.bounds)
    ends = np.random.default_rng(seed).uniform(lower, upper, (2, count, 3)).astype(np.float32)
    return ends[0], (ends[1].astype(float) - ends[0]).astype(np.float32)


@pytest.mark.parametrize(("place", "scale"), [(0.0, 1.0), (1e4, 1.0), (0.0, 1e-3), (-300.0, 1e3)])
@pytest.mark.parametrize("count", [1, 20, MOST_CASTERS - 2])
def test_rays_are_answered_as_in_double_precision(device, count, place, scale):
    scene = soup(count, place, scale)
    origin, segment = rays_in(scene, 4096)
    answers = []
    # A ray that passes an edge by less than rounding may go either way.
    for slack in (-1e-4, 1e-4):
        _, _, _, distance = intersect(scene, origin, segment, slack)
        answers.append(distance > 1)
    near_ends = np.zeros(len(origin), bool)
    for factor in (1 - 1e-4, 1 + 1e-4):
        near_ends |= (intersect(scene, origin, segment * factor)[3] > 1) != answers[0]
    sure = (answers[0] == answers[1]) & ~near_ends
    assert sure.mean() > 0.95 and 0.02 < answers[0][sure].mean() < 0.99
    np.testing.assert_array_equal(reaches(device, scene, origin, segment)[sure], answers[0][sure])


def test_no_ray_slips_through_common_edges(device):
    """From the inner side of two faces to the outer, through points of their triangles' edges."""
    generator = np.random.default_rng(2)
    steps = generator.dirichlet(np.ones(3), 3)[:, :2].cumsum(axis=1)
    grid = [np.array([0, *row, 1]) * 2.2 - 1.1 for row in steps]
    cells = [(a, b) for a in range(3) for b in range(3)]
    faces = []
    for axis in (0, 1):
        others = [k for k in range(3) if k != axis]
        corner, edge1, edge2 = (np.zeros((9, 3)) for _ in range(3))
        for row, (a, b) in enumerate(cells):
            corner[row, others] = grid[others[0]][a], grid[others[1]][b]
            edge1[row, others[0]] = grid[others[0]][a + 1] - grid[others[0]][a]
            edge2[row, others[1]] = grid[others[1]][b + 1] - grid[others[1]][b]
        corner[:, axis] = 1.1
        faces += [quad(*one) for one in zip(corner, edge1, edge2, strict=True)]
    # Corners that neighbours share have to be the same numbers.
    sheet = np.concatenate(faces).astype(np.float32)
    scene = mesh_scene(sheet, CAMERA, (LIGHT,), (grey(),))
    along = generator.uniform(0.01, 0.99, (64, len(sheet), 3, 1))
    targets = (sheet + along * (np.roll(sheet, 1, axis=1) - sheet)).reshape(-1, 3).astype(np.float32)
    # The faces' rims are open.
    targets = targets[(np.abs(targets) < 1.0).sum(axis=1) >= 2]
    targets = targets[: len(targets) // 16 * 16]
    origin = generator.uniform(-0.9, 0.9, targets.shape).astype(np.float32)
    assert not reaches(device, scene, origin, 2 * (targets - origin)).any()


def test_paths_are_the_same_whoever_answers(device, scenes):
    """Values with shadow rays traced and tested; and a scene of many triangles traces them all."""
    for scene, tested in ((load_scene(scenes / "cornell_box.toml"), True), (soup(MOST_CASTERS), False)):
        found = []
        for shadows_tested in (False, True):
            points, source, _ = sampling(
                device, scene, GlobalIllumination(), (6, 5), 64, shadows_tested=shadows_tested
            )
            batch = source.draw(range(points.active), range(64), 0)
            found.append(shadowed_values(batch, 3))
            assert (source.rays.on_device > 0) == (shadows_tested and tested)
            rays = source.rays.traced + source.rays.on_device
        assert np.mean(~np.isclose(*found, rtol=1e-5, atol=1e-7)) < 1e-4
        assert rays > 0
