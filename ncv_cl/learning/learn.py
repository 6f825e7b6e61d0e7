"""Draw training samples round by round, and train a network on them."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace

import numpy as np

from ..host.clock import NO_TIME, TRAINING_SHARE, OutOfTime, Run
from ..network.network import Network
from ..opencl.memory import HostArray
from ..points.sampler import Stream
from ..sampling.accumulate import Accumulator, Estimate
from ..sampling.guide import Guide
from ..sampling.problem import Problem
from ..settings.presets import Preset
from ..settings.schedule import Schedule
from ..settings.settings import Settings
from ..visibility.room import Batch
from . import tuning
from .budget import TRAINING_PASS, Budget, Round, pays, plan
from .growth import batch_growth, grown
from .held_out import HeldOut
from .train import Trainer, TrainingSamples

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
        None where training diverged twice, or had no time.
    samples : TrainingSamples, optional
        Those of the last round. None without a network.
    statistics : dict
        ``samples`` in all, the ``epochs`` over those of the last round, ``rounds``; and ``held_out``,
        after each round the variance of f - g over that of f at points that are not trained on. Empty
        where no points were held out.
    guide : Guide, optional
        Densities that guide bounces behind the first; `gi` only.
    """

    estimate: Estimate
    network: Network | None
    samples: TrainingSamples | None
    statistics: dict[str, object]
    guide: Guide | None = None


def learn(problem: Problem, settings: Settings, run: Run) -> Learned:
    """Draw training samples and train a network; if that diverges, again at a tenth of the rate.

    With a time limit training ends after `TRAINING_SHARE` of it, with the rounds done until then.
    """
    if settings.guides:
        problem.paths.record_guide()
    learned = _fitted(problem, settings, run)
    if not settings.guides:
        return learned
    with run.watch("guide"):
        return replace(learned, guide=problem.paths.learn_guide())


def _fitted(problem: Problem, settings: Settings, run: Run) -> Learned:
    with run.watch("train"):
        description = settings.preset.description(settings.integrand, problem.inputs)
        start = Network.random(description, problem.cube, settings.seed)
        factors = problem.factor(description.demodulated)
    learning = _Learning(problem, settings, run, start, factors)
    for slower in (1.0, 0.1):
        learned = learning.attempt(slower)
        if learned.network is not None:
            return learned
        if run.clock.over(TRAINING_SHARE):
            warnings.warn(NO_TIME, stacklevel=7)
            return learned
    warnings.warn("training diverged; the image is rendered by plain Monte Carlo", stacklevel=7)
    return learned


def training_budget(settings: Settings, active: int) -> Budget:
    """The samples that training `active` points may take.

    The variance at held-out points decides how many rounds there are, except in two cases: if the
    samples also train guides, whose gain it does not show, and if the schedule needs every point.
    """
    if settings.training.train_spp == "auto" and settings.preset.subset and not settings.guides:
        return plan(active, settings.spp, settings.seed)
    most = max(settings.spp * tuning.LARGEST_TRAINING_SHARE, 1.0)
    auto_spp = min(tuning.UNDECIDED_SAMPLES / active, most)
    chosen, samples = settings.training_points(active, TRAINING_PASS, auto_spp)
    return Budget([Round(chosen, range(samples))])


@dataclass
class _Rounds:
    """The state after some rounds; `found` holds samples and held-out variances after each."""

    network: Network | None = None
    trainer: Trainer | None = None
    losses: list[float] = field(default_factory=list)
    found: list[tuple[int, float, float]] = field(default_factory=list)
    used: int = 0
    epochs: int = 0
    number: int = 0


