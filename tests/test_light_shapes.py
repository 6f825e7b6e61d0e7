"""Triangles, discs and balls as lights: densities, and irradiance by closed forms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from reference import bare_kernel, camera_at, grey, intersect, mesh_scene, polygon_irradiance, quad, unit
from scipy import integrate as quadrature
from test_lights import KERNEL, Found, grid

import ncv_cl as ncv
from ncv_cl.integrands.light_sources import light_sources
from ncv_cl.integrands.lights import LIGHT_FILES, light_defines, light_records
from ncv_cl.opencl.memory import HostArray
from ncv_cl.points.points import surface_defines

CAMERA = camera_at([0, 3, 4], [0, 0, 0])
FLOOR = quad([-2, 0, -2], [0, 0, 4], [4, 0, 0])
BLOCKER = quad([-0.4, 0.3, -0.4], [0.9, 0, 0], [0, 0.1, 0.7])
UP = np.array([0.0, 1.0, 0.0])
TRIANGLE = np.array([[-1, 2, -1], [1.5, 2.4, -0.5], [0.2, 1.8, 1.7]])
DISC = ncv.DiscLight((0.2, 1, 0.3), (0, -1, 0), 0.5, 2.0)
SLANTED = ncv.DiscLight((0.2, 1.5, 0.3), (0.4, -1, 0.3), 0.9, 2.0)
SPHERE = ncv.SphereLight((0.2, 1, 0.3), 0.5, 2.0)
PLACES = np.array([[x, 0.0, z] for x in (-1.0, -0.3, 0.5, 1.2) for z in (-1.0, 0.1, 0.9)])


def glow(emission: float, albedo: float = 0.0, **options: object) -> ncv.Material:
    found = grey(albedo, **options)
    return replace(found, emission=np.full(3, emission, np.float32), name="glow")


def lit_by(triangles: np.ndarray, *, material: ncv.Material | None = None, blocked: bool = False):
    """A floor, maybe a blocker, and triangles that emit, float (n, 3, 3)."""
    dull = np.concatenate([FLOOR, BLOCKER]) if blocked else FLOOR
    bright = np.reshape(triangles, (-1, 3, 3))
    of = np.repeat([0, 1], [len(dull), len(bright)])
    every = np.concatenate([dull, bright])
    return mesh_scene(every, CAMERA, (), (grey(0.5), material or glow(2.0)), material=of)


def scene_of(
    *lights: object,
    blocked: bool = False,
    surface: ncv.Material | None = None,
    bright: np.ndarray | None = None,
) -> ncv.Scene:
    """A floor under lights, maybe with a blocker, and a triangle that emits."""
    dull = np.concatenate([FLOOR, BLOCKER]) if blocked else FLOOR
    corners = [pair[[0, 0, 0, 1], [0, 1, 2, 2]] for pair in dull.reshape(-1, 2, 3, 3)]
    meshes = [ncv.TriangleMesh(four, np.array([[0, 1, 2], [0, 2, 3]]), "floor") for four in corners]
    materials = {"floor": surface or ncv.Material(0.5)}
    if bright is not None:
        materials["glow"] = ncv.Material(0.0, emission=2.0)
        meshes.append(ncv.TriangleMesh(bright, np.array([[0, 1, 2]]), "glow"))
    return ncv.build_scene(CAMERA, materials, meshes, lights)


def sampled(device, scene, position: np.ndarray, u: np.ndarray, v: np.ndarray) -> Found:
    files = ("common", "surface", *LIGHT_FILES)
    kernel = bare_kernel(device, files, {**surface_defines(), **light_defines(scene)}, KERNEL, "samples")
    rows = np.concatenate([np.repeat(position[:, None], len(u), axis=1), [u, v]])
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


def triangle_angle(corners: np.ndarray, position: np.ndarray) -> float:
    """Solid angle by Van Oosterom and Strackee (1983)."""
    a, b, c = corners - position
    la, lb, lc = (np.linalg.norm(x) for x in (a, b, c))
    below = la * lb * lc + (a @ b) * lc + (a @ c) * lb + (b @ c) * la
    return 2 * np.arctan2(abs(a @ np.cross(b, c)), below)


def disc_angle(light: ncv.DiscLight, position: np.ndarray) -> float:
    normal = unit(light.normal)
    x, y = unit(np.cross(normal, [0.3, 0.1, 0.9])), None
    y = np.cross(normal, x)

    def around(angle: float, radius: float) -> float:
        to = light.centre + radius * (np.cos(angle) * x + np.sin(angle) * y) - position
        return radius * abs(to @ normal) / np.linalg.norm(to) ** 3

    return quadrature.dblquad(around, 0, light.radius, 0, 2 * np.pi, epsabs=1e-7)[0]


def ball_angle(light: ncv.SphereLight, position: np.ndarray) -> float:
    sine = light.radius / np.linalg.norm(light.centre - position)
    return 2 * np.pi * (1 - np.sqrt(1 - sine**2))


FAR, NEAR, LOW = (9.0, 0.5, 7.0), (0.2, 0.1, 0.4), (1.9, 1.6, -0.6)
# Scene, what is seen of the light by a closed form, and from where.
SEEN = {
    "triangle, far": (lit_by(TRIANGLE), lambda p: triangle_angle(TRIANGLE, p), FAR),
    "triangle, near": (lit_by(TRIANGLE), lambda p: triangle_angle(TRIANGLE, p), NEAR),
    "triangle, beside": (lit_by(TRIANGLE), lambda p: triangle_angle(TRIANGLE, p), LOW),
    "disc, far": (scene_of(SLANTED), lambda p: disc_angle(SLANTED, p), (5.0, -6.0, 3.0)),
    "disc, near": (scene_of(SLANTED), lambda p: disc_angle(SLANTED, p), NEAR),
    "ball, far": (scene_of(SPHERE), lambda p: ball_angle(SPHERE, p), FAR),
    "ball, near": (scene_of(SPHERE), lambda p: ball_angle(SPHERE, p), (0.2, 0.45, 0.35)),
}


@pytest.mark.parametrize("name", SEEN)
def test_samples_stand_for_the_solid_angle_around_them(device, name):
    scene, angle, place = SEEN[name]
    position = np.array(place, np.float32).astype(float)
    u, v = grid(128)
    found = sampled(device, scene, position, u, v)
    assert found.lit.all()
    # A rule of middles of what all samples together stand for.
    np.testing.assert_allclose((1 / found.density).mean(), angle(position), rtol=1e-3)
    np.testing.assert_allclose(found.radiance, 2 / found.density, rtol=1e-5)
    # What a ray that finds the light weighs it by; where it is found is rounded.
    clear = (u > 0.02) & (u < 0.98) & (v > 0.02) & (v < 0.98)
    np.testing.assert_allclose(found.again[clear], found.density[clear], rtol=5e-3)
    # Directions of neighbours span what the density says.
    step = 1 / 256
    inner = (u > 0.1) & (u < 0.9) & (v > 0.1) & (v < 0.9)
    ends = [
        sampled(device, scene, position, u + du, v + dv).ends[inner] - position
        for du, dv in ((step, 0), (-step, 0), (0, step), (0, -step))
    ]
    east, west, north, south = (unit(end) for end in ends)
    spanned = np.linalg.norm(np.cross(east - west, north - south), axis=1) / (2 * step) ** 2
    np.testing.assert_allclose(spanned, 1 / found.density[inner], rtol=0.03)
    assert abs(np.mean(spanned * found.density[inner]) - 1) < 2e-3


def test_clusters_of_many_triangles_have_a_density(device):
    """All samples together stand for what all triangles are seen as, and each is expected as often."""
    generator = np.random.default_rng(4)
    middle = generator.uniform(-1, 1, (700, 1, 3)) + np.array([0, 2, 0])
    triangles = middle + generator.normal(0, 0.1, (700, 3, 3))
    scene = lit_by(triangles)
    sources = light_sources(scene)
    assert sources.lights.has_clusters and sources.lights.strips <= 64
    position = np.array([0.25, -1.5, 0.5])
    exact = sum(
        triangle_angle(one, position) for one in scene.vertices[scene.triangles[2:]].astype(float)
    )
    u, v = np.random.default_rng(5).random((2, 1 << 17), np.float32).astype(float)
    stands_for = 1 / sampled(device, scene, position, u, v).density
    error = stands_for.std() / np.sqrt(len(u))
    assert error < 0.01 * exact and abs(stands_for.mean() - exact) < 4 * error


def polygon_angles(triangles: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Irradiance of triangles that emit 2 wherever their fronts face a place, (places,)."""
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    found = []
    for place in places:
        facing = ((place - triangles[:, 0]) * normals).sum(axis=1) > 0
        found.append(2 * sum(polygon_irradiance(one, place, UP) for one in triangles[facing]))
    return np.array(found)


