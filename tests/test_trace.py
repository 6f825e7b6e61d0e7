"""Embree against brute force, chunking, and rays that must not hit the surface they leave."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from reference import camera_at, intersect, mesh_scene, quad, sampling, unit

from ncv_cl.integrands import AmbientOcclusion
from ncv_cl.points.trace import Hits, Tracer

HERE = camera_at([0, 0, 5], [0, 0, 0])
SLACK = 1e-4


def random_case(rays: int, seed: int = 1):
    generator = np.random.default_rng(seed)
    triangles = generator.uniform(-1, 1, (50, 1, 3)) + generator.normal(0, 0.3, (50, 3, 3))
    origins = generator.uniform(-2, 2, (rays, 3)).astype(np.float32)
    # Directions need no unit length.
    directions = generator.normal(size=(rays, 3)) * generator.uniform(0.1, 10, (rays, 1))
    return mesh_scene(triangles, HERE), origins, directions.astype(np.float32)


@pytest.mark.parametrize(("rays", "threads"), [(0, 1), (1, 2), (999, 3), (1000, 2), (10007, 3)])
def test_closest_hits_and_visibility_match_brute_force(monkeypatch, rays, threads):
    monkeypatch.setattr("ncv_cl.points.trace.CHUNK", 1000)
    scene, origins, directions = random_case(rays)
    tracer = Tracer(scene, threads)
    triangle, u, v, distance = intersect(scene, origins, directions)
    sure = np.ones(rays, bool)
    for slack in (SLACK, -SLACK):
        sure &= intersect(scene, origins, directions, slack)[0] == triangle
    assert sure.sum() >= 0.98 * rays

    hits = tracer.closest(origins, directions)
    assert len(hits.triangle) == len(hits.u) == len(hits.v) == rays
    np.testing.assert_array_equal(hits.triangle[sure], triangle[sure])
    hit = sure & (triangle >= 0)
    np.testing.assert_allclose(hits.u[hit], u[hit], atol=SLACK)
    np.testing.assert_allclose(hits.v[hit], v[hit], atol=SLACK)

    limits = np.random.default_rng(2).uniform(0, 2, rays).astype(np.float32)
    limits[::7] = np.inf
    answers = np.full(rays, 99, np.uint8)
    tracer.visible(origins, directions, limits, answers)
    sure &= (distance < 0.9999 * limits) | ~(distance < 1.0001 * limits)
    np.testing.assert_array_equal(answers[sure], ~(distance < limits)[sure])
    assert set(answers) <= {0, 1}


def test_chunks_and_threads_change_nothing(monkeypatch):
    scene, origins, directions = random_case(70001)
    whole = Tracer(scene, 1).closest(origins, directions)
    monkeypatch.setattr("ncv_cl.points.trace.CHUNK", 777)
    parts = Tracer(scene, 4).closest(origins, directions)
    for name in ("triangle", "u", "v"):
        np.testing.assert_array_equal(getattr(whole, name), getattr(parts, name))


def test_both_kinds_at_once_are_each_alone(monkeypatch):
    monkeypatch.setattr("ncv_cl.points.trace.SMALLEST_CHUNK", 300)
    scene, origins, directions = random_case(5003)
    tracer = Tracer(scene, 3)
    # Planes, as wavefronts have them, instead of rows.
    planes = np.ascontiguousarray(np.concatenate([origins, directions], axis=1).T)
    kinds = (np.int32, np.float32, np.float32, np.float32)
    hits, answers = Hits(*(np.empty(5003, kind) for kind in kinds)), np.full(2001, 99, np.uint8)
    shadows = planes[:3, :2001].T, planes[3:, :2001].T
    tracer.closest_and_visible(planes[:3].T, planes[3:].T, hits, *shadows, answers)
    alone = tracer.closest(origins, directions)
    for name in ("triangle", "u", "v", "distance"):
        np.testing.assert_array_equal(getattr(hits, name), getattr(alone, name))
    expected = np.zeros(2001, np.uint8)
    tracer.visible(origins[:2001], directions[:2001], np.ones(2001, np.float32), expected)
    np.testing.assert_array_equal(answers, expected)


def convex_shapes() -> dict[str, tuple[np.ndarray, np.ndarray | None]]:
    """Triangles and vertex normals of surfaces whose outside no ray from them can hit."""
    tilted = unit([1, 2, -0.5]), unit([2, -1, 0])
    box, sphere = trimesh.creation.box(), trimesh.creation.icosphere(subdivisions=2)
    turn = trimesh.transformations.rotation_matrix(0.7, [1, 2, 3])
    box.apply_transform(turn)
    return {
        "plane": (quad([-1, -1, 0], [2, 0, 0], [0, 2, 0]), None),
        "large tilted quad": (quad(-50 * (tilted[0] + tilted[1]), *(100 * t for t in tilted)), None),
        "box": (box.triangles, None),
        "smooth sphere": (np.array(sphere.triangles), np.array(sphere.vertices[sphere.faces])),
    }


@pytest.mark.parametrize("shape", list(convex_shapes()))
@pytest.mark.parametrize(
    ("scale", "offset"), [(1e-3, 0), (1e-3, 1), (1, 0), (1, 100), (1, 1e4), (1e4, 0), (1e4, 1e4)]
)
def test_no_ray_hits_the_convex_surface_it_leaves(device, shape, scale, offset):
    triangles, normals = convex_shapes()[shape]
    shift = offset * np.array([1.0, -0.3, 0.7])
    camera = camera_at(np.array([0.4, 0.7, 4]) * scale + shift, shift, 30)
    scene = mesh_scene(triangles * scale + shift, camera, normals=normals)
    points, source, rays = sampling(device, scene, AmbientOcclusion(), (23, 17), 64)
    assert points.active > 50
    source.draw(range(points.active), range(64), 0)
    assert len(rays.answers) > 0.9 * 64 * points.active
    assert rays.answers.all()

    # Flatter than any sample: in the tangent plane up to rounding, each way round.
    origins = (points.rows("position") + points.rows("offset") * points.rows("geometric_normal")).T
    generator = np.random.default_rng(3)
    origins = np.repeat(origins, 16, axis=0)
    normal = np.repeat(points.rows("geometric_normal").T.astype(float), 16, axis=0)
    tangents = unit(np.cross(normal, generator.normal(size=normal.shape)) + 1e-7 * normal)
    answers = np.zeros(len(origins), np.uint8)
    rays.tracer.visible(
        origins, tangents.astype(np.float32), np.full(len(origins), np.inf, np.float32), answers
    )
    assert answers.all()


@pytest.mark.parametrize(("scale", "offset"), [(1, 0), (1e-3, 0), (1e4, 0), (1, 5)])
def test_a_thin_gap_still_occludes(device, scale, offset):
    gap = 1e-4
    floor = quad([-1, -1, 0], [2, 0, 0], [0, 2, 0])
    plate = quad([-0.5, -0.5, gap], [1, 0, 0], [0, 1, 0])
    shift = offset * np.array([1.0, 1.0, 0.0])
    # The camera is inside the gap and sees the middle of the floor.
    camera = camera_at(np.array([0, 0, gap / 2]) * scale + shift, shift, 60, up=[0, 1, 0])
    scene = mesh_scene(np.concatenate([floor, plate]) * scale + shift, camera)
    points, source, rays = sampling(device, scene, AmbientOcclusion(), (5, 3), 1024)
    assert np.abs(points.rows("position")[2]).max() <= 1e-7 * scale
    source.draw(range(points.active), range(1024), 0)
    rising = unit(rays.directions)[:, 2]
    # Only what leaves through the gap's sides, flatter than gap over half the plate, escapes.
    assert len(rising) >= 15 * 1023
    assert not rays.answers[rising > 3 * gap].any()
