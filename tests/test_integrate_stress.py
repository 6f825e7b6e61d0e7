"""Networks that break geometry code, against rational arithmetic."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rational import hard_networks, point_network, random_network, relative_errors

from ncv_cl.integration.integrate import integrate
from ncv_cl.integration.integrator import INTEGRATION_METHODS

LIMIT = {"float32": 1e-6, "float64": 1e-13}
HARD = hard_networks()


@pytest.mark.parametrize("method", INTEGRATION_METHODS)
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
    for method in INTEGRATION_METHODS:
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


# One shape, so that one program serves all examples of 20 networks: a thousand in all, always the same.
# With `--hypothesis-profile explore` they are others, and more (conftest.py).
@settings(deadline=None, suppress_health_check=list(HealthCheck))
@given(seed=st.integers(0, 2**32 - 1), decades=st.sampled_from([0.0, 4.0]))
def test_a_thousand_random_networks(one_device, seed, decades):
    network = random_network((2, 5, 4, 1), 20, seed)
    network = _mangle(np.random.default_rng(seed), network, decades)
    for method in INTEGRATION_METHODS:
        values = integrate(*network, method=method, device=one_device)
        for point, row in enumerate(values):
            assert relative_errors(row, *point_network(network, point)).max() <= LIMIT["float32"]


# Once off by 3.6e-6: what single precision loses where weights over eight decades cancel.
@pytest.mark.parametrize("method", INTEGRATION_METHODS)
def test_cancellation_over_eight_decades(one_device, method):
    network = _mangle(np.random.default_rng(49420), random_network((2, 5, 4, 1), 20, 49420), 4.0)
    for point, row in enumerate(integrate(*network, method=method, device=one_device)):
        assert relative_errors(row, *point_network(network, point)).max() <= LIMIT["float32"]


# Tiny faces at a corner beside the rest of the square: interpolation from the far end of an edge, a sum
# that cancels, or a neuron that is not 0 on its own line once made these wrong without a word.
@pytest.mark.parametrize("seed, point", [(15, 12), (46, 4), (48, 7), (64, 19), (31, 0)])
@pytest.mark.parametrize("method", INTEGRATION_METHODS)
def test_small_faces_at_a_corner(one_device, method, seed, point):
    network = random_network((2, 5, 4, 1), 20, seed)
    network = _mangle(np.random.default_rng(seed), network, 4.0)
    value = integrate(*network, method=method, device=one_device)[point]
    assert relative_errors(value, *point_network(network, point)).max() <= LIMIT["float32"]
