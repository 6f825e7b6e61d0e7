"""Ambient occlusion: both mappings, their densities, the radius, and closed forms."""

from __future__ import annotations

import math
import warnings

import numpy as np
import pytest
from reference import (
    batch_arrays,
    camera_at,
    light_at,
    mesh_scene,
    quad,
    sampling,
    shadowed_values,
    tangent_frame,
    unit,
)

from ncv_cl import render
from ncv_cl.integrands import AmbientOcclusion, IntegrandError
from ncv_cl.integrands.ao import MAPPINGS
from ncv_cl.sampling.samples import NO_RAY

NORMALS = np.array(
    [
        [1, 0, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1], [0.3, -0.5, 0.2], [1e-4, 0, -1], [-0.6, 0.1, -0.4],
    ],
    float,
)  # fmt: skip
SAMPLES = 4096


def facing(normal: np.ndarray):
    """A lone square that the camera looks at along its normal."""
    normal = unit(normal)
    tangent, bitangent = tangent_frame(normal)
    square = quad(-tangent - bitangent, 2 * tangent, 2 * bitangent)
    return mesh_scene(square, camera_at(2 * normal, [0, 0, 0], 20, tangent))


def between_plates(height: float, radius: float, mapping: str):
    """A floor, a wide plate `height` above it, and the camera between them."""
    plates = [quad([-9, -9, z], [18, 0, 0], [0, 18, 0]) for z in (0, height)]
    camera = camera_at([0, 0, height / 2], [0, 0, 0], 20, up=[0, 1, 0])
    return mesh_scene(np.concatenate(plates), camera), AmbientOcclusion(radius, mapping)


@pytest.mark.parametrize("mapping", MAPPINGS)
@pytest.mark.parametrize("normal", NORMALS)
def test_an_open_point_sees_everything_in_the_stated_density(device, mapping, normal):
    points, source, rays = sampling(
        device, facing(normal), AmbientOcclusion(mapping=mapping), (3, 1), SAMPLES
    )
    batch = source.draw(range(points.active), range(SAMPLES), 0)
    arrays = batch_arrays(batch, 1)
    value = shadowed_values(batch, 1)
    np.testing.assert_allclose(value.mean(axis=-1), 1, atol=2e-5)

    own = points.rows("normal").T.astype(float)
    np.testing.assert_allclose(own, np.tile(unit(normal), (3, 1)), atol=1e-6)
    for point in range(points.active):
        traced = arrays["slot"][point] != NO_RAY
        u, v = (arrays[name][point][traced].astype(float) for name in "uv")
        direction = rays.directions[arrays["slot"][point][traced]].astype(float)
        height = u if mapping == "height" else np.sqrt(1 - u)
        expected_value = 2 * u if mapping == "height" else np.ones_like(u)
        np.testing.assert_allclose(arrays["value"][0, point][traced], expected_value, rtol=1e-6)
        tangent, bitangent = tangent_frame(own[point])
        across = np.sqrt(1 - height**2)[:, None]
        angle = 2 * np.pi * v[:, None]
        expected = across * (np.cos(angle) * tangent + np.sin(angle) * bitangent)
        expected += height[:, None] * own[point]
        np.testing.assert_allclose(direction, expected, atol=2e-6)
        # Moments of a uniform, or a cosine-weighted, hemisphere.
        axes = np.stack([tangent, bitangent, own[point]])
        local = direction @ axes.T
        squares = (1 / 3, 1 / 3, 1 / 3) if mapping == "height" else (1 / 4, 1 / 4, 1 / 2)
        np.testing.assert_allclose(
            local.mean(0), [0, 0, 1 / 2 if mapping == "height" else 2 / 3], atol=2e-3
        )
        np.testing.assert_allclose(local.T @ local / len(local), np.diag(squares), atol=2e-3)


