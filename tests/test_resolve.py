"""From estimates to pixels: combination, box filter, variances, emission and layers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from reference import camera_at, light_at, mesh_scene, quad

import ncv_cl as ncv
from ncv_cl.integrands import AmbientOcclusion, DirectLight
from ncv_cl.opencl.memory import HostArray
from ncv_cl.output.pixel_grid import PixelGrid
from ncv_cl.output.resolve import combine, estimate_of, resolve_image
from ncv_cl.points.points import SURFACE, ShadingPoints
from ncv_cl.sampling.accumulate import Estimate
from ncv_cl.settings.filters import RADIUS, error_factor, weights
from ncv_cl.settings.options import Sampling
from ncv_cl.settings.settings import Settings

# 3 × 2 pixels of 2 × 2 sub-pixels: 6 columns. Pixel (0, 0) has sub-pixels 0, 1, 6, 7; pixel (1, 2)
# has 16, 17, 22, 23. The last two points lie on lights 1 and 0.
SIZE, SUPERSAMPLE = (3, 2), 2
CELL = np.array([0, 1, 7, 16, 23, 6, 17], np.uint32)
LIGHT = np.array([-1, -1, -1, -1, -1, 1, 0], np.int32)
ACTIVE = 5
LIGHTS = (
    light_at([0, 0, 0], [1, 0, 0], [0, 1, 0], (1, 2, 3)),
    light_at([0, 0, 0], [1, 0, 0], [0, 1, 0], (40, 50, 60)),
)


@pytest.fixture
def scene():
    return mesh_scene(quad([0, 0, 0], [1, 0, 0], [0, 1, 0]), camera_at([1, 2, 3], [0, 0, 0]), LIGHTS)


@pytest.fixture
def points(one_device):
    surface = np.random.default_rng(1).uniform(size=(SURFACE.size, len(CELL))).astype(np.float32)
    # Light 1 is seen from its front, light 0 from its back.
    surface[SURFACE["outgoing"]] = [[0], [0], [1]]
    surface[SURFACE["outgoing"], -1] = [0, 0, -1]
    background = SIZE[0] * SIZE[1] * SUPERSAMPLE**2 - len(CELL)
    material = np.zeros(len(CELL), np.int32)
    return ShadingPoints(
        HostArray.of(one_device, surface), CELL, LIGHT, ACTIVE, background, material=material
    )


def some_estimate(channels=3, points=ACTIVE, samples=10, seed=2):
    mean, variance = np.random.default_rng(seed).uniform(1, 2, (2, channels, points))
    return Estimate(mean, variance, np.full(points, float(samples)))


def test_pixels_and_variances_are_box_filtered(scene, points):
    plain = some_estimate()
    image = resolve_image(scene, asked(AmbientOcclusion()), points, plain)
    assert image.pixels.shape == image.variance.shape == (2, 3, 3)
    np.testing.assert_allclose(image.pixels[0, 0], plain.mean[:, :3].sum(1) / 4, rtol=1e-6)
    np.testing.assert_allclose(image.pixels[1, 2], plain.mean[:, 3:].sum(1) / 4, rtol=1e-6)
    # Variance of a sum of independent means, each a quarter: a sixteenth of the variances of means.
    np.testing.assert_allclose(image.variance[0, 0], plain.variance[:, :3].sum(1) / 10 / 16, rtol=1e-6)
    np.testing.assert_allclose(image.variance[1, 2], plain.variance[:, 3:].sum(1) / 10 / 16, rtol=1e-6)
    for empty in [(0, 1), (0, 2), (1, 0), (1, 1)]:
        assert not image.pixels[empty].any() and not image.variance[empty].any()
    assert "G" not in image.layers and "residual" not in image.layers


def test_one_channel_becomes_grey(scene, points):
    plain = some_estimate(channels=1)
    image = resolve_image(scene, asked(AmbientOcclusion()), points, plain)
    np.testing.assert_allclose(image.pixels[0, 0], np.repeat(plain.mean[0, :3].sum() / 4, 3), rtol=1e-6)
    np.testing.assert_array_equal(image.variance[..., 0], image.variance[..., 2])


def test_lights_in_view_add_their_radiance_on_the_emitting_side(scene, points):
    plain = some_estimate()
    dark = resolve_image(scene, asked(AmbientOcclusion()), points, plain)
    lit = resolve_image(scene, asked(DirectLight()), points, plain)
    expected = np.zeros((2, 3, 3))
    expected[0, 0] = np.array([40, 50, 60]) / 4
    np.testing.assert_allclose(lit.pixels - dark.pixels, expected, atol=1e-5)
    np.testing.assert_array_equal(lit.variance, dark.variance)


def test_sensors_on_lights_emit_nothing(scene, points):
    sensors = replace(points, material=None)
    np.testing.assert_array_equal(
        resolve_image(scene, asked(DirectLight()), sensors, some_estimate()).pixels,
        resolve_image(scene, asked(AmbientOcclusion()), sensors, some_estimate()).pixels,
    )


def test_layers_average_all_hits(scene, points):
    image = resolve_image(scene, asked(AmbientOcclusion()), points, some_estimate())
    pixel00, pixel12 = [0, 1, 2, 5], [3, 4, 6]
    for layer, name in (("albedo", "albedo"), ("N", "normal")):
        rows = points.rows(name)
        np.testing.assert_allclose(image.layers[layer][0, 0], rows[:, pixel00].sum(1) / 4, rtol=1e-6)
        np.testing.assert_allclose(image.layers[layer][1, 2], rows[:, pixel12].sum(1) / 4, rtol=1e-6)
    distance = np.linalg.norm(points.rows("position").T - [1, 2, 3], axis=1)
    depth = image.layers["depth"]
    assert depth.shape == (2, 3)
    # Depth is the mean over what was hit: a half-covered pixel is not half as far.
    np.testing.assert_allclose(depth[0, 0], distance[pixel00].mean(), rtol=1e-6)
    np.testing.assert_allclose(depth[1, 2], distance[pixel12].mean(), rtol=1e-6)
    assert depth[0, 1] == 0


def test_the_networks_layers_add_up_to_the_estimate(scene, points):
    plain, residual = some_estimate(), some_estimate(seed=3)
    integral = np.random.default_rng(4).uniform(size=(3, ACTIVE))
    image = resolve_image(scene, asked(AmbientOcclusion()), points, plain, None, residual, integral)
    np.testing.assert_allclose(image.layers["G"][0, 0], integral[:, :3].sum(1) / 4)
    np.testing.assert_allclose(image.layers["residual"][0, 0], residual.mean[:, :3].sum(1) / 4)
    np.testing.assert_allclose(image.pixels, image.layers["G"] + image.layers["residual"], rtol=1e-6)


def asked(integrand):
    return Settings(integrand, "mc", 16, SIZE, 0, Sampling(supersample=SUPERSAMPLE))


def one(mean, variance, samples):
    return Estimate(np.array([[mean]]), np.array([[variance]]), np.array([float(samples)]))


@pytest.mark.parametrize(
    ("residual", "integral", "mean", "variance"),
    [(None, None, 5.0, 8 / 4), (one(0.5, 0.4, 4), 3.0, 3.5, 0.4 / 4)],
)
def test_the_residual_is_added_to_the_integral(residual, integral, mean, variance):
    integral = None if integral is None else np.array([[integral]])
    found = estimate_of(one(5.0, 8.0, 4), residual, integral)
    np.testing.assert_allclose(np.ravel(found), [mean, variance])


def test_training_samples_enter_by_their_number_or_their_error():
    generator = np.random.default_rng(0)
    truth = generator.uniform(size=(3, 20000))
    # Half of the points have training samples; these are stratified, so their error is a fifth of what
    # independent samples would have.
    samples = np.where(np.arange(20000) % 2, 12.0, 0.0)
    own = np.where(samples > 0, truth + generator.normal(size=truth.shape) * np.sqrt(0.1), 0)
    training = Estimate(own, np.full(truth.shape, 6.0), samples)
    mean = truth + generator.normal(size=truth.shape) * np.sqrt(0.025)
    for by_count, share in ((True, 0.75), (False, 0.2)):
        combined, variance = combine(mean, np.full(truth.shape, 0.025), training, 4.0, by_count)
        np.testing.assert_array_equal(combined[:, samples == 0], mean[:, samples == 0])
        expected = share * own + (1 - share) * mean
        np.testing.assert_allclose(combined[:, 1::2], expected[:, 1::2], atol=0.05)
        error = np.mean((combined - truth)[:, 1::2] ** 2)
        np.testing.assert_allclose(variance[:, 1::2].mean(), error, rtol=0.03)


def test_training_samples_that_could_not_be_noticed_are_left_out():
    mean, variance = np.ones((1, 4)), np.full((1, 4), 1e-6)
    training = Estimate(np.array([[0.0, 2, 0, 2]]), np.ones((1, 4)), np.full(4, 1.0))
    np.testing.assert_array_equal(combine(mean, variance, training, 1.0)[0], mean)


@pytest.mark.parametrize("supersample", [1, 3])
def test_every_subpixel_belongs_to_one_pixel(supersample):
    width, height = 5, 4
    cells = np.arange(width * height * supersample**2, dtype=np.uint32)
    points = ShadingPoints(None, cells, np.full(len(cells), -1), len(cells), 0)
    grid = PixelGrid(points, (width, height), supersample)
    image = cells.reshape(height, supersample, width, supersample).mean(axis=(1, 3))
    average = grid.average(cells[None].astype(float), slice(None))[..., 0]
    np.testing.assert_allclose(average, image)


def test_a_picture_of_nothing_is_black(scene, one_device):
    nothing = np.empty(0, np.uint32)
    points = ShadingPoints(
        HostArray(one_device, (SURFACE.size, 0), np.float32), nothing, nothing.astype(int), 0, 24
    )
    plain = Estimate(np.zeros((3, 0)), np.zeros((3, 0)), np.zeros(0))
    image = resolve_image(scene, asked(DirectLight()), points, plain)
    for plane in (image.pixels, image.variance, *image.layers.values()):
        assert not plane.any()


# ------------------------------------------------------------------------------------------- filters


def dense_weights(name, side, pixels):
    """The filter's matrix (pixels, sub-pixels) along an axis, each row of sum 1."""
    middles = (np.arange(pixels * side) + 0.5) / side - 0.5
    x = (middles - np.arange(pixels)[:, None]) / RADIUS[name]
    terms = (0.35875, 0.48829, 0.14128, 0.01168)
    shapes = {
        "box": np.abs(x) < 1,
        "tent": 1 - np.abs(x),
        "blackman-harris": sum(a * np.cos(k * np.pi * x) for k, a in enumerate(terms)),
    }
    rows = np.where(np.abs(x) < 1, shapes[name], 0.0)
    return rows / rows.sum(1, keepdims=True)


