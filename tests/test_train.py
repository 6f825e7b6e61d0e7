"""Training: gradients against finite differences, the gather index, and what a run must do."""

from __future__ import annotations

from dataclasses import replace

import network_reference as reference
import numpy as np
import pytest
from test_network import ALL_INPUTS, knot_points, random_network

from ncv_cl.integrands import DirectLight
from ncv_cl.learning.train import Trainer
from ncv_cl.network.grid_index import _by_entry
from ncv_cl.opencl.memory import HostArray
from ncv_cl.points.sampler import Stream
from ncv_cl.points.trace import Tracer
from ncv_cl.sampling.samples import NO_RAY, SampleSource
from ncv_cl.settings.schedule import Schedule

# With so large an epsilon the first Adam step is the gradient times rate / epsilon.
STEP = 100.0
PLAIN = Schedule(
    batch=1 << 20,
    samples_a_step=3,
    epochs=1,
    rate=1e8,
    final_rate=1e8,
    table_rate=1.0,
    epsilon=1e6,
    average_decay=0.0,
    weight_power=1.0,
)


def prepare(device, scenes, settings, samples=3, **description):
    """A trainer that holds samples of the knot, with its network, points, u, v, f and factors."""
    scene, points = knot_points(device, scenes)
    network = random_network(scene, **description)
    source = SampleSource(device, scene, Tracer(scene), points, DirectLight(), "independent", 5, samples)
    factor = source.unshadowed_means() if network.description.demodulated else None
    chosen = np.arange(0, points.active, 2, dtype=np.uint32)
    trainer = Trainer(device, network, points, settings, chosen, samples, 11, factor)
    (part,) = source.batches(len(chosen))
    batch = source.draw(part, range(samples), Stream.TRAINING, HostArray.of(device, chosen))
    trainer.store(batch, 0)
    size = len(chosen) * batch.stride
    slot = batch.slot.read()[:size]
    visible = np.append(batch.visible.read(), 0)[np.minimum(slot, batch.visible.shape[0])]
    f = batch.value.read().ravel()[: 3 * size].reshape(3, size) * (visible * (slot != NO_RAY))
    shape = (len(chosen), batch.stride)
    uv = np.stack([batch.u.read()[:size], batch.v.read()[:size]]).reshape(2, *shape)[:, :, :samples]
    f = f.reshape(3, *shape)[:, :, :samples].astype(float)
    factors = np.full((3, len(chosen)), f.mean()) if factor is None else factor.read()[:, chosen]
    return trainer, network, (points, chosen), uv.astype(float), f, factors.astype(float)


def loss(network, where, uv, f, factors, parameters=None, table=None):
    points, chosen = where
    feature = reference.features(network, points, table)[:, chosen]
    value = reference.forward(network, feature, uv, parameters)
    weight = factors / factors.mean()
    lit = factors[..., None] > 0
    target = np.where(lit, f / np.where(lit, factors[..., None], 1), 0)
    return np.mean((weight[..., None] * (value - target)) ** 2)


def central_difference(function, at, index, step=1e-7):
    high, low = at.astype(float), at.astype(float)
    high.flat[index] += step
    low.flat[index] -= step
    return (function(high) - function(low)) / (2 * step)


@pytest.mark.parametrize("hidden", [(16, 16), (8, 12), (33, 7), (64, 64)])
@pytest.mark.parametrize(
    "options",
    [
        {"inputs": ("position",), "grid_features": 1},
        {"inputs": ALL_INPUTS, "modulated": ("B1",)},
        {"inputs": ALL_INPUTS, "demodulated": True, "grid_features": 4},
        {"inputs": ("position", "albedo"), "modulated": ("W1", "B2", "B3")},
    ],
)
def test_gradients_match_finite_differences(device, scenes, hidden, options):
    trainer, network, *data = prepare(device, scenes, PLAIN, hidden=hidden, grid_entries=256, **options)
    assert trainer.fit() == pytest.approx(loss(network, *data), rel=1e-4)
    trained = trainer.network()
    # The network as it is trained, before its output takes the common factor.
    new = trained.parameters.astype(float)
    if not network.description.demodulated:
        for group in ("W3", "B3"):
            unscale(network.description, new, group, data[3].mean())
    got = (network.parameters - new) / STEP
    description = network.description
    heads_at = hidden[0] * hidden[1]
    bases_at = got.size - description.base_rows
    for name, part in {
        "W2": range(heads_at),
        "heads": range(heads_at, bases_at),
        "bases": range(bases_at, got.size),
    }.items():
        if not len(part):
            continue
        picks = np.random.default_rng(0).choice(part, min(len(part), 12), replace=False)
        expected = [
            central_difference(lambda p: loss(network, *data, p), network.parameters, index)
            for index in picks
        ]
        tolerance = 2e-3 * np.abs(got[part]).max()
        np.testing.assert_allclose(got[picks], expected, atol=tolerance, err_msg=name)

    got = (network.table.astype(float) - trained.table) / STEP
    assert np.count_nonzero(got) > 0
    picks = np.argsort(-np.abs(got).ravel())[[0, 3, 9, 27, 81]]
    expected = [
        central_difference(lambda t: loss(network, *data, None, t), network.table, index)
        for index in picks
    ]
    np.testing.assert_allclose(got.flat[picks], expected, atol=2e-3 * np.abs(got).max())