@pytest.mark.parametrize("mapping", MAPPINGS)
@pytest.mark.parametrize(("height", "radius"), [(0.5, 0.4), (0.5, 0.6), (0.2, 1.0), (0.3, 3.0)])
def test_occluders_count_within_the_radius_only(device, mapping, height, radius):
    scene, integrand = between_plates(height, radius, mapping)
    points, source, rays = sampling(device, scene, integrand, (3, 1), SAMPLES)
    batch = source.draw(range(points.active), range(SAMPLES), 0)
    assert (rays.distances == np.float32(radius)).all()
    # Directions steeper than height / radius meet the plate: 1 - ∫ 2 cos dcos above it.
    exact = min(1.0, (height / radius) ** 2)
    np.testing.assert_allclose(shadowed_values(batch, 1).mean(axis=-1), exact, atol=1e-3)


@pytest.mark.parametrize("mapping", MAPPINGS)
def test_directions_below_the_triangle_are_zero_and_not_traced(device, mapping):
    tilted = unit([1.0, 0, 1.0])
    square = quad([-1, -1, 0], [2, 0, 0], [0, 2, 0])
    scene = mesh_scene(square, camera_at([1, 0, 3], [0, 0, 0], 20), normals=np.tile(tilted, (2, 3, 1)))
    points, source, rays = sampling(device, scene, AmbientOcclusion(mapping=mapping), (1, 1), SAMPLES)
    batch = source.draw(range(1), range(SAMPLES), 0)
    np.testing.assert_allclose(points.rows("normal")[:, 0], tilted, atol=1e-6)
    assert (rays.directions[:, 2] > 0).all()
    # Of the cosine-weighted hemisphere about a normal tilted by 45°, (1 + cos 45°) / 2 is above.
    np.testing.assert_allclose(shadowed_values(batch, 1).mean(), (1 + np.sqrt(0.5)) / 2, atol=1e-3)


def test_lights_occlude_and_are_shaded_themselves(device):
    light = light_at([-9, -9, 1], [0, 18, 0], [18, 0, 0])
    scene = mesh_scene(
        quad([-9, -9, 0], [18, 0, 0], [0, 18, 0]), camera_at([0, 0, 0.5], [1, 0, 0.5], 90), (light,)
    )
    points, source, _ = sampling(device, scene, AmbientOcclusion(1.0001), (4, 4), 256)
    assert points.active == points.total and set(points.light) == {-1, 0}
    values = shadowed_values(source.draw(range(points.active), range(256), 0), 1)
    np.testing.assert_allclose(values.mean(axis=-1), 1, atol=2e-2)
    points, source, _ = sampling(device, scene, AmbientOcclusion(5.0), (4, 4), 256)
    values = shadowed_values(source.draw(range(points.active), range(256), 0), 1)
    # A point far off sees out past the plate's edge no more than within its radius.
    np.testing.assert_allclose(values.mean(axis=-1), 1 / 25, atol=2e-2)


@pytest.mark.parametrize("radius", [0, -1, math.nan])
def test_a_bad_radius_is_refused(radius):
    with pytest.raises(IntegrandError, match="radius must be positive"):
        AmbientOcclusion(radius)


def test_an_unknown_mapping_is_refused_with_the_choices():
    with pytest.raises(IntegrandError, match="height, cosine, got 'sphere'"):
        AmbientOcclusion(mapping="sphere")


@pytest.mark.parametrize(
    "radius, height, dark", [(math.inf, 1, True), (0.5, 1, False), (math.inf, 10, False)]
)
def test_a_black_picture_names_the_radius(device, radius, height, dark):
    """Between plates nothing of the sky is seen; a far plate hides less of it."""
    scene, integrand = between_plates(height, radius, "height")
    options = {"method": "mc", "spp": 16, "size": (4, 4), "device": device}
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        image = render(scene, integrand, **options)
    assert (image.pixels.mean() < 0.05) == dark
    assert [("--radius" in str(one.message), one.filename == __file__) for one in said] == [
        (True,) * 2
    ] * dark


def test_a_small_object_that_is_lit_is_not_black(device):
    """What the camera sees of the background does not count."""
    scene = mesh_scene(quad([-1, -1, 0], [2, 0, 0], [0, 2, 0]), camera_at([0, 0, 20], [0, 0, 0], 60))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        image = render(scene, "ao", "mc", spp=4, size=(16, 16), device=device)
    assert 0 < image.pixels.mean() < 0.05
