"""Surfaces that emit, and lights of all kinds: pictures by every way of sampling, and files."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from reference import camera_at, grey, light_at, mesh_scene, polygon_irradiance, quad
from test_light_shapes import BLOCKER, DISC, FLOOR, SPHERE, TRIANGLE, UP, glow, lit_by, scene_of

import ncv_cl as ncv
from ncv_cl import GlobalIllumination, render
from ncv_cl.integrands.light_sources import PARALLELOGRAM, light_sources
from ncv_cl.integrands.light_sources import TRIANGLE as IS_TRIANGLE

SPOT = ncv.SpotLight((-0.6, 1.2, -0.2), 2.0, direction=(0.5, -1, 0.3), outer_angle=40, radius=0.05)


def z_scores(first: ncv.Image, second: ncv.Image) -> np.ndarray:
    variance = first.variance + second.variance
    return ((first.pixels - second.pixels) / np.sqrt(variance + 1e-12))[..., 0]


def agree(first: ncv.Image, second: ncv.Image) -> None:
    """Independent estimates of one picture."""
    z = z_scores(first, second)
    assert min(first.pixels.mean(), second.pixels.mean()) > 1e-3
    assert np.abs(z).max() < 6 and np.mean(z**2) < 1 + 5 * np.sqrt(2 / z.size)
    assert abs(z.sum()) < 4.5 * np.sqrt(z.size)


def mixed_scene() -> ncv.Scene:
    """A disc, and a triangle that emits, above a blocker."""
    disc = ncv.DiscLight((-1, 1.5, 0.3), (0.4, -1, 0.3), 0.6, 2.0)
    return scene_of(disc, blocked=True, bright=TRIANGLE)


def test_lines_points_and_rays_see_the_same_of_a_light(one_device):
    scene = mixed_scene()
    options = {"sampler": "independent", "spp": 256, "size": (12, 12), "device": one_device}
    lines, points, rays = (
        render(scene, "direct", "mc", visibility=visibility, seed=seed, **options)
        for seed, visibility in enumerate(("lines", "points", "embree"))
    )
    agree(lines, points)
    agree(lines, rays)
    agree(lines, render(scene, "direct", "ncv", seed=5, visibility="lines", train_spp=16, **options))


SHINY = ncv.Material(0.3, 0.5, 0.3)


def test_points_of_lights_and_rays_that_find_them_agree(one_device):
    """Direct light has the lights' points, and a lobe's strip; paths weigh both ways."""
    scene = scene_of(DISC, SPHERE, SPOT, blocked=True, surface=SHINY, bright=TRIANGLE)
    options = {"sampler": "independent", "spp": 512, "size": (12, 12), "device": one_device}
    direct = render(scene, "direct", "mc", seed=1, **options)
    options["split_direct"] = "off"
    for seed, visibility in ((2, "auto"), (3, "embree")):
        paths = render(scene, GlobalIllumination(2), "mc", seed=seed, visibility=visibility, **options)
        agree(direct, paths)


def ball_mesh(subdivisions: int, radius: float = 0.5) -> np.ndarray:
    ball = trimesh.creation.icosphere(subdivisions=subdivisions)
    return radius * ball.vertices[ball.faces] + [0.2, 1.0, 0.3]


def test_a_mesh_of_thousands_of_triangles_lights_as_their_sum(one_device):
    """Of a convex one a place sees the triangles that face it: Lambert's formula of each."""
    triangles = ball_mesh(4)
    scene = lit_by(triangles)
    lights = light_sources(scene).lights
    assert len(lights.area) == 5120 and lights.strips <= 64
    places = np.array([[-1.0, 0, 0.5], [0.3, 0, 0.2], [1.5, 0, -1.5]])
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    for spp, integrand in ((4096, "direct"), (1024, "gi")):
        options = {"integrand": integrand, "spp": spp, "sampler": "independent", "device": one_device}
        found = ncv.irradiance(scene, places, np.tile(UP, (3, 1)), **options)
        for place, value, error in zip(places, found.values, found.standard_error, strict=True):
            facing = ((place - triangles[:, 0]) * normals).sum(axis=1) > 0
            exact = 2 * sum(polygon_irradiance(one, place, UP) for one in triangles[facing])
            assert error[0] < 0.05 * exact and abs(value[0] - exact) < 4.5 * error[0]