def unscale(description, parameters, group, factor):
    """Divide a group's heads and bases by `factor`, in place."""
    rows = description.group_rows[group]
    count = int(np.prod(description.group_shapes[group]))
    _, heads, bases = description.unpack(parameters)
    if group in description.modulated:
        heads[rows : rows + count] /= factor
    else:
        bases[rows - len(heads) : rows - len(heads) + count] /= factor


def test_the_table_takes_adams_steps_where_it_is_asked_to(device, scenes):
    rate = 0.02
    # The network itself stays where it is.
    settings = Schedule(
        batch=1 << 20, samples_a_step=3, rate=1e-12, final_rate=1e-12, table_rate=rate * 1e12,
        table_adam=True, weight_power=1.0,
    )  # fmt: skip
    options = {"inputs": ("position",), "grid_entries": 256, "grid_features": 2}
    tables, gradients, picks = [], [], None
    for epochs in range(1, 4):
        trainer, network, *data = prepare(device, scenes, replace(settings, epochs=epochs), **options)
        trainer.fit()
        tables.append(trainer.network().table)
    for before in (network.table, *tables[:-1]):
        if picks is None:
            picks = np.argsort(-np.abs(tables[0] - before).ravel())[[0, 50, 200]]
        gradients.append(
            [central_difference(lambda t: loss(network, *data, None, t), before, i) for i in picks]
        )
    value = network.table.ravel()[picks].astype(float)
    first, second = np.zeros(len(picks)), np.zeros(len(picks))
    for step, (gradient, table) in enumerate(zip(np.array(gradients), tables, strict=True), 1):
        first = settings.beta1 * first + (1 - settings.beta1) * gradient
        second = settings.beta2 * second + (1 - settings.beta2) * gradient**2
        corrected = first / (1 - settings.beta1**step), second / (1 - settings.beta2**step)
        value -= rate * corrected[0] / (np.sqrt(corrected[1]) + settings.epsilon)
        np.testing.assert_allclose(table.ravel()[picks], value, atol=2e-3 * rate)


# So that an entry and a pair's number fit into 32 bits, and so that they do not.
@pytest.mark.parametrize("entries", [1 << 10, 1 << 30])
def test_pairs_are_sorted_by_entry_and_number(entries):
    corner = np.random.default_rng(0).integers(0, entries, (16, 37)).astype(np.uint32)
    corner[3] = corner[7] = entries - 1
    entry, starts, number = _by_entry(corner)
    order = np.argsort(corner.ravel(), kind="stable")
    assert np.array_equal(number, order)
    expected, first = np.unique(corner.ravel()[order], return_index=True)
    assert np.array_equal(entry, expected) and np.array_equal(starts, first)
    assert entry.dtype == starts.dtype == np.uint32


def test_untouched_grid_entries_keep_their_value(one_device, scenes):
    trainer, network, (points, chosen), *_ = prepare(one_device, scenes, PLAIN, grid_entries=4096)
    trainer.fit()
    touched = np.zeros(len(network.table), bool)
    position = points.rows("position")[:, chosen].astype(float)
    touched[reference.corners(network, position)[0].ravel()] = True
    changed = np.any(trainer.network().table != network.table, axis=1)
    assert not np.any(changed & ~touched)


@pytest.mark.parametrize("demodulated", [False, True])
def test_training_explains_most_of_the_variance(device, scenes, demodulated):
    settings = Schedule(batch=16, epochs=64)
    trainer, _, _, _, f, factors = prepare(device, scenes, settings, samples=16, demodulated=demodulated)
    final = trainer.fit()
    share = f / factors.mean()
    constant = np.mean(np.var(share, axis=(1, 2)))
    assert final < 0.2 * constant


@pytest.mark.parametrize("demodulated", [False, True])
def test_a_trainer_goes_on_from_another_on_other_points(one_device, scenes, demodulated):
    settings = Schedule(batch=16, epochs=16)
    trainer, network, (points, _), *_ = prepare(
        one_device, scenes, settings, samples=16, demodulated=demodulated
    )
    first = trainer.fit()
    before = trainer.network()
    scene, _ = knot_points(one_device, scenes)
    source = SampleSource(one_device, scene, Tracer(scene), points, DirectLight(), "independent", 5, 16)
    factor = source.unshadowed_means() if demodulated else None
    others = np.arange(1, points.active, 2, dtype=np.uint32)
    second = Trainer(one_device, network, points, settings, others, 16, 11, factor, trainer)
    same = second.network()
    assert np.array_equal(before.parameters, same.parameters)
    assert np.array_equal(before.table, same.table)
    (part,) = source.batches(len(others))
    second.store(source.draw(part, range(16), Stream.TRAINING, HostArray.of(one_device, others)), 0)
    # A new network would begin with a loss many times as large.
    assert second.fit() < 1.2 * first
    assert not np.array_equal(before.parameters, second.network().parameters)


@pytest.mark.parametrize("demodulated", [False, True])
def test_two_runs_are_bit_equal(device, scenes, demodulated):
    def run():
        settings = Schedule(batch=16)
        trainer, *_ = prepare(device, scenes, settings, samples=16, demodulated=demodulated)
        trainer.fit()
        return trainer.network()

    first, second = run(), run()
    assert np.array_equal(first.parameters, second.parameters)
    assert np.array_equal(first.table, second.table)
