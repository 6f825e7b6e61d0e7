"""Pictures under an environment: against ambient occlusion, series, closed forms and Mitsuba."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from reference import camera_at, camera_directions, light_at, quad
from test_environment import picture

import ncv_cl as ncv
from ncv_cl.scene.sky.environment import Environment, Sun

SIZE = (24, 16)
CAMERA = camera_at([0, 3, 6], [0, 0.4, 0])
FLOOR = quad([-5, 0, -5], [0, 0, 10], [10, 0, 0])
# Two walls and a slanted roof, which hide much of the sky.
SHED = np.concatenate(
    [
        FLOOR,
        quad([-1, 0, -1], [0, 2, 0], [2, 0, 0]),
        quad([-1, 0, -1], [0, 0, 1.5], [0, 2, 0]),
        quad([-1, 2, -1], [0, 0.3, 1.5], [2, 0, 0]),
    ]
)
SKY = Environment(picture(), 30.0, (1.0, 2.0, -0.5), (Sun((0.3, 1.0, 0.2), np.full(3, 2.0), 4.0),))


def scene_of(environment, triangles=SHED, lights=(), **material):
    vertices = np.asarray(triangles, float).reshape(-1, 3)
    mesh = ncv.TriangleMesh(vertices, np.arange(len(vertices)).reshape(-1, 3), "m")
    own = ncv.Material(**{"albedo": np.full(3, 1.0), **material})
    return ncv.build_scene(CAMERA, {"m": own}, [mesh], lights, environment=environment)


def box(centre, size) -> np.ndarray:
    x, y, z = np.eye(3) * size
    low = np.asarray(centre) - np.array(size) / 2
    return np.concatenate(
        [quad(low, x, y), quad(low, y, z), quad(low, z, x), quad(low + z, y, x), quad(low + x, z, y),
         quad(low + y, x, z)]
    )  # fmt: skip


def check_alike(first: ncv.Image, second: ncv.Image, where=None, deviations=4.5):
    """Independent estimates: the mean's difference, and those of pixels, are what variances say."""
    seen = (first.variance[..., 0] + second.variance[..., 0]) > 0
    if where is not None:
        seen &= where
    assert seen.mean() > 0.15
    difference = (first.pixels.astype(float) - second.pixels)[seen].mean(axis=1)
    variance = (first.variance.astype(float) + second.variance)[seen]
    # Channels of one pixel share their samples: their deviations add up at most.
    error = np.sqrt(variance).mean(axis=1)
    assert abs(difference.sum()) <= deviations * np.sqrt((error**2).sum())
    assert np.mean(np.abs(difference) > 3 * error) < 0.03


@pytest.mark.parametrize("method", ["mc", "ncv", "auto"])
def test_direct_light_of_a_white_sky_is_ambient_occlusion(one_device, method):
    scene = scene_of(Environment(np.ones(3)))
    options = {"size": SIZE, "sampler": "independent", "device": one_device}
    training = {"train_spp": 32} if method == "ncv" else {}
    found = ncv.render(scene, "direct", method, spp=128, seed=1, **training, **options)
    occlusion = ncv.render(scene, "ao", "mc", spp=256, seed=2, visibility="embree", **options)
    hit = occlusion.layers["depth"] > 0
    check_alike(found, occlusion, hit)
    # Beyond the scene the sky is seen, but not by ambient occlusion.
    assert (found.pixels[~hit] == 1).all() and (occlusion.pixels[~hit] == 0).all()


