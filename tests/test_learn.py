"""How much is trained: rounds of samples, held-out points, and when another round does not pay."""

from __future__ import annotations

import math

import network_reference as reference
import numpy as np
import pytest
from test_determinism import assert_same_bits
from test_network import knot_points, random_network

from ncv_cl import render
from ncv_cl.host.clock import Run
from ncv_cl.integrands import DirectLight
from ncv_cl.learning import learn, tuning
from ncv_cl.learning.budget import TRAINING_PASS, Round, pays, plan
from ncv_cl.learning.held_out import HeldOut
from ncv_cl.points.sampler import Stream
from ncv_cl.points.trace import Tracer
from ncv_cl.rendering.estimate import UNIT_CUBE, _points_of
from ncv_cl.sampling.callable import CallableSource, HostIntegrand
from ncv_cl.sampling.problem import Problem
from ncv_cl.sampling.samples import NO_RAY, SEEN, SampleSource
from ncv_cl.settings.options import Training
from ncv_cl.settings.settings import Settings

# (points, samples each): large, small, few samples, many, and too few points to hold any out.
SIZES = [
    (200_000, 256),
    (9216, 64),
    (9216, 4096),
    (5000, 1),
    (100, 1 << 14),
    (20, 1 << 20),
    (1, 1 << 20),
]
POINTS = 512
FREQUENCIES = np.linspace(1, 3, POINTS)


