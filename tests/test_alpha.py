"""The control coefficient: what it is, and that the network is skipped where it is zero."""

from __future__ import annotations

import network_reference as reference
import numpy as np
import pytest
from test_network import knot_points
from test_train import prepare

from ncv_cl.estimation.control_variate import integrals_of
from ncv_cl.integrands import DirectLight
from ncv_cl.learning.alpha import (
    _column_moments,
    can_scale,
    control_coefficients,
    scale,
)
from ncv_cl.learning.tuning import LARGEST_COEFFICIENT, PSEUDO_SAMPLES, SMALLEST_COEFFICIENT
from ncv_cl.network.fold import FoldedNetwork
from ncv_cl.points.sampler import Stream
from ncv_cl.points.trace import Tracer
from ncv_cl.sampling.accumulate import Accumulator
from ncv_cl.sampling.samples import SampleSource
from ncv_cl.settings.schedule import Schedule

SETTINGS = Schedule(batch=16, epochs=64)
COLUMNS = 10_000  # Wider than the image: all points lie in one row of tiles.


def trained(device, scenes, samples=16):
    trainer, _, (points, chosen), uv, f, _ = prepare(device, scenes, SETTINGS, samples=samples)
    trainer.fit()
    network = trainer.network()
    return trainer, network, points, chosen, uv, f


def test_coefficients_are_covariance_over_variance_shrunk_towards_one(device, scenes, monkeypatch):
    monkeypatch.setattr("ncv_cl.learning.tuning.SAMPLES_A_TILE", 1 << 30)
    trainer, network, points, chosen, uv, f = trained(device, scenes)
    folded = FoldedNetwork(device, network, points)
    found = control_coefficients(folded, trainer.samples_of(network), points, COLUMNS)
    g = reference.forward(network, reference.features(network, points)[:, chosen], uv)
    g -= g.mean(axis=2, keepdims=True)
    f = f - f.mean(axis=2, keepdims=True)
    best = (f * g).sum(axis=(1, 2)) / (g * g).sum(axis=(1, 2))
    seen = f[0].size
    expected = np.clip(1 + (best - 1) * seen / (seen + PSEUDO_SAMPLES), 0, LARGEST_COEFFICIENT)
    np.testing.assert_allclose(found, np.broadcast_to(expected[:, None], found.shape), rtol=1e-4)


def test_moments_of_each_column_match_float64(device, scenes):
    trainer, network, points, _, uv, f = trained(device, scenes)
    samples = trainer.samples_of(network)
    order = samples.order.read()
    at = np.argsort(np.argsort(order))
    feature = reference.features(network, points)
    g = reference.forward(network, feature[:, np.sort(order)], uv)[:, at]
    g -= g.mean(axis=2, keepdims=True)
    f = (f - f.mean(axis=2, keepdims=True))[:, at]
    found = _column_moments(FoldedNetwork(device, network, points), samples)
    for moment, expected in zip(found, ((f * g).sum(axis=2), (g * g).sum(axis=2)), strict=True):
        np.testing.assert_allclose(moment, expected, rtol=1e-4, atol=1e-5 * np.abs(expected).max())


def test_a_network_that_is_twice_too_large_is_halved(one_device, scenes, monkeypatch):
    monkeypatch.setattr("ncv_cl.learning.tuning.SAMPLES_A_TILE", 1 << 30)
    trainer, network, points, chosen, *_ = trained(one_device, scenes)
    samples = trainer.samples_of(network)
    folded = FoldedNetwork(one_device, network, points)
    once = control_coefficients(folded, samples, points, COLUMNS)
    scale(folded, np.full_like(once, 2.0))
    twice = control_coefficients(folded, samples, points, COLUMNS)
    shrinking = PSEUDO_SAMPLES / (16 * len(chosen) + PSEUDO_SAMPLES)
    np.testing.assert_allclose(twice, once / 2 + shrinking / 2, rtol=1e-4)


def test_a_network_that_says_the_opposite_counts_as_nothing(one_device, scenes, monkeypatch):
    monkeypatch.setattr("ncv_cl.learning.tuning.SAMPLES_A_TILE", 1 << 30)
    trainer, network, points, *_ = trained(one_device, scenes)
    folded = FoldedNetwork(one_device, network, points)
    scale(folded, np.full((3, points.active), -1.0, np.float32))
    found = control_coefficients(folded, trainer.samples_of(network), points, COLUMNS)
    assert SMALLEST_COEFFICIENT > 0 and not found.any()


def test_points_without_training_samples_keep_the_network(one_device, scenes, monkeypatch):
    monkeypatch.setattr("ncv_cl.learning.tuning.SAMPLES_A_TILE", 0)
    trainer, network, points, chosen, *_ = trained(one_device, scenes)
    folded = FoldedNetwork(one_device, network, points)
    found = control_coefficients(folded, trainer.samples_of(network), points, COLUMNS)
    others = np.setdiff1d(np.arange(points.active), chosen)
    assert np.all(found[:, others] == 1) and not np.all(found[:, chosen] == 1)


@pytest.mark.parametrize("modulated", [("B1",), ("W3", "B3")])
def test_only_networks_with_an_output_layer_of_each_point_take_coefficients(
    one_device, scenes, modulated
):
    _, network, (points, _), *_ = prepare(one_device, scenes, SETTINGS, modulated=modulated)
    assert can_scale(FoldedNetwork(one_device, network, points)) == (modulated == ("W3", "B3"))


def test_a_coefficient_of_zero_leaves_plain_monte_carlo(device, scenes):
    """Integral and g are exactly zero at half the points, and what they were at the others."""
    _, network, points, *_ = trained(device, scenes)
    whole, halved = (FoldedNetwork(device, network, points) for _ in range(2))
    alpha = np.ones((3, points.active), np.float32)
    alpha[:, ::2] = 0.0
    scale(halved, alpha)
    expected, found = (integrals_of(device, folded, points.active) for folded in (whole, halved))
    np.testing.assert_array_equal(found, expected * alpha)

    scene, _ = knot_points(device, scenes)
    source = SampleSource(device, scene, Tracer(scene), points, DirectLight(), "sobol", 3, 16)
    results = []
    for folded in (whole, halved):
        accumulator = Accumulator(device, points, 3, folded)
        for part in source.batches():
            accumulator.add(source.draw(part, range(16), Stream.RESIDUAL))
        accumulator.finish_pass(16)
        results.append((accumulator.result(0).mean, accumulator.result(1).mean))
    (plain, residual), (_, found) = results
    np.testing.assert_array_equal(found[:, ::2], plain[:, ::2])
    np.testing.assert_array_equal(found[:, 1::2], residual[:, 1::2])
