"""Training: gradients against finite differences, the gather index, and what a run must do."""

from __future__ import annotations

import network_reference as reference
import numpy as np
import pytest
from test_network import ALL_INPUTS, knot_points, random_network

from ncv_cl.integrands import DirectLight
from ncv_cl.sampler import Stream
from ncv_cl.samples import SampleSource
from ncv_cl.trace import Tracer
from ncv_cl.train import Trainer, TrainSettings

# With so large an epsilon the first Adam step is the gradient times rate / epsilon.
STEP = 100.0
PLAIN = TrainSettings(batch=1 << 20, rate=1e8, epsilon=1e6, average_decay=0.0)


def prepare(device, scenes, settings, samples=1, **description):
    """A trainer that holds samples of the knot, with those samples: u, v and f by point."""
    scene, points = knot_points(device, scenes)
    network = random_network(scene, **description)
    source = SampleSource(device, scene, Tracer(scene), points, DirectLight(), "independent", 5, samples)
    trainer = Trainer(device, network, points, settings, samples, seed=11)
    (batch_points,) = source.point_batches()
    batch = source.draw(batch_points, range(samples), Stream.TRAINING)
    trainer.store(batch)
    shape = (points.active, batch.stride)
    size = points.active * batch.stride
    slot = batch.slot.read()[:size]
    visible = np.append(batch.visible.read(), 0)[np.minimum(slot, len(batch.visible.read()))]
    value = batch.value.read().ravel()[: 3 * size].reshape(3, size) * (visible * (slot != 0xFFFFFFFF))
    uv = np.stack([batch.u.read()[:size], batch.v.read()[:size]]).reshape(2, *shape)
    return trainer, network, points, uv[:, :, :samples], value.reshape(3, *shape)[:, :, :samples]


def loss(network, points, uv, f, scale, parameters=None, table=None):
    feature = reference.features(network, points, table)
    value = reference.forward(network, feature, uv, parameters)
    return np.mean((value - scale * f) ** 2)


def central_difference(function, at, index, step=1e-5):
    high, low = at.astype(float), at.astype(float)
    high.flat[index] += step
    low.flat[index] -= step
    return (function(high) - function(low)) / (2 * step)


@pytest.mark.parametrize("hidden", [(32, 32), (8, 16), (64, 24)])
@pytest.mark.parametrize("inputs", [("position",), ALL_INPUTS])
def test_gradients_match_finite_differences(device, scenes, hidden, inputs):
    trainer, network, points, uv, f = prepare(
        device, scenes, PLAIN, hidden=hidden, inputs=inputs, grid_entries=256
    )
    uv, f = uv[:, :, 0].astype(float), f[:, :, 0].astype(float)
    scale = 1 / np.mean(f)
    reported = trainer.fit(1)
    assert reported == pytest.approx(loss(network, points, uv, f, scale), rel=1e-4)
    trained = trainer.network()
    after = network.description.unpack(trained.parameters.astype(float))
    before = network.description.unpack(network.parameters.astype(float))
    for name in ("W3", "B3"):
        after[name] *= scale
    generator = np.random.default_rng(0)
    start = 0
    for name, old in before.items():
        got = (old - after[name]) / STEP
        picks = generator.choice(old.size, min(old.size, 8), replace=False)
        expected = [
            central_difference(
                lambda parameters: loss(network, points, uv, f, scale, parameters),
                network.parameters,
                start + index,
            )
            for index in picks
        ]
        tolerance = 2e-3 * np.abs(got).max()
        np.testing.assert_allclose(got.flat[picks], expected, atol=tolerance, err_msg=name)
        start += old.size

    got = (network.table.astype(float) - trained.table) / STEP
    assert np.count_nonzero(got) > 0
    picks = np.argsort(-np.abs(got).ravel())[[0, 3, 9, 27, 81]]
    expected = [
        central_difference(
            lambda table: loss(network, points, uv, f, scale, None, table), network.table, index
        )
        for index in picks
    ]
    np.testing.assert_allclose(got.flat[picks], expected, atol=2e-3 * np.abs(got).max())


def test_untouched_grid_entries_keep_their_value(one_device, scenes):
    trainer, network, points, _, _ = prepare(one_device, scenes, PLAIN, grid_entries=4096)
    trainer.fit(1)
    touched = np.zeros(len(network.table), bool)
    position = points.rows("position")[:, : points.active].astype(float)
    touched[reference.corners(network, position)[0].ravel()] = True
    changed = np.any(trainer.network().table != network.table, axis=1)
    assert not np.any(changed & ~touched)


def test_training_explains_most_of_the_variance(device, scenes):
    settings = TrainSettings(batch=32)
    trainer, _, _, _, f = prepare(device, scenes, settings, samples=16)
    for _ in range(8):
        final = trainer.fit(16)
    constant = np.mean(np.var(f / np.mean(f), axis=(1, 2)))
    assert final < 0.2 * constant


def test_two_runs_are_bit_equal(device, scenes):
    def run():
        trainer, *_ = prepare(device, scenes, TrainSettings(batch=32), samples=16)
        trainer.fit(16)
        return trainer.network()

    first, second = run(), run()
    assert np.array_equal(first.parameters, second.parameters)
    assert np.array_equal(first.table, second.table)
