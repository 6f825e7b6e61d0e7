"""Minibatches of GPUs: how far they grow, and what they leave of the residual."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

import ncv_cl as ncv
from ncv_cl.learning import learn, tuning
from ncv_cl.learning.growth import batch_growth, grown
from ncv_cl.opencl.device import open_device
from ncv_cl.settings.schedule import Schedule


def pretended(units, lanes=32):
    return SimpleNamespace(lanes=lanes, cl_device=SimpleNamespace(max_compute_units=units))


@pytest.mark.parametrize(
    ("units", "points", "epochs", "expected"),
    [
        # 128 samples a unit: an H100 wants 16,896 of them, a small GPU 2,560.
        (132, 1 << 20, 1, 8),
        (20, 1 << 20, 1, 4),
        (2, 1 << 20, 1, 1),
        # No more than there are points, and no sample is used too often.
        (132, 300, 1, 4),
        (132, 100, 1, 1),
        (132, 1 << 20, 2, 4),
        (132, 1 << 20, 5, 1),
    ],
)
def test_minibatches_grow_until_a_step_fills_the_device(units, points, epochs, expected):
    schedule = Schedule(batch=64, samples_a_step=16, epochs=epochs)
    assert batch_growth(pretended(units), schedule, 8, points) == expected
    assert batch_growth(pretended(units, lanes=1), schedule, 8, points) == 1


def test_a_grown_schedule_takes_as_many_steps():
    schedule = Schedule(batch=64, epochs=2)
    larger = grown(schedule, 4)
    points = 4096
    assert points / larger.batch * larger.epochs == points / schedule.batch * schedule.epochs


def test_larger_minibatches_leave_no_more_of_the_residual(one_device, scenes, monkeypatch):
    device = open_device(one_device.cl_device, one_device.index, 1, 32)
    # Two rounds.
    monkeypatch.setattr(tuning, "FIRST_ROUND", 1 << 15)

    def held_out(units, seed):
        monkeypatch.setattr(
            learn, "batch_growth", lambda _, *about: batch_growth(pretended(units), *about)
        )
        options = {"device": device, "size": (56, 56), "spp": 96, "seed": seed, "train_spp": "auto"}
        image = ncv.render(scenes / "cornell_box.toml", "direct", "ncv", **options)
        training = image.stats["training"]
        assert len(training["held_out"]) == 2
        return training["epochs"], np.array(training["held_out"])

    ratios = []
    for seed in (3, 4):
        (epochs, plain), (more, large) = held_out(1, seed), held_out(64, seed)
        assert more == 4 * epochs
        ratios.append(large / plain)
    # One seed's network has up to a third more or less of it than another's.
    assert 0 < np.mean(ratios) <= 1.03
