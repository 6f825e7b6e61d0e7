"""The residual's magnitude: learned from residuals, and tabulated as a density."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from ncv_cl.learning.density import DensitySettings, DensityTrainer, tabulate
from ncv_cl.learning.train import TrainingSamples
from ncv_cl.network.encode import Encoding
from ncv_cl.network.network import NetworkDescription
from ncv_cl.opencl.memory import HostArray
from ncv_cl.sampling.warp import DENSITY_BINS, pack_records

BINS = DENSITY_BINS
POINTS, SAMPLES = 96, 32


def cells(u, v):
    return (u * BINS).astype(int) * BINS + (v * BINS).astype(int)


def edges_of(records):
    """The edges of all rows, in units."""
    return records[..., None].view(np.uint8).astype(int)


def learning_case(device, residual, features=7, points=POINTS, samples=SAMPLES):
    """A trainer whose network is zero, so that f itself is the residual; (features, u, v, f)."""
    generator = np.random.default_rng(3)
    description = NetworkDescription(
        Encoding(("position",), grid_levels=features, grid_features=1), 1, (4, 4), ()
    )
    shapes = {**description.group_shapes, "W2": (4, 4)}
    zeros = {
        name.lower(): HostArray.of(device, np.zeros(shape, np.float32)) for name, shape in shapes.items()
    }
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
    settings = DensitySettings(columns=128, samples_a_step=8, most_epochs=16)
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
    monkeypatch.setattr("ncv_cl.learning.density.Encoder", lambda *_: stored)
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
    wanted, found = (edges_of(table) for table in (pack_records(probability), density.table.read()))
    # Where rounding is a close call either neighbour is right.
    assert np.abs(found - wanted).max() <= 1 and np.mean(found != wanted) < 1e-3

    # Away from the step, which the predictor smooths.
    large, small = feature[0] > 3, feature[0] < -1
    strips = e.mean(axis=2)
    assert strips[large, : BINS // 2].mean() == pytest.approx(2.0, rel=0.1)
    assert strips[large, BINS // 2 :].mean() == pytest.approx(0.1, rel=0.2)
    assert strips[small, : BINS // 2].mean() == pytest.approx(0.5, rel=0.1)


def test_residuals_are_taken_against_the_network_and_in_the_points_units(device):
    """A constant network: f - g is known."""
    trainer, _, _, _, f = learning_case(device, lambda x, u, v: u + v, points=50)
    base = HostArray.of(device, np.array([0.75], np.float32))
    trainer._network.arrays = trainer._network.arrays | {"b3": base}
    unit = np.linspace(0, 2, 50, dtype=np.float32)
    found = trainer._squared_residuals(unit).read()[:, :50]
    expected = ((f - 0.75) / np.where(unit > 0, unit, np.inf)) ** 2
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-7)


def test_no_residual_leaves_a_density_that_works(one_device):
    trainer, *_ = learning_case(one_device, lambda x, u, v: 0 * u)
    assert np.isfinite(trainer.fit().parameters).all()