@pytest.mark.parametrize("name", RADIUS)
@pytest.mark.parametrize("side", [2, 3, 4])
def test_pixels_are_weighted_means_of_the_sub_pixels_about_them(name, side):
    width, height = 7, 5
    cells = np.random.default_rng(4).permutation(width * height * side**2)[:-9].astype(np.uint32)
    points = ShadingPoints(None, cells, np.full(len(cells), -1), len(cells), background=9)
    grid = PixelGrid(points, (width, height), side, name)
    values = np.random.default_rng(5).random((2, len(cells)))
    plane = np.zeros((2, height * side * width * side))
    plane[:, cells] = values
    plane = plane.reshape(2, height * side, width * side)
    rows, columns = (dense_weights(name, side, n) for n in (height, width))
    everything = slice(0, len(cells))
    expected = np.einsum("ri,nij,cj->rcn", rows, plane, columns)
    np.testing.assert_allclose(grid.average(values, everything), expected, rtol=1e-12)
    squares = np.einsum("ri,nij,cj->rcn", rows**2, plane, columns**2)
    found = np.stack([grid.variance_of_mean(row, everything) for row in values], axis=-1)
    np.testing.assert_allclose(found, squares, rtol=1e-12)
    # What pixels of equal sub-pixels err by, far from the picture's sides.
    inner = np.sum(rows[2] ** 2) * np.sum(columns[3] ** 2)
    assert error_factor(name, side) == pytest.approx(inner)