@pytest.mark.parametrize("surface", [{}, {"reflectance": np.full(3, 0.4), "roughness": 0.2}])
def test_all_ways_to_estimate_agree(one_device, surface):
    light = light_at([1, 0.5, 1], [0, 1, 0], [0, 0.3, 1], 3.0, True)
    scene = scene_of(SKY, lights=(light,), albedo=np.array([0.7, 0.6, 0.5]), **surface)
    options = {"size": SIZE, "sampler": "independent", "device": one_device}
    direct = ncv.render(scene, "direct", "mc", spp=192, seed=1, **options)
    by_paths = ncv.render(scene, ncv.GlobalIllumination(2), "mc", spp=192, seed=2, **options)
    check_alike(direct, by_paths)
    all_light = ncv.render(scene, ncv.GlobalIllumination(4), "mc", spp=192, seed=3, **options)
    apart = ncv.render(
        scene,
        ncv.GlobalIllumination(4),
        "mc",
        spp=192,
        seed=4,
        split_direct="on",
        visibility="embree",
        **options,
    )
    check_alike(all_light, apart)
    learned = ncv.render(
        scene, ncv.GlobalIllumination(4), "ncv", spp=128, train_spp=64, seed=6, **options
    )
    check_alike(all_light, learned)
    assert all_light.pixels.mean() > 1.05 * direct.pixels.mean()


@pytest.mark.parametrize("depth", [2, None])
def test_a_convex_body_in_a_furnace_follows_the_series(one_device, depth):
    # Nothing else reflects, so of all bounces there is one: albedo, at any depth.
    scene = scene_of(Environment(np.ones(3)), box([0, 0.5, 0], (2, 1, 1)), albedo=np.full(3, 0.5))
    found = ncv.render(
        scene, ncv.GlobalIllumination(depth), "mc", spp=256, size=SIZE, device=one_device, seed=3
    )
    hit = found.layers["depth"] > 0
    error = np.sqrt(found.variance[hit])
    assert (np.abs(found.pixels[hit] - 0.5) <= 5 * error + 1e-4).all() and error.max() < 5e-3


def test_a_box_with_a_hole_in_a_furnace(one_device):
    # A white box open above, in a white sky: at full depth all is white, 1 everywhere.
    walls = box([0, 1, 0], (2, 2, 2))[:-2]
    camera = camera_at([0, 3.6, 1.0], [0, 0.5, 0], 30)
    scene = replace(scene_of(Environment(np.ones(3)), walls, albedo=np.full(3, 1.0)), camera=camera)
    found = ncv.render(
        scene, ncv.GlobalIllumination(), "mc", spp=256, size=(12, 12), device=one_device,
        sampler="independent", seed=3,
    )  # fmt: skip
    inside = found.layers["depth"] > 0
    assert inside.mean() > 0.5
    difference = (found.pixels[inside] - 1.0)[:, 0].astype(float)
    error = np.sqrt(found.variance[inside][:, 0].astype(float))
    assert abs(difference.sum()) <= 4.5 * np.sqrt((error**2).sum())
    assert (np.abs(difference) <= 5.5 * error).all() and error.mean() < 0.15
    # With fewer bounces it is darker.
    less = ncv.render(scene, ncv.GlobalIllumination(3), "mc", spp=64, size=(12, 12), device=one_device)
    assert less.pixels[inside].mean() < 0.9


def test_no_light_behind_occluders(one_device):
    # Below a closed box neither sun nor sky is seen, and beside it the sun throws a shadow.
    closed = np.concatenate([FLOOR, box([0, 1, 0], (2, 2, 2))])
    sun = Environment(np.zeros(3), suns=(Sun((1, 1, 0), np.full(3, 2.0)),))
    for environment in (sun, replace(sun, radiance=np.ones(3))):
        scene = scene_of(environment, closed)
        at = np.array([[0.3, 0, 0.2], [-1.8, 0, 0.1], [1.5, 0, 0.1], [-4.5, 0, 0.1]])
        found = ncv.irradiance(
            scene, at, np.array([[0, 1.0, 0]] * 4), method="mc", spp=256, device=one_device
        ).values[:, 0]
        assert found[0] == 0
        sunlit = np.sqrt(2) if environment is sun else 0.0
        if environment is sun:
            assert found[1:] == pytest.approx([0, sunlit, sunlit], rel=1e-4)
        else:
            assert 0 < found[1] < np.pi and (found[2:] > np.sqrt(2)).all()


