"""Training samples drawn, the control variate trained on them, and the density of its residual."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from .alpha import can_scale, control_coefficients
from .density import DensityNetwork, DensityTrainer
from .device import Device, HostArray
from .encode import GridCube
from .estimate import Estimate, Estimator
from .network import FoldedNetwork, Network
from .points import ShadingPoints
from .presets import PRESETS, Preset
from .sampler import Stream
from .samples import Batches
from .settings import RenderSettings, Stopwatch
from .train import Trainer, TrainSettings

# Samples of a point that are drawn at a time; fewer on average are so many at fewer points.
TRAINING_PASS = 16
# `train_spp` "auto": samples in all, since a network's need depends on the scene and not on pixels, and
# how often each is used. Twice as many, or as often, lowered the error by less than they cost (one seed
# at 64 samples a point, Cornell box and occluders).
AUTO_TRAINING_SAMPLES = 1 << 19
AUTO_PASSES = 2
# Few points make few steps of a pass; samples are used more often then, up to so often. Points that fit
# one minibatch bear many steps; where there are more, with few samples each, the network soon knows the
# samples by heart.
FEWEST_STEPS = 64
FEWEST_STEPS_OF_ONE_BATCH = 512
MOST_PASSES = 128
# Training samples held at a time.
TRAINING_SAMPLES_HELD = 1 << 23


@dataclass(frozen=True)
class Learned:
    """What training leaves.

    Attributes
    ----------
    estimate : Estimate
        Of f, from the training samples alone.
    network : Network, optional
        None where training diverged twice.
    trainer : Trainer
        Holds the samples, for the density.
    """

    estimate: Estimate
    network: Network | None
    trainer: Trainer


def learn(
    device: Device,
    cube: GridCube,
    source: Batches,
    settings: RenderSettings,
    inputs: tuple[str, ...],
    factor: Callable[[bool], HostArray | None],
    watch: Stopwatch,
    stop: Callable[[], bool],
) -> Learned:
    """Draw training samples and fit a network; once more at a tenth of the rate where that diverges.

    Parameters
    ----------
    cube : GridCube
        What the network's hash grid divides.
    inputs : tuple of str
        What varies over the points, as `encode.varying_inputs` finds it.
    factor : callable
        For whether the network is demodulated, what its output is multiplied by at each point.
    stop : callable
        Asked between rounds of samples; True ends training with what there is.
    """
    preset = PRESETS[settings.preset]
    with watch("train"):
        description = preset.description(settings.integrand, inputs)
        start = Network.random(description, cube, settings.seed)
        chosen, samples = settings.training_points(
            source.points.active, TRAINING_PASS, AUTO_TRAINING_SAMPLES
        )
        factors = factor(description.demodulated)
    passes = AUTO_PASSES if settings.train_spp == "auto" else preset.settings.passes
    for slower in (1.0, 0.1):
        rate = preset.settings.rate * slower
        schedule = replace(
            preset.settings,
            rate=rate,
            final_rate=min(rate, preset.settings.final_rate),
            passes=_enough_passes(preset, min(passes, preset.settings.passes), len(chosen), samples),
        )
        learned = _fit(device, source, settings, start, schedule, chosen, samples, factors, watch, stop)
        if learned.network is not None:
            return learned
    warnings.warn("training diverged; the image is rendered by plain Monte Carlo", stacklevel=5)
    return learned


def _enough_passes(preset: Preset, passes: int, points: int, samples: int) -> int:
    """`passes`, or more where these would be few steps; the slides' own schedule is kept."""
    if not preset.subset:
        return passes
    schedule = preset.settings
    batches = max(1, round(points / schedule.batch))
    wanted = FEWEST_STEPS_OF_ONE_BATCH if batches == 1 else FEWEST_STEPS
    steps = batches * max(1, samples // schedule.samples_a_step)
    return max(passes, min(MOST_PASSES, -(-wanted // steps)))


def _fit(
    device: Device,
    source: Batches,
    settings: RenderSettings,
    start: Network,
    schedule: TrainSettings,
    chosen: np.ndarray,
    samples: int,
    factor: HostArray | None,
    watch: Stopwatch,
    stop: Callable[[], bool],
) -> Learned:
    """One attempt; without a network if it diverged."""
    points = source.points
    held = min(samples, max(TRAINING_PASS, TRAINING_SAMPLES_HELD // len(chosen)))
    rounds = [range(s, s + held) for s in range(0, samples - held + 1, held)]
    estimator = Estimator(device, points, settings.integrand.channels, chosen=chosen)
    with watch("train"):
        trainer = Trainer(device, start, points, schedule, chosen, held, settings.seed, factor)
        order = HostArray.of(device, chosen)
    losses = []
    for held_samples in rounds:
        for first in range(held_samples.start, held_samples.stop, TRAINING_PASS):
            part = range(first, min(first + TRAINING_PASS, held_samples.stop))
            for batch_points in source.batches(len(chosen)):
                batch = source.draw(batch_points, part, Stream.TRAINING, order)
                with watch("estimate"):
                    estimator.add(batch)
                with watch("train"):
                    trainer.store(batch, part.start - held_samples.start)
                    device.queue.finish()
            estimator.finish_pass(len(part))
        with watch("train"):
            losses.append(trainer.fit(len(rounds)))
        if stop() or not np.isfinite(losses[-1]):
            break
    with watch("train"):
        network = trainer.network()
    diverged = not (
        np.isfinite(network.parameters).all()
        and np.isfinite(network.table).all()
        and losses[-1] < 2.0 * losses[0]
    )
    return Learned(estimator.result(), None if diverged else network, trainer)


def learn_alpha(
    points: ShadingPoints, folded: FoldedNetwork, trainer: Trainer, columns: int
) -> np.ndarray | None:
    """Control coefficients from the trainer's samples; None for networks that cannot take them."""
    if not can_scale(folded):
        return None
    return control_coefficients(folded, trainer.samples_of(folded.network), points, columns)


def learn_density(
    device: Device,
    points: ShadingPoints,
    folded: FoldedNetwork,
    trainer: Trainer,
    unit: np.ndarray | None,
) -> DensityNetwork:
    """The magnitude of what `folded` leaves of the trainer's samples, in units of `unit`."""
    unit = np.ones(points.active, np.float32) if unit is None else unit
    samples = trainer.samples_of(folded.network)
    return DensityTrainer(device, folded, samples, unit).fit()
