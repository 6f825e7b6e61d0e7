"""Networks that break geometry code, against rational arithmetic."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rational import exact_integral, hard_networks, point_network, random_network, relative_errors

from ncv_cl.integrate import integrate
from ncv_cl.integrator import METHODS

LIMIT = {"float32": 1e-6, "float64": 1e-13}
HARD = hard_networks()


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("precision", list(LIMIT))
@pytest.mark.parametrize("name", list(HARD))
def test_hard_networks(one_device, name, precision, method):
    network = HARD[name]
    if precision == "float64" and not one_device.has_float64:
        pytest.skip("no double precision")
    options = {"method": method, "precision": precision, "device": one_device}
    values, statistics = integrate(*network, return_stats=True, **options)
    assert statistics.uncertified_points == 0
    for point, row in enumerate(values):
        assert relative_errors(row, *point_network(network, point)).max() <= LIMIT[precision]


@pytest.mark.parametrize("name", ["one ulp apart", "borders and corners", "through the centre"])
def test_hard_networks_in_every_shape_of_device(device, name):
    for method in METHODS:
        values = integrate(*HARD[name], method=method, device=device)
        for point, row in enumerate(values):
            assert relative_errors(row, *point_network(HARD[name], point)).max() <= LIMIT["float32"]


def _mangle(rng, network, decades):
    """Duplicates, concurrences, zeros and scales, drawn at random."""
    weights, biases = network
    for p in range(len(biases[0])):
        lines = np.concatenate([weights[0][p], biases[0][p][:, None]], 1)
        for k in range(1, len(lines)):
            kind = rng.integers(6)
            if kind == 0:
                lines[k] = lines[k - 1] * rng.choice([-1, 1])
            elif kind == 1:
                lines[k, :2] = lines[k - 1, :2]
            elif kind == 2:
                lines[k] = np.nextafter(lines[k - 1], np.float32(rng.choice([-9, 9])))
            elif kind == 3:
                lines[k, rng.integers(3)] = 0
        weights[0][p], biases[0][p] = lines[:, :2], lines[:, 2]
    for array in (*weights, *biases):
        array *= np.float32(10.0 ** rng.uniform(-decades, decades))
    return network


def evaluation_rounding(weights, biases):
    """What single precision loses in the last hidden layer's values alone, on the same relative scale.

    Where large products cancel, z = Σ w h + b is off by an ulp of its terms and not of itself: no
    integration of z, however exact, can do better. Terms are averaged over a grid, where z > 0.
    """
    centres = (np.arange(64) + 0.5) / 64
    h = np.stack(np.meshgrid(centres, centres)).reshape(2, -1)
    *hidden, last = [
        (w.astype(float), b.astype(float)[:, None]) for w, b in zip(weights, biases, strict=True)
    ]
    for w, b in hidden[:-1]:
        h = np.maximum(w @ h + b, 0)
    w, b = hidden[-1]
    terms = np.mean((w @ h + b > 0) * (np.abs(w) @ h + np.abs(b)), axis=1)
    scale = np.array([float(one) for one in exact_integral(weights, biases)[1]])
    return 4 * 2.0**-24 * np.abs(last[0]) @ terms / np.where(scale > 0, scale, 1)


# One shape, so that one program serves all examples; 20 networks an example, 1000 in all.
@settings(max_examples=50, deadline=None, suppress_health_check=list(HealthCheck))
@given(seed=st.integers(0, 2**32 - 1), decades=st.sampled_from([0.0, 4.0]))
def test_a_thousand_random_networks(one_device, seed, decades):
    network = random_network((2, 5, 4, 1), 20, seed)
    network = _mangle(np.random.default_rng(seed), network, decades)
    by_method = [integrate(*network, method=method, device=one_device) for method in METHODS]
    for point in range(20):
        weights, biases = point_network(network, point)
        limit = LIMIT["float32"]
        # Weights over eight decades cancel as no others do.
        if decades:
            limit = limit + evaluation_rounding(weights, biases)
        for values in by_method:
            assert np.all(relative_errors(values[point], weights, biases) <= limit)


# Tiny faces at a corner beside the rest of the square: interpolation from the far end of an edge, a sum
# that cancels, or a neuron that is not 0 on its own line once made these wrong without a word.
@pytest.mark.parametrize("seed, point", [(15, 12), (46, 4), (48, 7), (64, 19), (31, 0)])
@pytest.mark.parametrize("method", METHODS)
def test_small_faces_at_a_corner(one_device, method, seed, point):
    network = random_network((2, 5, 4, 1), 20, seed)
    network = _mangle(np.random.default_rng(seed), network, 4.0)
    value = integrate(*network, method=method, device=one_device)[point]
    assert relative_errors(value, *point_network(network, point)).max() <= LIMIT["float32"]
