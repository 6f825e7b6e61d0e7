"""How much larger than on a CPU a GPU's minibatches are, so that a step fills it."""

from __future__ import annotations

from dataclasses import replace

from ..opencl.device import Device
from ..settings.schedule import Schedule
from . import tuning


def batch_growth(device: Device, schedule: Schedule, most_epochs: int, points: int) -> int:
    """By which power of two minibatches of `points` training points grow on a device; 1 on CPUs.

    Until each compute unit has `tuning.GPU_STEP_ITEMS` samples of a step, as far as a minibatch takes
    no more than all points, and the `grown` schedule no sample more than `most_epochs` times.
    """
    if device.lanes == 1:
        return 1
    wanted = device.cl_device.max_compute_units * tuning.GPU_STEP_ITEMS
    growth = 1
    while (
        growth * schedule.batch * schedule.samples_a_step < wanted
        and 2 * growth * schedule.batch <= points
        and 2 * growth * schedule.epochs <= most_epochs
    ):
        growth *= 2
    return growth


def grown(schedule: Schedule, growth: int) -> Schedule:
    """The schedule with minibatches that are `growth` times as large, and as many steps.

    What is left of the residual depends on the number of steps above all: with a quarter of them it was
    1.2 to 3 times as large, at whatever rate. With as many, each sample is used `growth` times as often.
    Up to 8 uses held-out points gain by that, and beyond some lose: ``python bench/bench_growth.py``.
    """
    return replace(schedule, batch=schedule.batch * growth, epochs=schedule.epochs * growth)