def test_the_series_of_blackman_and_harris_is_a_bump():
    found = weights("blackman-harris", 8)
    assert len(found) == 24 and found.sum() == pytest.approx(1) and (found > 0).all()
    assert (np.diff(found[:12]) > 0).all() and np.allclose(found, found[::-1])
    assert weights("tent", 2) == pytest.approx([0.125, 0.375, 0.375, 0.125])
    assert weights("box", 3) == pytest.approx([1 / 3] * 3)


@pytest.mark.parametrize("name", ["tent", "blackman-harris"])
def test_a_filtered_picture_keeps_its_light_and_tells_its_error(one_device, scenes, name):
    options = {
        "method": "mc", "sampler": "independent", "spp": 8, "size": (24, 18), "supersample": 2,
        "visibility": "points", "device": one_device,
    }  # fmt: skip
    path = scenes / "cornell_box.toml"
    boxed = ncv.render(path, "direct", **options)
    first, second = (ncv.render(path, "direct", seed=s, filter=name, **options) for s in (1, 2))
    assert first.pixels.mean() == pytest.approx(boxed.pixels.mean(), rel=0.02)
    # Some 400 pixels, whose neighbours err together: a ratio of 1 to about a tenth.
    ratio = np.mean((first.pixels - second.pixels) ** 2) / np.mean(first.variance + second.variance)
    assert ratio == pytest.approx(1, abs=0.3)
    # Of which the pass's own estimate of the error is the mean.
    assert first.stats["estimated_mse"] == pytest.approx(first.variance.mean(), rel=0.05)
    assert first.metadata["filter"] == name


def test_a_filter_wants_several_points_a_pixel():
    with pytest.raises(ValueError, match=r"filter 'tent' would not smooth.*supersample 2"):
        Sampling(filter="tent")
    with pytest.raises(ValueError, match="filter must be one of"):
        Sampling(filter="gauss", supersample=2)