@pytest.mark.parametrize(("active", "spp"), SIZES)
def test_no_sample_is_drawn_twice_and_held_out_points_are_in_no_round(active, spp):
    found = plan(active, spp, seed=3)
    given = np.zeros(active, int)
    for part in found.rounds:
        # Numbers go on where the same points' last ones ended.
        assert len(np.unique(part.chosen)) == len(part.chosen)
        assert (given[part.chosen] == part.samples.start).all()
        given[part.chosen] = part.samples.stop
    if found.held_out is not None:
        assert not given[found.held_out.chosen].any()
        assert len(found.held_out.chosen) <= max(1, active // 16)
    total = sum(part.count for part in found.rounds)
    assert total <= min(tuning.MOST_TRAINING_SAMPLES, active * max(spp / 4, 1))
    assert (found.held_out is not None) == (len(found.rounds) > 1)


@pytest.mark.parametrize(
    ("active", "train_spp"), [(577, 4.0), (577, 15.9), (1000, 0.3), (3, 1.0), (50, 9)]
)
def test_points_that_are_trained_on_are_chosen_once(active, train_spp):
    for seed in range(20):
        training = Training(train_spp=train_spp)
        settings = Settings(DirectLight(), "ncv", 64, (active, 1), seed, training=training)
        chosen, _ = settings.training_points(active, TRAINING_PASS, 0.0)
        assert len(np.unique(chosen)) == len(chosen) and chosen.max() < active


@pytest.mark.parametrize(("active", "spp"), SIZES[:3])
def test_rounds_grow_about_twofold_and_use_what_is_allowed(active, spp):
    counts = np.array([part.count for part in plan(active, spp, seed=0).rounds])
    before = np.cumsum(counts)[:-1]
    assert (counts[1:] <= 2.1 * before).all() and counts[-1] >= 0.3 * counts.sum()
    assert counts.sum() > 0.7 * min(tuning.MOST_TRAINING_SAMPLES, active * spp / 4)


def test_rounds_and_held_out_points_are_spread_over_the_image():
    found = plan(100_000, 256, seed=1)
    for part in (found.held_out, *found.rounds[:3]):
        share = np.histogram(part.chosen, 8, (0, 100_000))[0] / len(part.chosen)
        np.testing.assert_allclose(share, 1 / 8, atol=0.03)


def test_plans_depend_on_the_seed_alone():
    first, second, other = (plan(10_000, 256, seed) for seed in (5, 5, 6))
    assert all(
        np.array_equal(a.chosen, b.chosen) for a, b in zip(first.rounds, second.rounds, strict=True)
    )
    assert not np.array_equal(first.held_out.chosen, other.held_out.chosen)


FOLLOWING = Round(np.arange(1000, dtype=np.uint32), range(16))
FALLING = [(8_000, 2.0), (16_000, 1.0)]
FLAT = [(8_000, 1.0), (16_000, 1.0)]


def test_a_round_pays_where_many_samples_are_left_and_variance_falls():
    assert pays(FALLING, FOLLOWING, 2, 1e8, 0.0)
    assert not pays(FALLING, FOLLOWING, 2, 1e4, 0.0)
    assert not pays(FLAT, FOLLOWING, 2, 1e8, 0.0)
    assert not pays([(8_000, 1.0), (16_000, 1.1)], FOLLOWING, 2, 1e8, 0.0)
    assert not pays([(16_000, 0.0)], FOLLOWING, 2, 1e8, 0.0)
    # One round tells of no fall.
    assert pays(FLAT[:1], FOLLOWING, 2, 1e4, 0.0)


def test_a_round_pays_from_the_number_of_samples_on_that_its_cost_says():
    left = 2.0 ** -(1.0 * tuning.GAIN)
    for rays in (0.0, 2.0):
        a_sample = 1 + tuning.RAY_COST * rays
        least = FOLLOWING.count * (a_sample + 3 * tuning.USE_COST) / (a_sample * (1 - left))
        assert pays(FALLING, FOLLOWING, 3, 1.001 * least, rays)
        assert not pays(FALLING, FOLLOWING, 3, 0.999 * least, rays)


@pytest.mark.parametrize("demodulated", [False, True])
def test_held_out_variances_match_float64(device, scenes, demodulated):
    scene, points = knot_points(device, scenes)
    network = random_network(scene, demodulated=demodulated)
    source = SampleSource(device, scene, Tracer(scene), points, DirectLight(), "independent", 5, 16)
    factor = source.unshadowed_means() if demodulated else None
    chosen = np.arange(1, points.active, 3, dtype=np.uint32)
    held_out = HeldOut(device, points, chosen, 3, factor)
    order = learn.HostArray.of(device, chosen)
    (part,) = source.batches(len(chosen))
    batch = source.draw(part, range(16), Stream.TRAINING, order)
    held_out.store(batch, 0)
    size = len(chosen) * batch.stride
    shape = (len(chosen), batch.stride)
    slot = batch.slot.read(size)
    seen = np.append(batch.visible.read(), 0)[np.minimum(slot, batch.visible.shape[0])]
    seen = np.where(slot == SEEN, 1, seen * (slot != NO_RAY))
    f = (batch.value.read().ravel()[: 3 * size].reshape(3, size) * seen).reshape(3, *shape)[:, :, :16]
    uv = np.stack([batch.u.read(size), batch.v.read(size)]).reshape(2, *shape)[:, :, :16].astype(float)
    # What the source draws next is none of its business.
    source.draw(part, range(16, 32), Stream.TRAINING, order)
    g = reference.forward(network, reference.features(network, points)[:, chosen], uv)
    if factor is not None:
        g = g * factor.read()[:, chosen, None]
    left, plain = held_out.variances(network)
    assert left == pytest.approx(np.var(f - g, axis=2, ddof=1).mean(), rel=1e-4)
    assert plain == pytest.approx(np.var(f.astype(float), axis=2, ddof=1).mean(), rel=1e-4)


def waves(u, v, point):
    return 1 + np.sin(FREQUENCIES[point] * math.pi * u) * v


def noise(u, v, point):
    """What no network learns."""
    return np.sin(1e5 * u + 3e5 * v)


@pytest.fixture
def short_rounds(monkeypatch):
    monkeypatch.setattr(tuning, "FIRST_ROUND", 1 << 11)
    monkeypatch.setattr(tuning, "MOST_TRAINING_SAMPLES", 1 << 14)


def trained(device, function, spp, seed=0):
    """What is learned of a function of POINTS points."""
    settings = Settings(HostIntegrand(1), "ncv", spp, (POINTS, 1), seed)
    points = _points_of(device, POINTS, FREQUENCIES[:, None])
    source = CallableSource(device, points, function, 1, "sobol", seed)
    problem = Problem(device, points, source, UNIT_CUBE, ("position",), is_image=False)
    return learn.learn(problem, settings, Run())


def test_training_goes_on_while_it_pays(one_device, short_rounds):
    few, many = (trained(one_device, waves, spp) for spp in (64, 1 << 16))
    hopeless = trained(one_device, noise, 1 << 16)
    assert few.statistics["rounds"] == hopeless.statistics["rounds"] == 2
    assert many.statistics["rounds"] == 4
    held_out = many.statistics["held_out"]
    assert len(held_out) == 4 and held_out[-1] < 0.5 * held_out[0] < 0.5
    assert many.statistics["samples"] == pytest.approx(1 << 14, rel=0.1)
    # The estimate has all samples, held-out ones too.
    held = POINTS // 16
    assert many.estimate.samples.sum() == many.statistics["samples"] + held * TRAINING_PASS
    assert (many.estimate.samples >= TRAINING_PASS).all()


def test_held_out_points_are_never_trained_on(one_device, short_rounds, monkeypatch):
    trained_on, held_out = [], []

    class Trainer(learn.Trainer):
        def __init__(self, *arguments):
            trained_on.append(arguments[4])
            super().__init__(*arguments)

    class Spy(learn.HeldOut):
        def __init__(self, *arguments):
            held_out.append(arguments[2])
            super().__init__(*arguments)

    monkeypatch.setattr(learn, "Trainer", Trainer)
    monkeypatch.setattr(learn, "HeldOut", Spy)
    trained(one_device, waves, 1 << 16)
    (held,) = held_out
    assert len(trained_on) == 4 and len(held) == POINTS // 16
    assert not np.isin(np.concatenate(trained_on), held).any()


def test_two_runs_are_bit_equal(one_device, short_rounds):
    first, second = (trained(one_device, waves, 1 << 14, seed=2) for _ in range(2))
    assert first.statistics == second.statistics and first.statistics["rounds"] > 1
    assert np.array_equal(first.network.parameters, second.network.parameters)
    assert np.array_equal(first.network.table, second.network.table)
    assert np.array_equal(first.estimate.mean, second.estimate.mean)


def test_a_render_that_decides_goes_on_from_its_checkpoint(one_device, scenes, tmp_path, monkeypatch):
    monkeypatch.setattr(tuning, "FIRST_ROUND", 1 << 9)
    monkeypatch.setattr(tuning, "USE_COST", 0.5)
    file = tmp_path / "checkpoint.npz"

    def picture(**options):
        return render(
            scenes / "cornell_box.toml", "direct", "ncv", spp=300, size=(16, 12), seed=3,
            device=one_device, **options,
        )  # fmt: skip

    whole = picture()
    assert whole.stats["training"]["rounds"] == len(whole.stats["training"]["held_out"]) > 1
    # Written after training, then after each pass.
    part = picture(checkpoint=file, stop=file.exists)
    assert part.stats["samples_per_point"] < whole.stats["samples_per_point"]
    assert_same_bits(whole, picture(resume=file))