def test_a_surface_emits_from_both_sides(one_device):
    """Inside a closed one light comes from everywhere alike."""
    scene = lit_by(ball_mesh(2))
    places = np.array([[0.2, 1.0, 0.3], [0.4, 1.2, 0.2]])
    normals = np.array([UP, [0.6, 0.0, 0.8]])
    found = ncv.irradiance(scene, places, normals, spp=1 << 14, device=one_device)
    np.testing.assert_allclose(found.values, 2 * np.pi, rtol=0.01)


def test_a_surface_that_emits_reflects_as_well_and_is_seen(one_device):
    lamp = light_at([-0.4, 1.9, -0.4], [0.8, 0, 0], [0, 0, 0.8], 3)
    panel = quad([-0.5, 0.5, -0.5], [0, 0, 1], [1, 0, 0])
    camera = camera_at([0, 1.5, 0.001], [0, 0.5, 0], 40, up=(0, 0, -1))
    material = np.array([0, 0, 1, 1])
    scenes = [
        mesh_scene(
            np.concatenate([FLOOR, panel]), camera, (lamp,), (grey(0.5), surface), material=material
        )
        for surface in (glow(2.0, 0.4), grey(0.4), glow(2.0))
    ]
    for integrand in ("direct", GlobalIllumination(2)):
        options = {"spp": 256, "size": (5, 5), "device": one_device}
        both, reflected, emitted = (render(one, integrand, "mc", **options).pixels for one in scenes)
        np.testing.assert_allclose(emitted, 2.0, rtol=1e-6)
        assert reflected.min() > 0.05
        np.testing.assert_allclose(both, reflected + emitted, rtol=2e-3)


def test_pairs_that_make_a_parallelogram_are_one_light():
    grid = [quad([x, 2, z], [0.5, 0, 0], [0.1, 0, 0.5]) for x in (0, 0.5, 1) for z in (0, 0.5)]
    box = trimesh.creation.box(extents=(1, 2, 3))
    every = np.concatenate([*grid, box.vertices[box.faces] + [0, 5, 0], TRIANGLE[None]])
    sources = light_sources(lit_by(every))
    shape = sources.lights.shape.tolist()
    assert shape.count(IS_TRIANGLE) == 1 and shape.count(PARALLELOGRAM) == 6 + 6
    corners = every[:, 1:] - every[:, :1]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 0], corners[:, 1]), axis=1)
    own = np.bincount(sources.of_triangle[2:], weights=area, minlength=13)
    np.testing.assert_allclose(sources.lights.area, own, rtol=1e-6)
    assert (sources.of_triangle[:2] == -1).all() and sources.lights.two_sided.all()
    # Those of different surfaces stay apart.
    pair = quad([0, 2, 0], [1, 0, 0], [0, 0, 1])
    materials = (grey(0.5), glow(1.0), glow(3.0))
    every = np.concatenate([FLOOR, pair])
    scene = mesh_scene(every, camera_at([0, 3, 4], [0, 0, 0]), (), materials, material=[0, 0, 1, 2])
    assert light_sources(scene).lights.radiance[:, 0].tolist() == [1, 3]


TOML = """
[camera]
position = [0, 3, 4]
target = [0, 0, 0]
vertical_fov = 40
[materials.floor]
albedo = 0.5
[[quads]]
corner = [-2, 0, -2]
edge1 = [0, 0, 4]
edge2 = [4, 0, 0]
material = "floor"
"""
PLACED = "position = [0, 1, 0]\nintensity = 3\n"
KINDS = {
    'kind = "disc"\ncentre = [0, 1, 0]\nnormal = [0, -2, 0]\nradius = 0.5\nradiance = 2': ncv.DiscLight(
        (0, 1, 0), (0, -2, 0), 0.5, 2
    ),
    'kind = "sphere"\ncentre = [0, 1, 0]\nradius = 0.5\nradiance = [1, 2, 3]': ncv.SphereLight(
        (0, 1, 0), 0.5, (1, 2, 3)
    ),
    f'{PLACED}kind = "point"': ncv.PointLight((0, 1, 0), 3),
    f'{PLACED}kind = "point"\nradius = 0.1': ncv.PointLight((0, 1, 0), 3, 0.1),
    f'{PLACED}kind = "spot"\ntarget = [1, 0, 0]\nouter_angle = 30': ncv.SpotLight(
        (0, 1, 0), 3, direction=(1, -1, 0), outer_angle=30
    ),
}


