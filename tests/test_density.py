"""Densities: points follow them, they integrate to one, and they are learned from residuals."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from reference import camera_at, light_at, mesh_scene, quad
from scipy import stats

from ncv_cl.density import DensitySettings, DensityTrainer, tabulate
from ncv_cl.device import HostArray
from ncv_cl.encode import Encoding
from ncv_cl.integrands import DirectLight
from ncv_cl.network import NetworkDescription
from ncv_cl.points import find_points
from ncv_cl.sampler import Stream
from ncv_cl.samples import DENSITY_BINS, DENSITY_FLOATS, SampleSource, TableWarp
from ncv_cl.trace import Tracer
from ncv_cl.train import TrainingSamples

BINS = DENSITY_BINS
POINTS, SAMPLES = 96, 32


def records(probability):
    """The records that warp.cl reads, float32, of cell probabilities (points, BINS, BINS)."""
    strips = probability.sum(axis=2)
    found = np.zeros((len(probability), BINS + 1, BINS + 1))
    found[:, 0, 1:] = np.cumsum(strips, axis=1)
    found[:, 1:, 1:] = np.cumsum(probability / strips[..., None], axis=2)
    found[..., -1] = 1
    return found.reshape(len(probability), DENSITY_FLOATS).astype(np.float32)


def random_probabilities(points, seed=1):
    """Of all kinds: uniform, peaked, with cells of almost no probability."""
    weight = np.random.default_rng(seed).gamma(0.3, size=(points, BINS, BINS)) + 1e-3
    weight[0] = 1
    return weight / weight.sum(axis=(1, 2), keepdims=True)


@pytest.fixture
def plane():
    light = light_at([-1, -1, 2], [0, 2, 0], [2, 0, 0], (1, 1, 1))
    return mesh_scene(
        quad([-1, -1, 0], [2, 0, 0], [0, 2, 0]), camera_at([0, 0, 1.5], [0, 0, 0]), (light,)
    )


def warped(device, scene, sampler, probability, samples):
    """u, v and weights (points, samples) drawn by the densities of `probability`."""
    tracer = Tracer(scene, 1)
    points = find_points(device, scene, tracer, 6, 6)
    assert points.active >= len(probability)
    source = SampleSource(device, scene, tracer, points, DirectLight(), sampler, 5, samples)
    padded = np.broadcast_to(probability[:1], (points.active, BINS, BINS)).copy()
    padded[: len(probability)] = probability
    density = TableWarp(HostArray.of(device, records(padded)))
    batch = source.draw(range(len(probability)), range(samples), Stream.RESIDUAL, None, density)
    shape = (len(probability), batch.stride)
    return [
        array.read()[: shape[0] * shape[1]].reshape(shape)[:, :samples]
        for array in (batch.u, batch.v, batch.weight)
    ]


def cells(u, v):
    return (u * BINS).astype(int) * BINS + (v * BINS).astype(int)


def test_independent_points_follow_the_density(device, plane):
    probability = random_probabilities(4)
    u, v, _ = warped(device, plane, "independent", probability, 20000)
    for own_u, own_v, expected in zip(u, v, probability.reshape(4, -1), strict=True):
        counts = np.bincount(cells(own_u, own_v), minlength=BINS**2)
        # Cells with few expected points are lumped, as the test's approximation asks.
        large = expected * 20000 > 8
        observed = np.append(counts[large], counts[~large].sum())
        wanted = np.append(expected[large], expected[~large].sum()) * 20000
        keep = wanted > 0
        assert stats.chisquare(observed[keep], wanted[keep], sum_check=False).pvalue > 1e-4
        # And within a cell they are uniform.
        for coordinate in (own_u, own_v):
            assert stats.kstest(coordinate * BINS % 1, "uniform").pvalue > 1e-4


@pytest.mark.parametrize("sampler", ["independent", "sobol"])
def test_weights_are_one_over_the_density(device, plane, sampler):
    probability = random_probabilities(4)
    u, v, weight = warped(device, plane, sampler, probability, 512)
    assert ((u >= 0) & (u < 1) & (v >= 0) & (v < 1)).all()
    density = np.take_along_axis(probability.reshape(4, -1), cells(u, v), axis=1) * BINS**2
    np.testing.assert_allclose(weight * density, 1, rtol=1e-4)


def test_the_density_of_a_record_integrates_to_one():
    record = records(random_probabilities(50)).astype(np.float64).reshape(50, BINS + 1, BINS + 1)
    mass = np.diff(record[:, 0], axis=1)[..., None] * np.diff(record[:, 1:], axis=2)
    np.testing.assert_allclose(mass.sum(axis=(1, 2)), 1, atol=1e-6)


def test_a_uniform_density_changes_nothing(device, plane):
    probability = np.full((2, BINS, BINS), 1 / BINS**2)
    u, v, weight = warped(device, plane, "sobol", probability, 64)
    tracer = Tracer(plane, 1)
    points = find_points(device, plane, tracer, 6, 6)
    source = SampleSource(device, plane, tracer, points, DirectLight(), "sobol", 5, 64)
    batch = source.draw(range(2), range(64), Stream.RESIDUAL)
    for warped_one, plain in ((u, batch.u), (v, batch.v)):
        np.testing.assert_allclose(warped_one, plain.read()[:128].reshape(2, 64), atol=2e-7)
    np.testing.assert_allclose(weight, 1, rtol=1e-6)


def test_sobol_points_stay_spread_over_the_strips(device, plane):
    probability = random_probabilities(4)
    u, _, _ = warped(device, plane, "sobol", probability, 256)
    for own, expected in zip(u, probability.sum(axis=2), strict=True):
        counts = np.bincount((own * BINS).astype(int), minlength=BINS)
        # A strip is an interval of the unwarped axis, and each of 256 equal ones holds one point.
        assert (np.abs(counts - 256 * expected) <= 2).all()


# ---- learning --------------------------------------------------------------------------------------


def learning_case(device, residual, features=7, points=POINTS, samples=SAMPLES):
    """A trainer whose network is zero, so that f itself is the residual; (features, u, v, f)."""
    generator = np.random.default_rng(3)
    description = NetworkDescription(
        Encoding(("position",), grid_levels=features, grid_features=1), 1, (4, 4), ()
    )
    shapes = {**description.group_shapes, "W2": (4, 4)}
    zeros = [
        HostArray.of(device, np.zeros(shapes[n], np.float32))
        for n in ("W1", "B1", "W2", "B2", "W3", "B3")
    ]
    network = SimpleNamespace(network=SimpleNamespace(description=description), arrays=zeros)
    stride = -(-points // 16) * 16
    feature = np.zeros((features, stride), np.float32)
    feature[:, :points] = generator.normal(size=(features, points)) * 3 + 1
    u, v = generator.uniform(size=(2, samples, stride)).astype(np.float32)
    target = residual(feature, u, v).astype(np.float32)[:, None]
    order = np.arange(points, dtype=np.uint32)
    stored = TrainingSamples(
        HostArray.of(device, order),
        *(HostArray.of(device, array) for array in (u, v, target)),
        SimpleNamespace(features=HostArray.of(device, feature), stride=stride),
    )
    settings = DensitySettings(columns=128, samples_a_step=8, most_passes=16)
    trainer = DensityTrainer(device, network, stored, None, settings)
    return trainer, feature[:, :points], u[:, :points], v[:, :points], target[:, 0, :points]


def units_and_rows(network_parameters, x, hidden):
    """Hidden units (points, hidden), rows (cells, hidden), biases (cells,) of the predictor."""
    parameters, features = network_parameters.astype(np.float64), len(x)
    weights = parameters[: features * hidden].reshape(features, hidden)
    bias = parameters[features * hidden : (features + 1) * hidden]
    rest = parameters[(features + 1) * hidden :]
    units = np.maximum(x.T @ weights + bias, 0)
    return units, rest[: BINS**2 * hidden].reshape(BINS**2, hidden), rest[BINS**2 * hidden :]


def loss(parameters, x, cell, squared, hidden):
    """Mean of r² / e + e over samples (samples, points)."""
    units, rows, offsets = units_and_rows(parameters, x, hidden)
    e = np.exp(np.einsum("iu,siu->si", units, rows[cell]) + offsets[cell])
    return np.mean(squared / e + e)


def test_gradients_match_finite_differences(device):
    trainer, feature, u, v, f = learning_case(device, lambda x, u, v: u + 0.3 * x[0])
    groups = trainer.gradients(8, 0, POINTS)
    found = trainer._partial.read()[:groups].sum(axis=0, dtype=np.float64)
    parameters = trainer._parameters.read().astype(np.float64)
    normalised = (feature - trainer._mean.read()[:, None]) * trainer._scale.read()[:, None]
    part = slice(8, 16)
    squared = f[part].astype(np.float64) ** 2 / np.mean(f.astype(np.float64) ** 2)
    arguments = (
        normalised.astype(np.float64),
        cells(u[part], v[part]),
        squared,
        trainer.settings.hidden,
    )
    for p in np.random.default_rng(0).choice(len(parameters), 80, replace=False):
        step = np.zeros(len(parameters))
        step[p] = 1e-5
        slope = (loss(parameters + step, *arguments) - loss(parameters - step, *arguments)) / 2e-5
        assert found[p] == pytest.approx(slope, abs=2e-5 * np.abs(found).max())


def test_the_magnitude_is_learned_and_tabulated(device, monkeypatch):
    def residual(x, u, v):
        sign = np.random.default_rng(9).choice([-1, 1], u.shape)
        return sign * np.where(u < 0.5, 1.0, 0.05) * np.where(x[0] > 1, 2.0, 0.5)

    points = 1024
    trainer, feature, *_ = learning_case(device, residual, points=points)
    learned = trainer.fit()
    stored = trainer._samples.encoder
    monkeypatch.setattr("ncv_cl.density.Encoder", lambda *_: stored)
    stored.encode_grid = lambda table: None
    network = SimpleNamespace(
        description=trainer._network.network.description, table=np.zeros((1, 1), np.float32), cube=None
    )
    unit = np.linspace(1, 3, points, dtype=np.float32)
    density = tabulate(device, learned, network, SimpleNamespace(active=points), unit)

    normalised = (feature - learned.feature_mean[:, None]) * learned.feature_scale[:, None]
    units, rows, offsets = units_and_rows(learned.parameters, normalised, learned.settings.hidden)
    e = (np.exp(units @ rows.T + offsets) * learned.unit).reshape(points, BINS, BINS)
    np.testing.assert_allclose(density.magnitude, e.mean(axis=(1, 2)) * unit, rtol=1e-4)
    share = learned.settings.uniform_share
    probability = (1 - share) * e / e.sum(axis=(1, 2), keepdims=True) + share / BINS**2
    np.testing.assert_allclose(density.table.read(), records(probability), atol=1e-5)

    # Away from the step, which the predictor smooths.
    large, small = feature[0] > 3, feature[0] < -1
    strips = e.mean(axis=2)
    assert strips[large, : BINS // 2].mean() == pytest.approx(2.0, rel=0.1)
    assert strips[large, BINS // 2 :].mean() == pytest.approx(0.1, rel=0.2)
    assert strips[small, : BINS // 2].mean() == pytest.approx(0.5, rel=0.1)


def test_residuals_are_taken_against_the_network_and_in_the_points_units(device):
    """A constant network: f - g is known."""
    trainer, _, _, _, f = learning_case(device, lambda x, u, v: u + v, points=50)
    arrays = list(trainer._network.arrays)
    arrays[5] = HostArray.of(device, np.array([0.75], np.float32))
    trainer._network.arrays = arrays
    unit = np.linspace(0, 2, 50, dtype=np.float32)
    found = trainer._squared_residuals(unit).read()[:, :50]
    expected = ((f - 0.75) / np.where(unit > 0, unit, np.inf)) ** 2
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-7)


def test_no_residual_leaves_a_density_that_works(one_device):
    trainer, *_ = learning_case(one_device, lambda x, u, v: 0 * u)
    assert np.isfinite(trainer.fit().parameters).all()
