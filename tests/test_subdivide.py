"""The subdivision of one network, and its pictures."""

from __future__ import annotations

import numpy as np
import OpenImageIO as oiio
import pytest
from rational import exact_cell_count, exact_integral, random_network
from test_certificate import TORTURE_NAMES, torture_network

from ncv_cl.integration.integrate import integrate
from ncv_cl.integration.subdivide import draw_subdivision, subdivide
from ncv_cl.opencl import program


def forward(network, points, slope=0.0):
    for k, (weight, bias) in enumerate(zip(*network, strict=True)):
        points = points @ weight.T.astype(float) + bias
        if k < len(network[0]) - 1:
            points = np.where(points < 0, slope * points, points)
    return points


@pytest.mark.parametrize(
    "widths", [(2, 3), (2, 6, 2), (2, 7, 8, 3), (2, 4, 5, 3, 20), (2, 3, 3, 3, 3, 1)]
)
def test_affine_functions_are_the_network(device, widths):
    network = random_network(widths, None, seed=1)
    result = subdivide(*network, device=device)
    assert np.abs(result.area).sum() == pytest.approx(1, abs=1e-12)
    for face, affine in zip(result.faces, result.affine, strict=True):
        corners = result.vertices[face].astype(float)
        inner = np.concatenate([corners, corners.mean(0, keepdims=True)])
        expected = forward(network, inner)
        np.testing.assert_allclose(inner @ affine[:, :2].T + affine[:, 2], expected, atol=1e-12)
    exact = [float(value) for value in exact_integral(*network)[0]]
    np.testing.assert_allclose(result.integral(), exact, atol=1e-12)


def test_faces_and_edges_are_those_of_the_arrangement(one_device):
    # Two crossing lines and one that misses the square; the second layer cuts nothing.
    weights = [np.array([[1.0, 0], [0, 1], [1, 1]]), np.eye(3), np.ones((1, 3))]
    biases = [np.array([-0.25, -0.5, 5]), np.full(3, 10.0), np.zeros(1)]
    result = subdivide(weights, biases, device=one_device)
    assert sorted(result.area) == pytest.approx([0.125, 0.125, 0.375, 0.375])
    assert len(result.vertices) == 9 and len(result.edges) == 12
    assert sorted(result.edge_layer) == [0] * 8 + [1] * 4


def test_as_many_faces_as_the_integral_visits(one_device):
    network = random_network((2, 16, 16, 1), None, seed=2)
    result = subdivide(*network, device=one_device)
    options = {"method": "full", "precision": "float64", "device": one_device}
    value, statistics = integrate(*network, return_stats=True, **options)
    assert len(result.faces) == statistics.faces
    np.testing.assert_allclose(result.integral(), value[0], atol=1e-12)
    assert set(result.edge_layer) == {0, 1, 2}


@pytest.mark.parametrize("precision", ["float32", "float64"])
@pytest.mark.parametrize("widths", [(2, 9, 1), (2, 8, 8, 2), (2, 5, 5, 5, 1), (2, 4, 4, 4, 4, 1)])
def test_as_many_faces_as_in_rational_arithmetic(one_device, widths, precision):
    for seed in range(4):
        network = random_network(widths, None, seed)
        result = subdivide(*network, precision=precision, device=one_device)
        assert len(result.faces) == exact_cell_count(*network)


def assert_is_a_subdivision(result, weights, biases, exact, scale):
    """Convex faces that cover the square, and the network's functions on them."""
    assert result.area.sum() == pytest.approx(1, abs=1e-6) and (result.area > 0).all()
    for face in result.faces:
        corners = result.vertices[face].astype(float)
        sides = np.roll(corners, -1, axis=0) - corners
        turns = np.cross(np.c_[sides, sides[:, :1] * 0], np.roll(np.c_[sides, sides[:, :1] * 0], -1, 0))
        lengths = np.linalg.norm(sides, axis=1)
        assert (turns[:, 2] >= -1e-6 * lengths.max()).all()
    assert (np.abs(result.integral() - exact) <= 2e-6 * scale).all()


@pytest.mark.parametrize("precision", ["float32", "float64"])
@pytest.mark.parametrize("name", TORTURE_NAMES)
def test_torture_networks(one_device, name, precision):
    weights, biases, exact, scale = torture_network(name)
    result = subdivide(weights, biases, precision=precision, device=one_device)
    assert_is_a_subdivision(result, weights, biases, exact, scale)


@pytest.mark.parametrize("widths", [(2, 9, 1), (2, 7, 6, 2), (2, 4, 5, 3, 1)])
def test_cutting_polygons_gives_the_same_faces(one_device, widths, monkeypatch):
    network = random_network(widths, None, seed=6)
    expected = subdivide(*network, device=one_device)
    original = program.source
    monkeypatch.setattr(program, "_programs", {})
    # No arrangement is certified.
    refuse = ("if (failed) return COUNT_WALK;", "return COUNT_WALK;")
    monkeypatch.setattr(program, "source", lambda files: original(files).replace(*refuse))
    found = subdivide(*network, device=one_device)
    assert len(found.faces) == len(expected.faces)
    np.testing.assert_allclose(np.sort(found.area), np.sort(expected.area), atol=1e-13)
    np.testing.assert_allclose(found.integral(), expected.integral(), atol=1e-13)
    assert set(found.edge_layer) == set(expected.edge_layer)
    border = found.vertices[found.edges[found.edge_layer == 0]]
    assert np.linalg.norm(border[:, 1] - border[:, 0], axis=1).sum() == pytest.approx(4)


def test_leaky_relu(one_device):
    network = random_network((2, 5, 4, 1), None, seed=3)
    result = subdivide(*network, activation="leaky_relu", negative_slope=0.2, device=one_device)
    means = np.array([result.vertices[face].mean(0) for face in result.faces])
    np.testing.assert_allclose(result.face_values(), forward(network, means, 0.2)[:, 0], atol=1e-12)


@pytest.mark.parametrize("suffix", ["svg", "png"])
def test_pictures(one_device, tmp_path, suffix):
    result = subdivide(*random_network((2, 6, 6, 1), None, seed=4), device=one_device)
    path = tmp_path / f"picture.{suffix}"
    draw_subdivision(result, path, size=64)
    if suffix == "svg":
        text = path.read_text()
        assert text.count("<polygon") == len(result.faces) and text.rstrip().endswith("</svg>")
    else:
        pixels = oiio.ImageBuf(str(path)).get_pixels(oiio.FLOAT)
        assert pixels.shape[:2] == (64, 64) and pixels.std() > 0.05


def test_a_png_shows_the_values_the_right_way_up(one_device, tmp_path):
    flat = subdivide([np.array([[0.0, 1.0]])], [np.zeros(1)], device=one_device)
    draw_subdivision(flat, tmp_path / "up.png", size=32)
    pixels = oiio.ImageBuf(str(tmp_path / "up.png")).get_pixels(oiio.FLOAT)
    assert pixels[4, 16, 1] > pixels[16, 16, 1] > pixels[28, 16, 1]


def test_bad_input_gets_a_clear_error(one_device, tmp_path):
    network = random_network((2, 3, 1), 2, seed=5)
    with pytest.raises(ValueError, match="one network"):
        subdivide(*network, device=one_device)
    result = subdivide(*random_network((2, 3, 1)), device=one_device)
    with pytest.raises(ValueError, match=r"must end in \.svg or \.png"):
        draw_subdivision(result, tmp_path / "picture.pdf")
    with pytest.raises(ValueError, match="channel 1 does not exist"):
        draw_subdivision(result, tmp_path / "picture.png", channel=1)
