"""Lines on lights behind a strip: closed forms, and how errors fall."""

from __future__ import annotations

import numpy as np
import pytest
from reference import (
    camera_at,
    grey,
    light_corners,
    mesh_scene,
    polygon_irradiance,
    quad,
    sampling,
    shadowed_values,
)
from test_shaft import FLOOR, LIGHTS

from ncv_cl.integrands import DirectLight


def clipped(polygon: np.ndarray, plane: np.ndarray) -> np.ndarray:
    """The part of a polygon (n, 3) where plane . x > 0 (Sutherland and Hodgman 1974)."""
    kept = []
    for a, b in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        below, above = plane @ a, plane @ b
        if below > 0:
            kept.append(a)
        if (below > 0) != (above > 0):
            kept.append(a + below / (below - above) * (b - a))
    return np.array(kept).reshape(-1, 3)


# A strip before the light, by the direction of its sides: across the lines, between, and along them.
SIDES = {"across": [1, 0, 0], "oblique": [1, 0, 0.6], "along": [0, 0, 1]}


def strip_pictures(device, side, spp):
    """Radiance of the floor by lines and by Lambert's formula, float64 (points,) each."""
    side = np.array(SIDES[side], float)
    half = 0.35 * np.array([-side[2], 0, side[0]])
    strip = quad(np.array([0.2, 1.5, 0.1]) - half - 50 * side, 2 * half, 100 * side)
    scene = mesh_scene(
        np.concatenate([FLOOR, strip]), camera_at([0, 1, 3], [0, -1, 0], 30), LIGHTS, (grey(),)
    )
    points, source, _ = sampling(device, scene, DirectLight(), (10, 8), spp, lines=True)
    floor = np.flatnonzero(points.rows("position")[1, : points.active] < -0.99)
    assert len(floor) > 40
    drawn = shadowed_values(source.draw(range(points.active), range(spp), 0), 3)[0].mean(axis=1)[floor]
    expected = []
    for position in points.rows("position").T[floor].astype(float):
        corners = light_corners(LIGHTS[0]) - position
        middle = np.array([0.2, 1.5, 0.1]) - position
        planes = [np.cross(middle + sign * half, side) * sign for sign in (-1, 1)]
        planes = [plane * np.sign(plane @ middle) for plane in planes]
        blocked = clipped(clipped(corners, planes[0]), planes[1])
        form = polygon_irradiance(corners, np.zeros(3), [0, 1, 0])
        form -= polygon_irradiance(blocked, np.zeros(3), [0, 1, 0]) if len(blocked) > 2 else 0
        expected.append(LIGHTS[0].radiance[0] * form * 0.5 / np.pi)
    return drawn, np.array(expected)


@pytest.mark.parametrize("side, rtol", [("across", 1e-4), ("oblique", 3e-4), ("along", 1e-2)])
def test_a_strip_before_the_light_by_lamberts_formula(device, side, rtol):
    drawn, expected = strip_pictures(device, side, 1024)
    np.testing.assert_allclose(drawn, expected, rtol=rtol)


@pytest.mark.parametrize("side", ["across", "oblique"])
def test_square_errors_fall_like_the_cube_of_lines(one_device, side):
    errors = [np.mean(np.square(np.subtract(*strip_pictures(one_device, side, n)))) for n in (16, 256)]
    # With points it is n to -1.5.
    assert errors[0] / errors[1] > 16**2.4