def test_a_triangle_gives_lamberts_formula_by_lines(one_device):
    scene = lit_by(TRIANGLE)
    options = {"spp": 4096, "visibility": "lines", "seed": 3, "device": one_device}
    found = ncv.irradiance(scene, PLACES, np.tile(UP, (len(PLACES), 1)), **options)
    wanted = [2 * polygon_irradiance(TRIANGLE, place, UP) for place in PLACES]
    np.testing.assert_allclose(found.values[:, 0], wanted, rtol=1e-4)


def round_irradiance(light: object) -> np.ndarray:
    """Of a sphere, a point, a spot or a disc that faces the floor, above all horizons, (places,)."""
    to = np.asarray(getattr(light, "centre", getattr(light, "position", None))) - PLACES
    away = np.linalg.norm(to, axis=1)
    cosine = to[:, 1] / away
    if isinstance(light, ncv.SphereLight):
        return np.pi * light.radiance * light.radius**2 / away**2 * cosine
    if isinstance(light, ncv.DiscLight):
        aside2, height2, radius2 = to[:, 0] ** 2 + to[:, 2] ** 2, to[:, 1] ** 2, light.radius**2
        root = np.sqrt((height2 + aside2 + radius2) ** 2 - 4 * radius2 * aside2)
        return np.pi * light.radiance / 2 * (1 - (height2 + aside2 - radius2) / root)
    if isinstance(light, ncv.PointLight):
        return light.intensity / away**2 * cosine
    angle = np.degrees(np.arccos(-(to @ unit(light.direction)) / away))
    inner = 0.75 * light.outer_angle if light.inner_angle is None else light.inner_angle
    beam = np.clip((light.outer_angle - angle) / (light.outer_angle - inner), 0, 1)
    return light.intensity / away**2 * cosine * beam


