"""Glass in pictures: furnaces, slabs and panes in closed form, and an independent renderer."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from glass_scenes import PANES, ball, block, furnace, room, sheet
from reference import polygon_irradiance

import ncv_cl as ncv
from ncv_cl.points.panes import Panes, fresnel
from ncv_cl.points.trace import Tracer

GLOW = np.array([1, 2, 0.5])


def glass(transmission=1.0, **options):
    return ncv.Material(0.0, transmission=transmission, **options)


def pane_reflectance(cosine, ior=1.5):
    one = fresnel(np.asarray(cosine, float), np.asarray(ior, float))
    return 2 * one / (1 + one)


# ------------------------------------------------------------------------------------------ furnaces


@pytest.mark.parametrize(
    ("material", "meshes", "method"),
    [
        (glass(), [ball([0, 0, 0], 0.8, "glass")], "mc"),
        (glass(), [ball([0, 0, 0], 0.8, "glass")], "ncv"),
        (glass(ior=0.7), [ball([0, 0, 0], 0.8, "glass")], "mc"),
        (glass(), [block([0, 0, 0], [1.2, 1, 0.8], "glass")], "mc"),
        (
            glass(thin=True),
            [sheet([-1, -1, z], [2, 0, 0.4], [0, 2, 0.2], "glass") for z in (0, 0.7)],
            "mc",
        ),
    ],
)
def test_in_a_furnace_smooth_glass_is_not_to_be_seen(one_device, material, meshes, method):
    scene = furnace(material, meshes)
    options = {"train_spp": 16} if method == "ncv" else {}
    spp = 128 if method == "mc" else 64
    image = ncv.render(scene, "gi", method, spp=spp, size=(16, 12), device=one_device, **options)
    z = (image.pixels - GLOW) / np.sqrt(image.variance + 1e-4)
    # Silhouettes of a ball of triangles with the ball's normals are the loss.
    assert image.pixels / GLOW == pytest.approx(1, abs=0.2)
    assert image.pixels.mean((0, 1)) / GLOW == pytest.approx(1, abs=3e-3) and np.abs(z).mean() < 1.2


def test_an_index_of_one_is_no_glass_but_its_tint(one_device):
    scene = furnace(glass((1, 0.5, 0.25), ior=1.0), [block([0, 0, 0], [40, 40, 0.5], "glass")])
    image = ncv.render(scene, "gi", "mc", spp=8, size=(5, 4), device=one_device)
    # The first and the last face, and no light is lost or bent.
    np.testing.assert_allclose(
        image.pixels, np.broadcast_to(GLOW * [1, 0.25, 0.0625], (4, 5, 3)), rtol=1e-5
    )


# -------------------------------------------------------------------------------- slabs and panes


def seen_through(material, angle, thickness):
    """A wall that glows, behind a slab or a pane that the camera sees at an angle."""
    direction = np.array([np.sin(angle), 0.0, -np.cos(angle)])
    wide = [400, 400, thickness]
    meshes = [sheet([-500, -500, -5], [1000, 0, 0], [0, 1000, 0], "wall")]
    if thickness:
        meshes.append(block([0, 0, 0], wide, "glass"))
    else:
        meshes.append(sheet([-200, -200, 0], [400, 0, 0], [0, 400, 0], "glass"))
    camera = ncv.Camera(-2 * direction, (0, 0, 0), 0.5)
    materials = {"glass": material, "wall": ncv.Material(0.0, emission=1)}
    return ncv.build_scene(camera, materials, meshes)


@pytest.mark.parametrize("angle", [0.0, 0.6, 1.1])
@pytest.mark.parametrize("thickness", [0.0, 0.3])
def test_a_slab_and_a_pane_let_through_the_series(one_device, angle, thickness):
    """(1 - R)² t² / (1 - R²) of a slab, whose faces tint; (1 - R) / (1 + R) t of a pane."""
    tint = np.array([1.0, 0.8, 0.3])
    scene = seen_through(glass(tint, thin=not thickness), angle, thickness)
    image = ncv.render(
        scene, "gi", "mc", sampler="independent", spp=2048, size=(4, 4), device=one_device
    )
    one = fresnel(np.cos(angle), np.float64(1.5))
    expected = (1 - one) / (1 + one) * (tint**2 if thickness else tint)
    z = (image.pixels.mean((0, 1)) - expected) / np.sqrt(image.variance.mean((0, 1)) / 16)
    assert np.abs(z).max() < 4 and np.sqrt(image.variance.mean() / 16) < 0.01


def under_a_pane(roughness=1.0, reflectance=0.0, tilt=0.2):
    """A floor and its lamp with a pane between, which the camera does not see."""
    floor = ncv.Material((0.6, 0.5, 0.4), reflectance, roughness)
    lamp = ncv.QuadLight((-0.5, 2, -0.5), (1, 0, 0), (0, 0, 1), (6, 5, 4))
    meshes = [
        sheet([-3, 0, 3], [6, 0, 0], [0, 0, -6], "floor"),
        sheet([-2, 1.5, 2], [4, tilt, 0], [0, 0, -4], "pane"),
    ]
    camera = ncv.Camera((0, 1.3, 1.5), (0, 0, -0.2), 40)
    materials = {"floor": floor, "pane": glass((0.9, 0.5, 0.2), thin=True)}
    return ncv.build_scene(camera, materials, meshes, [lamp])


def irradiance_through(scene, position):
    """By quadrature over the lamp, (3,)."""
    light, steps = scene.lights[0], 200
    cell = (np.arange(steps) + 0.5) / steps
    u, v = (one.ravel()[:, None] for one in np.meshgrid(cell, cell, indexing="ij"))
    towards = light.corner + u * light.edge1 + v * light.edge2 - position
    distance = np.linalg.norm(towards, axis=1)
    corners = scene.vertices[scene.triangles[2]].astype(float)
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    cosine = np.abs(towards @ normal) / np.linalg.norm(normal) / distance
    geometry = towards[:, 1] ** 2 / distance**4 * light.area / steps**2
    through = geometry @ (1 - pane_reflectance(cosine))
    return through * np.array([0.9, 0.5, 0.2]) * light.radiance, geometry.sum()


@pytest.mark.parametrize(
    ("integrand", "method"),
    [(ncv.DirectLight(), "mc"), (ncv.DirectLight(), "ncv"), (ncv.GlobalIllumination(2), "mc")],
)
def test_panes_let_lights_pass_by_their_angle(one_device, integrand, method):
    scene = under_a_pane()
    camera = scene.camera.position
    options = {"train_spp": 16} if method == "ncv" else {}
    image = ncv.render(scene, integrand, method, spp=256, size=(8, 6), device=one_device, **options)
    assert image.pixels.all()
    height = np.tan(np.radians(20))
    forward = scene.camera.target - camera
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0, 1, 0])
    right /= np.linalg.norm(right)
    for row, column in ((1, 2), (3, 4), (5, 7)):
        x, y = (column + 0.5) / 4 - 1, 1 - (row + 0.5) / 3
        towards = forward + x * height * 8 / 6 * right + y * height * np.cross(right, forward)
        position = camera - camera[1] / towards[1] * towards
        expected, bare = irradiance_through(scene, position)
        corners = [
            scene.lights[0].corner + a * scene.lights[0].edge1 + b * scene.lights[0].edge2
            for a, b in ((0, 0), (1, 0), (1, 1), (0, 1))
        ]
        assert bare == pytest.approx(polygon_irradiance(corners, position, [0, 1, 0]), rel=1e-3)
        expected = expected * [0.6, 0.5, 0.4] / np.pi
        error = np.sqrt(image.variance[row, column]) + 1e-3 * expected
        assert (np.abs(image.pixels[row, column] - expected) < 5 * error).all()


@pytest.mark.parametrize("roughness", [0.1, 0.4])
def test_light_behind_a_pane_is_found_once(one_device, roughness):
    """A glossy floor finds the lamp by its points and by its lobe, both through the pane."""
    scene = under_a_pane(roughness, 0.5)
    options = {"method": "mc", "sampler": "independent", "size": (12, 9), "device": one_device}
    direct = ncv.render(scene, "direct", spp=2048, seed=1, **options)
    paths = ncv.render(scene, ncv.GlobalIllumination(2), spp=2048, seed=2, **options)
    z = (paths.pixels - direct.pixels) / np.sqrt(direct.variance + paths.variance + 1e-10)
    # Channels err together: a third of the numbers are independent.
    assert np.mean(z**2) < 1 + 5 * np.sqrt(2 / (z.size / 3)) and np.abs(z).max() < 5
    assert paths.pixels.mean() == pytest.approx(direct.pixels.mean(), rel=5e-3)


def test_panes_are_in_the_way_of_occlusion_and_solid_glass_of_all_shadow_rays(one_device):
    scene = under_a_pane()
    origin = np.array([[0, 0.1, 0]], np.float32)
    up, far, seen = np.array([[0, 1, 0]], np.float32), np.full(1, 1.8, np.float32), np.zeros(1, np.uint8)
    light = np.full((1, 3), 0.5, np.float32)
    Tracer(scene, 1).visible(origin, up, far, seen)
    assert seen[0] == 0
    Tracer(scene, 1).visible(origin, up, far, seen, light)
    tilted = 4 / np.hypot(4, 0.2)
    expected = 0.5 * np.array([0.9, 0.5, 0.2]) * (1 - pane_reflectance(tilted))
    assert seen[0] == 1 and light[0] == pytest.approx(expected, rel=1e-5)
    solid = room(glass(), [ball([0, 0.9, 0], 0.8, "glass")])
    assert not solid.has_panes and solid.has_glass and not solid.has_gaps
    origin[0, 1] = 0.01
    Tracer(solid, 1).visible(origin, up, far, seen, light)
    assert seen[0] == 0


def test_a_ray_through_two_panes_and_their_edges_is_dimmed_by_each_once():
    scene = room(glass((0.5, 0.5, 0.5), thin=True), PANES[:1])
    generator = np.random.default_rng(5)
    origins = generator.uniform([-1, 0.2, 1], [1, 1.8, 1.9], (2000, 3)).astype(np.float32)
    # To the quad's diagonal, where its triangles meet, and anywhere on it.
    along = generator.uniform(0.05, 0.95, (2000, 1))
    across = np.where(generator.random((2000, 1)) < 0.5, along, generator.uniform(0.05, 0.95, (2000, 1)))
    ends = np.array([-1.5, 0, 0.5]) + along * [3, 0, 0] + across * [0, 2, -0.3]
    towards = (1.02 * (ends - origins)).astype(np.float32)
    seen, light = np.zeros(2000, np.uint8), np.ones((2000, 3), np.float32)
    Tracer(scene, 2).visible(origins, towards, np.ones(2000, np.float32), seen, light)
    normal = np.cross([3, 0, 0], [0, 2, -0.3])
    cosine = np.abs(towards @ normal) / np.linalg.norm(normal) / np.linalg.norm(towards, axis=1)
    assert seen.all()
    np.testing.assert_allclose(light[:, 0], 0.5 * (1 - pane_reflectance(cosine)), rtol=1e-4)
    assert Panes(scene).triangles.sum() == 2


def test_depth_counts_no_pane_that_a_path_goes_through(one_device):
    """Through a pane a matte wall is seen at depth 2, as dim as the pane makes it."""
    lamp = ncv.QuadLight((-1, 3, 1), (2, 0, 0), (0, 0, 2), 5)
    wall = sheet([-40, -40, -2], [80, 0, 0], [0, 80, 0], "wall")
    materials = {"wall": ncv.Material(0.5), "glass": glass(0.7, thin=True)}
    camera = ncv.Camera((0, 0, 4), (0, 0, 0), 20)
    bare = ncv.build_scene(camera, materials, [wall], [lamp])
    halves = [sheet([-9, y, 3.5], [18, 0, 0], [0, 5, 0], "glass") for y in (-5, 0)]
    covered = ncv.build_scene(camera, materials, [wall, *halves], [lamp])
    options = {"method": "mc", "size": (4, 3), "device": one_device}
    without = ncv.render(bare, "direct", spp=256, **options).pixels
    image = ncv.render(covered, ncv.GlobalIllumination(2), spp=4096, **options)
    through = (1 - pane_reflectance(1.0)) * 0.7
    z = (image.pixels - through * without) / np.sqrt(image.variance + 1e-9)
    assert np.abs(z).max() < 5 and (image.pixels > 0).all()


# ------------------------------------------------------------------------------- direct light says so


def test_direct_light_shows_reflected_lamps_and_says_what_is_missing(one_device):
    scene = room(glass(), [ball([0, 0.9, 0], 0.8, "glass")])
    with pytest.warns(UserWarning, match=r"glass.*needs integrand gi"):
        image = ncv.render(scene, "direct", "mc", spp=64, size=(32, 24), device=one_device)
    on_ball = image.pixels[12:18, 13:19].mean(axis=2)
    assert (on_ball == 0).any()


@pytest.mark.parametrize("roughness", [0.2, 0.5])
def test_parts_of_glass_add_up(one_device, roughness):
    """Direct light apart is what rough glass reflects of lamps; the rest is paths."""
    scene = room(glass(0.9, roughness=roughness), [ball([0, 0.9, 0], 0.8, "glass")])
    options = {"method": "mc", "size": (12, 9), "device": one_device}
    one = ncv.render(scene, ncv.GlobalIllumination(6), spp=1024, seed=1, split_direct="off", **options)
    two = ncv.render(scene, ncv.GlobalIllumination(6), spp=1024, seed=2, split_direct="on", **options)
    z = (one.pixels - two.pixels) / np.sqrt(one.variance + two.variance + 1e-9)
    assert np.mean(z**2) < 2.5 and abs(z.mean()) < 0.3


# ----------------------------------------------------------------------------- an independent renderer

BALL = [ball([0, 0.9, 0], 0.8, "glass", 3)]
CASES = {
    "smooth": (glass((1, 0.9, 0.8)), BALL),
    "rough": (glass((1, 0.9, 0.8), roughness=0.35), BALL),
    "very rough": (glass((1, 0.9, 0.8), ior=1.33, roughness=0.7), BALL),
    "block": (glass((0.9, 1, 0.8), ior=1.8), [block([0, 0.8, 0], [1.2, 1.5, 1], "glass")]),
    "panes": (glass((1, 0.9, 0.8), thin=True), list(PANES)),
}


QUICK = [("smooth", "mc"), ("panes", "mc")]


@pytest.mark.parametrize(
    ("case", "method"),
    [
        pytest.param(case, method, marks=[] if (case, method) in QUICK else pytest.mark.slow)
        for case in CASES
        for method in ("mc", "ncv")
    ],
)
def test_means_agree_with_mitsuba(one_device, case, method):
    pytest.importorskip("mitsuba", reason="mitsuba is not installed")
    sys.path.insert(0, str(Path(__file__).parent.parent / "bench"))
    import compare_mitsuba
    from mitsuba_scene import MitsubaScene

    scene = room(*CASES[case])
    theirs = MitsubaScene(compare_mitsuba.import_mitsuba(), scene)
    size, spp, images = (16, 12), 64, 4
    path = {"type": "path", "max_depth": -1, "rr_depth": 8}
    other = np.stack([theirs.radiance(path, size, 1, spp, s) for s in range(images)])
    options = {"method": method, "spp": 256, "size": size, "device": one_device}
    options |= {"train_spp": 16} if method == "ncv" else {}
    ours = [ncv.render(scene, "gi", seed=s, **options).pixels for s in range(images)]
    ours = np.stack(ours).astype(np.float64)
    row = compare_mitsuba.compare(ours, other, spp)
    for difference, error in zip(row["difference"], row["standard_error"], strict=True):
        assert abs(difference) <= max(4 * error, 0.005) and error < 0.02
    variance = (ours.var(0, ddof=1) + other.var(0, ddof=1)) / images
    z = (ours.mean(0) - other.mean(0)) / np.sqrt(variance + 1e-12)
    assert np.mean(np.abs(z) < 5) > 0.95


@pytest.mark.slow
def test_a_white_conductor_agrees_with_mitsubas(one_device, monkeypatch):
    """Reflectance 1 has the same Fresnel term in both; tints go up to white at the rim in ours alone."""
    pytest.importorskip("mitsuba", reason="mitsuba is not installed")
    sys.path.insert(0, str(Path(__file__).parent.parent / "bench"))
    import compare_mitsuba
    import mitsuba_scene

    own = mitsuba_scene.MitsubaScene._bsdf

    def with_conductor(scene, material, coloured=False):
        if not material.reflectance.any():
            return own(scene, material, coloured)
        rough = {"distribution": "ggx", "alpha": material.roughness**2, "material": "none"}
        return {"type": "twosided", "conductor": {"type": "roughconductor", **rough}}

    monkeypatch.setattr(mitsuba_scene.MitsubaScene, "_bsdf", with_conductor)
    scene = room(ncv.Material(0.0, 1.0, 0.4), BALL)
    theirs = mitsuba_scene.MitsubaScene(compare_mitsuba.import_mitsuba(), scene)
    path = {"type": "path", "max_depth": -1, "rr_depth": 8}
    size, options = (16, 12), {"method": "mc", "spp": 256, "device": one_device}
    other = np.stack([theirs.radiance(path, size, 1, 64, s) for s in range(4)])
    ours = [ncv.render(scene, "gi", size=size, seed=s, **options).pixels for s in range(4)]
    row = compare_mitsuba.compare(np.stack(ours).astype(np.float64), other, 64)
    for difference, error in zip(row["difference"], row["standard_error"], strict=True):
        assert abs(difference) <= max(4 * error, 0.005) and error < 0.02


def test_lines_on_lights_are_not_for_panes(one_device):
    with pytest.raises(ValueError, match="thin panes; take 'auto'"):
        ncv.render(under_a_pane(), "direct", visibility="lines", spp=4, size=(4, 4), device=one_device)