def test_the_background_shows_the_environment(one_device):
    scene = scene_of(SKY, FLOOR)
    for supersample in (1, 3):
        found = ncv.render(
            scene, "direct", "mc", spp=4, size=SIZE, supersample=supersample, device=one_device
        )
        beyond = found.layers["depth"] == 0
        towards = camera_directions(CAMERA, *SIZE, supersample).reshape(-1, 3)
        seen = scene.environment.radiance_of(towards)
        blocks = seen.reshape(SIZE[1], supersample, SIZE[0], supersample, 3).mean(axis=(1, 3))
        assert 0.1 < beyond.mean() < 0.9
        np.testing.assert_allclose(found.pixels[beyond], blocks[beyond], rtol=1e-4)
        assert (found.variance[beyond] == 0).all()
    dark = ncv.render(scene, ncv.GlobalIllumination(direct=False), "mc", spp=4, size=SIZE)
    assert (dark.pixels[beyond] == 0).all()
    upward = replace(scene, camera=camera_at([0, 3, 6], [0, 9, 0]))
    only_sky = ncv.render(upward, "direct", "mc", spp=4, size=SIZE, device=one_device)
    assert (only_sky.layers["depth"] == 0).all() and only_sky.pixels.min() >= 0 < only_sky.pixels.max()


def test_view_factors_do_not_see_it(one_device):
    triangles = [
        quad([0, 0, 0], [1, 0, 0], [0, 0, -1]),
        quad([0, 1, 0], [0, 0, -1], [1, 0, 0]),
        quad([0.2, 0.5, -0.2], [0.5, 0, 0], [0, 0.2, -0.4]),
    ]
    meshes = [
        ncv.TriangleMesh(t.reshape(-1, 3), [[0, 1, 2], [3, 4, 5]], "m", name=name)
        for t, name in zip(triangles, ("floor", "ceiling", "between"), strict=True)
    ]
    factors = []
    for environment in (None, SKY):
        scene = ncv.build_scene(
            CAMERA, {"m": ncv.Material(np.full(3, 0.5))}, meshes, environment=environment
        )
        factors.append(ncv.view_factors(scene, ["floor", "ceiling"], device=one_device))
    np.testing.assert_array_equal(factors[0].values, factors[1].values)
    assert 0 < factors[0].values[0, 1] < 0.2


def test_lines_are_for_area_lights(one_device):
    scene = scene_of(SKY)
    with pytest.raises(ValueError, match="environment"):
        ncv.render(scene, "direct", visibility="lines", spp=4, size=(4, 4), device=one_device)
    # Of ambient occlusion they are slices.
    ncv.render(scene, "ao", visibility="lines", spp=4, size=(4, 4), device=one_device)


def test_mitsuba_sees_the_same(one_device):
    pytest.importorskip("mitsuba", reason="mitsuba is not installed")
    sys.path.insert(0, str(Path(__file__).parent.parent / "bench"))
    from mitsuba_scene import MitsubaScene, import_mitsuba

    rotation, up = 20.0, (1, 2, -0.5)
    pixels = np.random.default_rng(2).gamma(1.0, 1.0, (8, 16, 3)).astype(np.float32)
    scene = scene_of(Environment(pixels, rotation, up), albedo=np.array([0.7, 0.6, 0.5]))
    theirs = MitsubaScene(import_mitsuba(), scene)
    size, spp = (16, 12), 16
    options = {"size": size, "spp": 256, "sampler": "independent", "device": one_device}
    ours = ncv.render(scene, ncv.GlobalIllumination(4), "mc", **options)
    other = np.stack(
        [
            theirs.radiance({"type": "path", "max_depth": 4, "rr_depth": 9}, size, 1, spp, s)
            for s in range(6)
        ]
    )
    beyond = ours.layers["depth"] == 0
    np.testing.assert_allclose(ours.pixels[beyond], other.mean(axis=0)[beyond], rtol=1e-4)
    means = other[:, ~beyond].mean(axis=1)
    own_error = ours.variance[~beyond].astype(float).sum(axis=0) / np.count_nonzero(~beyond) ** 2
    error = np.sqrt(means.var(axis=0, ddof=1) / len(means) + own_error)
    difference = ours.pixels[~beyond].mean(axis=0) - means.mean(axis=0)
    assert (np.abs(difference) <= 6 * error).all()
    assert (error < 0.02 * means.mean(axis=0)).all()