ROUND = {
    "disc": DISC,
    "sphere": SPHERE,
    "point": ncv.PointLight((0.2, 1, 0.3), 3.0),
    "spot": ncv.SpotLight((0.2, 1, 0.3), 3.0, direction=(0.2, -1, 0), outer_angle=50, inner_angle=20),
    "narrow spot": ncv.SpotLight((0.2, 1, 0.3), 3.0, direction=(0.3, -2, -0.2), outer_angle=35),
}


@pytest.mark.parametrize("name", ROUND)
def test_round_lights_give_their_closed_forms(one_device, name):
    up = np.tile(UP, (len(PLACES), 1))
    found = ncv.irradiance(scene_of(ROUND[name]), PLACES, up, spp=1024, seed=1, device=one_device)
    wanted = round_irradiance(ROUND[name])
    assert wanted.max() > 0.1
    np.testing.assert_allclose(found.values[:, 0], wanted, rtol=1e-4, atol=1e-6)


def test_a_sphere_casts_the_shadows_of_a_sphere(one_device):
    """Behind a blocker: over a cone of directions, of which some are blocked."""
    scene = scene_of(SPHERE, blocked=True)
    up = np.tile(UP, (len(PLACES), 1))
    found = ncv.irradiance(scene, PLACES, up, spp=4096, seed=1, device=one_device)
    dull = mesh_scene(np.concatenate([FLOOR, BLOCKER]), CAMERA)
    u, v = grid(128)
    wanted = []
    for place in PLACES:
        axis = unit(SPHERE.centre - place)
        x = unit(np.cross(axis, [0.0, 0.0, 1.0]))
        sine = SPHERE.radius / np.linalg.norm(SPHERE.centre - place)
        cosine = 1 - v * (1 - np.sqrt(1 - sine**2))
        aside = np.sqrt(1 - cosine**2)[:, None]
        turn = 2 * np.pi * u[:, None]
        to = aside * (np.cos(turn) * x + np.sin(turn) * np.cross(axis, x)) + cosine[:, None] * axis
        free = intersect(dull, place + 1e-6 * to + [0, 1e-6, 0], to)[0] < 0
        wanted.append(2 * ball_angle(SPHERE, place) * np.mean(free * to[:, 1]))
    unblocked = round_irradiance(SPHERE)
    assert (
        np.sum(np.array(wanted) < 0.9 * unblocked) >= 3 and np.ptp(found.values[:, 0] / unblocked) > 0.3
    )
    np.testing.assert_allclose(found.values[:, 0], wanted, atol=4e-3 * unblocked.max())
