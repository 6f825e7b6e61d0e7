"""Minibatches of GPUs: how far they grow, and what they leave of the residual."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

import ncv_cl as ncv
from ncv_cl.learning import growth
from ncv_cl.learning.growth import batch_growth, grown
from ncv_cl.opencl.device import open_device
from ncv_cl.settings.schedule import Schedule


def pretended(units, lanes=32):
    return SimpleNamespace(lanes=lanes, cl_device=SimpleNamespace(max_compute_units=units))


@pytest.mark.parametrize(
    ("units", "points", "expected"),
    [
        # 128 samples a unit: an H100 wants 16,896 of them, a small GPU 3,584.
        (132, 1 << 20, 16),
        (28, 1 << 20, 4),
        (2, 1 << 20, 1),
        (1000, 1 << 20, 16),
        # No more than there are points.
        (132, 300, 4),
        (132, 100, 1),
    ],
)
def test_minibatches_grow_until_a_step_fills_the_device(units, points, expected):
    schedule = Schedule(batch=64, samples_a_step=16)
    assert batch_growth(pretended(units), schedule, points) == expected
    assert batch_growth(pretended(units, lanes=1), schedule, points) == 1


def test_a_grown_schedule_takes_as_many_steps():
    schedule = Schedule(batch=64, epochs=2)
    larger = grown(schedule, 4)
    points = 4096
    assert points / larger.batch * larger.epochs == points / schedule.batch * schedule.epochs


def test_larger_minibatches_leave_no_more_of_the_residual(one_device, scenes, monkeypatch):
    device = open_device(one_device.cl_device, one_device.index, 1, 32)
    left = []
    for units in (1, 64):
        monkeypatch.setattr(
            growth, "batch_growth", lambda _, *about, units=units: batch_growth(pretended(units), *about)
        )
        monkeypatch.setattr("ncv_cl.learning.learn.batch_growth", growth.batch_growth)
        image = ncv.render(
            scenes / "cornell_box.toml", "direct", "ncv", device=device, size=(40, 40), spp=128, seed=3
        )
        left.append(image.stats["training"]["held_out"][-1])
    assert 0 < left[1] <= 1.03 * left[0] < 1
