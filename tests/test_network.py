"""Encoding, folding, inference, and networks as files."""

from __future__ import annotations

import network_reference as reference
import numpy as np
import pytest

from ncv_cl.device import HostArray
from ncv_cl.encode import Encoder, Encoding, GridCube, varying_inputs
from ncv_cl.integrands import AmbientOcclusion, DirectLight
from ncv_cl.network import FoldedNetwork, Network, NetworkDescription, NetworkError
from ncv_cl.points import find_points
from ncv_cl.scene import load_scene
from ncv_cl.trace import Tracer

ALL_INPUTS = ("position", "normal", "outgoing", "albedo", "roughness")


def knot_points(device, scenes, size=(13, 9)):
    scene = load_scene(scenes / "knot.toml")
    return scene, find_points(device, scene, Tracer(scene), *size)


def random_network(scene, inputs=ALL_INPUTS, hidden=(32, 32), channels=3, **grid):
    description = NetworkDescription(Encoding(inputs, **grid), channels, hidden)
    network = Network.random(description, GridCube.around(scene.bounds), seed=3)
    # A table as training leaves it, not near zero as it starts.
    network.table[...] = np.random.default_rng(4).normal(size=network.table.shape)
    return network


def evaluate(device, folded, u, v):
    """g from the kernel, (points, samples, channels)."""
    points, samples = u.shape
    channels = folded.network.description.channels
    value = HostArray(device, (channels, points, samples), np.float32)
    arrays = [HostArray.of(device, array) for array in (u, v)]
    items = points * samples // device.vector_width
    kernel = folded.program().kernel("evaluate")
    kernel(items, points, samples, *arrays, folded.folded, folded.parameters, value)
    return value.read().transpose(1, 2, 0)


@pytest.mark.parametrize("grid", [{}, {"grid_levels": 2, "grid_features": 4, "grid_entries": 64}])
@pytest.mark.parametrize("inputs", [("position",), ("position", "albedo"), ALL_INPUTS])
def test_features_match_reference(device, scenes, inputs, grid):
    scene, points = knot_points(device, scenes)
    network = random_network(scene, inputs, **grid)
    order = np.arange(points.active, dtype=np.uint32)[::-1].copy()
    encoding = network.description.encoding
    encoder = Encoder(device, encoding, points, network.cube, HostArray.of(device, order))
    encoder.encode_grid(HostArray.of(device, network.table))
    expected = reference.features(network, points)[:, ::-1]
    np.testing.assert_allclose(encoder.features.read()[:, : points.active], expected, atol=2e-4)


@pytest.mark.parametrize("hidden", [(32, 32), (8, 16), (17, 5), (1, 1)])
@pytest.mark.parametrize("channels", [1, 3])
def test_inference_matches_reference(device, scenes, hidden, channels):
    scene, points = knot_points(device, scenes)
    network = random_network(scene, hidden=hidden, channels=channels)
    folded = FoldedNetwork(device, network, points)
    u, v = np.random.default_rng(0).random((2, points.active, 32), np.float32)
    got = evaluate(device, folded, u, v)
    feature = reference.features(network, points)
    for sample in range(0, 32, 7):
        expected = reference.forward(network, feature, np.stack([u[:, sample], v[:, sample]]))
        np.testing.assert_allclose(got[:, sample].T, expected, rtol=1e-4, atol=1e-3)


def test_only_inputs_that_vary_are_fed(one_device, scenes):
    expected = {
        ("plane_light", DirectLight): ("position",),
        ("cornell_box", DirectLight): ("position", "normal", "albedo"),
        ("cornell_box", AmbientOcclusion): ("position", "normal"),
        ("knot", DirectLight): ALL_INPUTS,
    }
    for (name, integrand), inputs in expected.items():
        scene = load_scene(scenes / f"{name}.toml")
        points = find_points(one_device, scene, Tracer(scene), 24, 24)
        assert varying_inputs(points, integrand.inputs) == inputs, name


def test_saved_network_is_the_same_when_loaded(tmp_path, one_device, scenes):
    scene, _ = knot_points(one_device, scenes)
    network = random_network(scene, hidden=(8, 16))
    network.save(tmp_path / "network.npz")
    loaded = Network.load(tmp_path / "network.npz")
    assert loaded.description == network.description and loaded.cube == network.cube
    assert np.array_equal(loaded.parameters, network.parameters)
    assert np.array_equal(loaded.table, network.table)


def test_what_is_no_network_is_refused_by_name(tmp_path):
    np.savez(tmp_path / "other.npz", weights=np.ones(3))
    (tmp_path / "text.npz").write_text("hello")
    for name in ("other.npz", "text.npz", "missing.npz"):
        with pytest.raises(NetworkError, match=name):
            Network.load(tmp_path / name)