@dataclass(frozen=True)
class _Learning:
    """The inputs of training; `attempt` trains one network."""

    problem: Problem
    settings: Settings
    run: Run
    start: Network
    factors: HostArray | None

    def attempt(self, slower: float) -> Learned:
        """Train from the start at `slower` times the rate; without a network if that diverged."""
        points = self.problem.points
        budget = training_budget(self.settings, points.active)
        accumulator = Accumulator(self.problem.device, points, self.settings.integrand.channels)
        done = _Rounds()
        # When the time is over, the rounds done before count.
        with suppress(OutOfTime):
            self._rounds(budget, slower, accumulator, done)
        about: dict[str, object] = {
            "samples": done.used,
            "epochs": done.epochs,
            "rounds": done.number,
            "held_out": [left / plain if plain else 0.0 for _, left, plain in done.found],
        }
        network, samples = done.network, None
        if network is not None and _diverged(network, done.losses):
            network = None
        if network is not None and done.trainer is not None:
            samples = done.trainer.samples_of(network)
        return Learned(accumulator.result(), network, samples, about)

    def _rounds(self, budget: Budget, slower: float, accumulator: Accumulator, done: _Rounds) -> None:
        """Do round after round, until none is left or the next one would not pay."""
        source, held_out = self.problem.source, None
        rays = source.rays.traced
        if budget.held_out is not None:
            chosen, samples = budget.held_out.chosen, budget.held_out.samples
            held_out = HeldOut(
                self.problem.device, source.points, chosen, accumulator.channels, self.factors
            )
            self._draw(Stream.HELD_OUT, chosen, samples, accumulator, held_out.store)
        for number, current in enumerate(budget.rounds, 1):
            began = time.perf_counter()
            schedule = self._grown(self._schedule(slower, current), current)
            losses = list(done.losses)
            trainer = self._train(schedule, current, accumulator, done.trainer, losses)
            with self.run.watch("train"):
                done.network, done.trainer, done.losses = trainer.network(), trainer, losses
                done.used, done.epochs, done.number = done.used + current.count, schedule.epochs, number
                if held_out is not None and np.isfinite(losses[-1]):
                    done.found.append((done.used, *held_out.variances(done.network)))
            if number == len(budget.rounds) or not np.isfinite(losses[-1]) or self.run.stop():
                return
            following = budget.rounds[number]
            seconds = (time.perf_counter() - began) * following.count / current.count
            besides = 0 if budget.held_out is None else budget.held_out.count
            traced = (source.rays.traced - rays) / (done.used + besides)
            in_time = seconds < self.run.clock.left(TRAINING_SHARE)
            if not (in_time and self._pays(done.found, slower, following, traced)):
                return

    def _pays(
        self,
        found: list[tuple[int, float, float]],
        slower: float,
        following: Round,
        rays: float,
    ) -> bool:
        samples = float(self.settings.spp) * self.problem.points.active
        epochs = self._schedule(slower, following).epochs
        return pays([(used, left) for used, left, _ in found], following, epochs, samples, rays)

    def _schedule(self, slower: float, current: Round) -> Schedule:
        preset = self.settings.preset
        schedule = preset.schedule
        epochs = schedule.epochs
        if self.settings.training.train_spp == "auto":
            epochs = min(epochs, tuning.AUTO_EPOCHS)
        rate = schedule.rate * slower
        return replace(
            schedule,
            rate=rate,
            final_rate=min(rate, schedule.final_rate),
            epochs=_enough_epochs(preset, epochs, len(current.chosen), len(current.samples)),
        )

    def _grown(self, base: Schedule, current: Round) -> Schedule:
        """The schedule with as large minibatches as fill the device; the slides' own is kept."""
        preset = self.settings.preset
        if not preset.subset:
            return base
        device, most = self.problem.device, preset.schedule.epochs
        return grown(base, batch_growth(device, base, most, len(current.chosen)))

    def _train(
        self,
        schedule: Schedule,
        current: Round,
        accumulator: Accumulator,
        previous: Trainer | None,
        losses: list[float],
    ) -> Trainer:
        """Train one round, in parts if memory cannot hold its samples; appends each part's loss."""
        chosen, numbers = current.chosen, current.samples
        held = min(len(numbers), max(TRAINING_PASS, TRAINING_SAMPLES_HELD // len(chosen)))
        firsts = range(numbers.start, numbers.stop - held + 1, held)
        self.run.clock.check(TRAINING_SHARE)
        with self.run.watch("train"):
            trainer = Trainer(
                self.problem.device, self.start, self.problem.points, schedule, chosen, held,
                self.settings.seed, self.factors, previous,
            )  # fmt: skip
        for first in firsts:
            part = range(first, first + held)
            self._draw(Stream.TRAINING, chosen, part, accumulator, trainer.store)
            with self.run.watch("train"):
                losses.append(trainer.fit(len(firsts), self._check))
            if not np.isfinite(losses[-1]) or (first != firsts[-1] and self.run.stop()):
                break
        return trainer

    @property
    def _check(self) -> Callable[[], None] | None:
        """A function that raises `OutOfTime`; None without a time limit."""
        return None if self.run.clock.limit is None else lambda: self.run.clock.check(TRAINING_SHARE)

    def _draw(
        self,
        stream: Stream,
        chosen: np.ndarray,
        numbers: range,
        accumulator: Accumulator,
        store: Callable[[Batch, int], None],
    ) -> None:
        """Draw samples of the chosen points, for the estimate and to be stored."""
        device, source, watch = self.problem.device, self.problem.source, self.run.watch
        order = HostArray.of(device, chosen)
        for first in range(numbers.start, numbers.stop, TRAINING_PASS):
            part = range(first, min(first + TRAINING_PASS, numbers.stop))
            parts = [(batch_points, part) for batch_points in source.batches(len(chosen))]
            for batch in source.drawn(parts, stream, order):
                with watch("estimate"):
                    accumulator.add(batch, part.start)
                with watch("train"):
                    store(batch, part.start - numbers.start)
                    if not source.runs_ahead:
                        device.queue.finish()
            accumulator.finish_pass(np.full(len(chosen), len(part)), chosen)
            self.run.clock.check(TRAINING_SHARE)


def _diverged(network: Network, losses: list[float]) -> bool:
    finite = np.isfinite(network.parameters).all() and np.isfinite(network.table).all()
    return not (finite and losses[-1] < 2.0 * losses[0])


def _enough_epochs(preset: Preset, epochs: int, points: int, samples: int) -> int:
    """`epochs`, or more where these would be few steps; the slides' own schedule is kept."""
    if not preset.subset:
        return epochs
    schedule = preset.schedule
    batches = max(1, round(points / schedule.batch))
    wanted = tuning.FEWEST_STEPS_OF_ONE_BATCH if batches == 1 else tuning.FEWEST_STEPS
    steps = batches * max(1, samples // schedule.samples_a_step)
    return max(epochs, min(tuning.MOST_EPOCHS, -(-wanted // steps)))
