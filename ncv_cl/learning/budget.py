"""The number of training samples: rounds of them, and whether another round would pay."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ..points.sampler import HostStream, host_generator
from . import tuning

# Samples of a point that are drawn at a time; fewer of `train_spp` are so many at fewer points.
TRAINING_PASS = 16


@dataclass(frozen=True)
class Round:
    """Samples of one round: numbers `samples` of each of the points `chosen` (uint32)."""

    chosen: np.ndarray
    samples: range

    @property
    def count(self) -> int:
        return len(self.chosen) * len(self.samples)


@dataclass(frozen=True)
class Budget:
    """The training samples that may be drawn.

    Attributes
    ----------
    rounds : list of Round
        In the order in which they are drawn; no sample is in two of them.
    held_out : Round, optional
        Samples to measure networks on, at points that no round uses. None if there is one round only, so
        nothing to decide.
    """

    rounds: list[Round]
    held_out: Round | None = None


def plan(active: int, spp: int, seed: int) -> Budget:
    """Rounds of training samples for `active` points that get `spp` samples each afterwards."""
    most = int(active * max(spp * tuning.LARGEST_TRAINING_SHARE, 1.0))
    sizes = _sizes(min(tuning.MOST_TRAINING_SAMPLES, most))
    held = min(tuning.HELD_OUT_POINTS, int(active * tuning.HELD_OUT_SHARE))
    if len(sizes) == 1 or held == 0:
        sizes, held = [sum(sizes)], 0
    generator = host_generator(seed, HostStream.TRAINING_POINTS)
    points = np.arange(active, dtype=np.uint32)
    out = _spread(active, held, generator)[:held] if held else points[:0]
    rest = np.delete(points, out)
    rest = rest[_spread(len(rest), min(len(rest), -(-sizes[0] // tuning.SAMPLES_A_POINT)), generator)]
    return Budget(_rounds(rest, sizes), Round(points[out], range(TRAINING_PASS)) if held else None)


def pays(
    found: list[tuple[int, float]], following: Round, epochs: int, samples: float, rays: float
) -> bool:
    """Whether a further round is predicted to save more of the estimate's samples than it costs.

    Parameters
    ----------
    found : list of (int, float)
        After each round: training samples so far, and the held-out variance.
    following : Round
    epochs : int
        How often each of its samples will be used.
    samples : float
        Of the estimate, of all points.
    rays : float
        Traced for a sample, on average.

    Notes
    -----
    The variance V is taken to fall as a power of the training samples, the one seen over the last two
    rounds, so the first one does not decide. The estimate needs samples as V to the power
    GAIN.
    """
    used, variance = found[-1]
    if variance <= 0.0 or len(found) < 2:
        return variance > 0.0
    earlier, larger = found[max(0, len(found) - 3)]
    fall = max(0.0, math.log(larger / variance) / math.log(used / earlier))
    left = ((used + following.count) / used) ** -fall
    a_sample = 1.0 + tuning.RAY_COST * rays
    saved = samples * a_sample * (1.0 - left**tuning.GAIN)
    return saved > following.count * (a_sample + epochs * tuning.USE_COST)


def _sizes(most: int) -> list[int]:
    """Samples of each round: as many as all before, the last one not much fewer."""
    sizes, total = [], 0
    while total < most:
        size = min(total or tuning.FIRST_ROUND, most - total)
        if most - total - size < size / 2:
            size = most - total
        sizes.append(size)
        total += size
    return sizes


def _spread(count: int, blocks: int, generator: np.random.Generator) -> np.ndarray:
    """The numbers below `count` in such an order that each run of `blocks` of them is spread evenly.

    The numbers are cut into `blocks` blocks of neighbours; the order takes one at random from each
    block, then another from each, and so on.
    """
    length = -(-count // blocks)
    picks = generator.permuted(np.arange(blocks * length).reshape(blocks, length), axis=1)
    order = picks.T.ravel()
    return order[order < count]


def _rounds(order: np.ndarray, sizes: list[int]) -> list[Round]:
    """The points of `order` one after another, then more samples of all of them."""
    rounds: list[Round] = []
    begin = given = 0
    for size in sizes:
        unused = len(order) - begin
        if unused == 0 or (begin == 0 and size > unused * tuning.SAMPLES_A_POINT):
            more = max(1, size // len(order))
            # Whole steps.
            more = more if more < TRAINING_PASS else more // TRAINING_PASS * TRAINING_PASS
            rounds.append(Round(order, range(given, given + more)))
            begin, given = len(order), given + more
            continue
        samples = min(size, tuning.SAMPLES_A_POINT)
        count = size // samples
        # A rest too small for a round of its own is added to this one.
        count = unused if (unused - count) * samples < size else count
        rounds.append(Round(order[begin : begin + count], range(samples)))
        begin += count
        given = samples
    return rounds