@pytest.mark.parametrize("text", KINDS)
def test_a_light_of_a_file_is_that_of_arrays(tmp_path, text):
    path = tmp_path / "scene.toml"
    path.write_text(f"{TOML}[[lights]]\n{text}\n")
    assert ncv.load_scene(path).digest == scene_of(KINDS[text]).digest


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('kind = "laser"', r"lights\[0\].kind: unknown kind of light 'laser'; known kinds: quad, disc"),
        ('kind = "sphere"\ncentre = [0, 1, 0]\nradius = 0\nradiance = 1', r"radius: 0.* positive"),
        ('kind = "sphere"\ncentre = [0, 3, 3]\nradius = 2\nradiance = 1', "camera is inside this light"),
        ('kind = "disc"\ncentre = [0, 1, 0]\nnormal = [0, 0, 0]\nradius = 1', "normal: is zero"),
        ('kind = "point"\nposition = [0, 1, 0]\nradiance = 1', "radiance: unknown key"),
        (f'{PLACED}kind = "spot"\nouter_angle = 30', "either direction or target"),
        (f'{PLACED}kind = "spot"\ndirection = [0, 1, 0]\nouter_angle = 0', "outer_angle: 0.* range"),
    ],
)
def test_a_bad_light_is_named(tmp_path, text, message):
    path = tmp_path / "scene.toml"
    path.write_text(f"{TOML}[[lights]]\n{text}\n")
    with pytest.raises(ncv.SceneError, match=message):
        ncv.load_scene(path)


def test_a_small_light_keeps_clear_of_surfaces():
    far, near = (scene_of(ncv.PointLight((0, y, 0), 3)).lights[0] for y in (1.0, 0.001))
    assert far.radius == pytest.approx(1e-3 * np.hypot(4, 4))
    assert near.radius == pytest.approx(0.0005)
    power = [light.area * light.radiance[0] for light in (far, near)]
    np.testing.assert_allclose(power, 3, rtol=1e-6)


def test_what_a_file_emits_may_be_left_out(tmp_path, one_device):
    (tmp_path / "lamp.mtl").write_text("newmtl lamp\nKd 0.5 0.5 0.5\nKe 5 5 5\n")
    (tmp_path / "lamp.obj").write_text(
        "mtllib lamp.mtl\nv 0 1 0\nv 1 1 0\nv 0 1 1\nusemtl lamp\nf 1 2 3\n"
    )
    path = tmp_path / "scene.toml"
    mesh = TOML + '[[meshes]]\nfile = "lamp.obj"\n'
    path.write_text(mesh)
    with pytest.warns(UserWarning, match="materials that emit, which light the scene"):
        used = ncv.load_scene(path)
    assert len(light_sources(used).lights.area) == 1
    assert render(used, "direct", "mc", spp=4, size=(8, 8), device=one_device).pixels.max() > 4
    path.write_text(mesh + 'lights = "ignore"\n')
    ignored = ncv.load_scene(path)
    assert not any(material.emission.any() for material in ignored.materials) and not ignored.warnings
    with pytest.raises(ncv.IntegrandError, match="has no light"):
        render(ignored, "direct", device=one_device)
    path.write_text(mesh + 'lights = "ignore"\nmaterial = "floor"\n')
    with pytest.raises(ncv.SceneError, match="has no effect beside material"):
        ncv.load_scene(path)


def test_lines_are_not_for_balls(one_device):
    with pytest.raises(ValueError, match="some of them balls"):
        render(scene_of(SPHERE), "direct", visibility="lines", device=one_device)


def test_a_blocker_of_a_light_is_no_matter_to_ambient_occlusion(one_device):
    options = {"spp": 16, "size": (6, 6), "device": one_device}
    bright, dull = (
        mesh_scene(
            np.concatenate([FLOOR, BLOCKER]), camera_at([0, 3, 4], [0, 0, 0]), (), (grey(0.5), surface),
            material=[0, 0, 1, 1],
        )
        for surface in (glow(2.0, 0.5), grey(0.5))
    )  # fmt: skip
    first, second = (render(scene, "ao", "mc", **options) for scene in (bright, dull))
    np.testing.assert_array_equal(first.pixels, second.pixels)
