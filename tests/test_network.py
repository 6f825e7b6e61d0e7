"""Encoding, folding, inference, and networks as files."""

from __future__ import annotations

import network_reference as reference
import numpy as np
import pytest

from ncv_cl.integrands import AmbientOcclusion, DirectLight
from ncv_cl.integration.integrator import Integrator
from ncv_cl.network.encode import Encoder, Encoding, GridCube, varying_inputs
from ncv_cl.network.fold import FoldedNetwork
from ncv_cl.network.network import WEIGHT_GROUPS, Network, NetworkDescription, NetworkError
from ncv_cl.opencl.memory import HostArray
from ncv_cl.points.points import find_points
from ncv_cl.points.trace import Tracer
from ncv_cl.scene.load import load_scene

ALL_INPUTS = ("position", "normal", "outgoing", "albedo", "roughness")


def knot_points(device, scenes, size=(13, 9)):
    scene = load_scene(scenes / "knot.toml")
    return scene, find_points(device, scene, Tracer(scene), *size)


def random_network(
    scene,
    inputs=ALL_INPUTS,
    hidden=(16, 16),
    channels=3,
    modulated=WEIGHT_GROUPS,
    demodulated=False,
    **grid,
):
    encoding = Encoding(inputs, **grid)
    description = NetworkDescription(encoding, channels, hidden, modulated, demodulated)
    network = Network.random(description, GridCube.around(scene.bounds), seed=3)
    # Numbers as training leaves them: the table not near zero, no neuron exactly on its kink.
    generator = np.random.default_rng(4)
    network.table[...] = generator.normal(size=network.table.shape)
    network.parameters[...] += generator.normal(size=network.parameters.shape) * 0.02
    return network


def evaluate(device, folded, u, v):
    """g from the kernel, (points, samples, channels)."""
    points, samples = u.shape
    channels = folded.network.description.channels
    value = HostArray(device, (channels, points, samples), np.float32)
    folded.program().kernel("evaluate")(
        points * samples // device.vector_width,
        first_point=0,
        point_count=points,
        stride=samples,
        u=HostArray.of(device, u),
        v=HostArray.of(device, v),
        **folded.arrays,
        value=value,
    )
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


@pytest.mark.parametrize("hidden", [(16, 16), (32, 32), (8, 16), (17, 5), (1, 1)])
@pytest.mark.parametrize("modulated", [WEIGHT_GROUPS, ("B1",), ("W1", "B1", "W3"), ()])
def test_inference_matches_reference(device, scenes, hidden, modulated):
    scene, points = knot_points(device, scenes)
    network = random_network(scene, hidden=hidden, modulated=modulated)
    folded = FoldedNetwork(device, network, points)
    u, v = np.random.default_rng(0).random((2, points.active, 32), np.float32)
    expected = reference.forward(network, reference.features(network, points), np.stack([u, v]))
    got = evaluate(device, folded, u, v).transpose(2, 0, 1)
    np.testing.assert_allclose(got, expected, rtol=1e-4, atol=1e-5 * np.abs(expected).max())


@pytest.mark.parametrize("channels", [1, 3])
def test_a_demodulated_network_is_multiplied_by_the_factor(device, scenes, channels):
    scene, points = knot_points(device, scenes)
    plain = random_network(scene, channels=channels)
    network = random_network(scene, channels=channels, demodulated=True)
    factor = np.random.default_rng(1).random((channels, points.active), np.float32)
    folded = FoldedNetwork(device, network, points, HostArray.of(device, factor))
    u, v = np.random.default_rng(0).random((2, points.active, 16), np.float32)
    expected = evaluate(device, FoldedNetwork(device, plain, points), u, v) * factor.T[:, None]
    got = evaluate(device, folded, u, v)
    np.testing.assert_allclose(got, expected, rtol=1e-4, atol=1e-5 * np.abs(expected).max())


def test_a_factor_is_asked_for_exactly_where_it_is_needed(one_device, scenes):
    scene, points = knot_points(one_device, scenes)
    with pytest.raises(NetworkError, match="factor"):
        FoldedNetwork(one_device, random_network(scene, demodulated=True), points)


@pytest.mark.parametrize("modulated", [WEIGHT_GROUPS, ("B1",)])
def test_the_exact_integral_is_that_of_the_folded_network(device, scenes, modulated):
    scene, points = knot_points(device, scenes, (5, 4))
    network = random_network(scene, hidden=(8, 16), modulated=modulated)
    folded = FoldedNetwork(device, network, points)
    weights_per_point, biases_per_point = folded.per_point
    integrator = Integrator(
        device,
        widths=(2, 8, 16, 3),
        per_point_weights=weights_per_point,
        per_point_biases=biases_per_point,
    )
    integral = HostArray(device, (points.active, 3), np.float32)
    integrator.run(*folded.layers(), integral)
    grid = (np.arange(256) + 0.5) / 256
    uv = np.stack(np.meshgrid(grid, grid)).reshape(2, 1, -1) * np.ones((1, points.active, 1))
    dense = reference.forward(network, reference.features(network, points), uv)
    scale = np.abs(dense).mean()
    np.testing.assert_allclose(integral.read(), dense.mean(-1).T, atol=1e-4 * scale)


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
