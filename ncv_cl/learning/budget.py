"""The number of training samples: rounds of them, and whether another round would pay."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ..points.sampler import HostStream, host_generator

# Samples of a point that are drawn at a time; fewer of `train_spp` are so many at fewer points.
TRAINING_PASS = 16
# Samples of a point in a round with fewer than that on average. More at fewer points leave the same
# residual (within 4 %, Cornell box and occluders at 256 x 256), and points cost their gather lists.
SAMPLES_A_POINT = 32
# Samples of the first round and of all rounds at most; each round has about as many as all before. Two
# rounds are always drawn where they are allowed: with half of that the Cornell box had 2.3 times the
# error at 256 samples a point, and training was shorter by less than a tenth of a second.
FIRST_ROUND = 1 << 17
MOST_SAMPLES = 1 << 21
# Training samples over samples of the estimate, at most.
LARGEST_SHARE = 0.25
# Points that are held out, and the part of all points that may be.
HELD_OUT_POINTS = 512
HELD_OUT_SHARE = 1 / 16
# What one use of a training sample, with its share of what a round takes to begin, and one traced ray
# cost, in residual samples whose visibility is tested on the device. Measured on two quiet cores: 4 to
# 10 (direct light, 256 x 256 and 512 x 512), and 3 to 4. Never what the clock says, since a render must
# be the same again.
USE_COST = 8.0
RAY_COST = 3.0
# Samples of the estimate that reach an error, drawn by density and allocation, are as the residual's
# variance to this power. Measured at 256 samples a point where 2^18 training samples or more are
# doubled: 0 to 0.5 (direct light of Cornell box and occluders, where in the end only shadows' edges are
# left), 0.3 to 0.4 (ambient occlusion of the knot). With fewer it is more, 0.3 to 0.8.
GAIN = 0.25


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
    sizes = _sizes(min(MOST_SAMPLES, int(active * max(spp * LARGEST_SHARE, 1.0))))
    held = min(HELD_OUT_POINTS, int(active * HELD_OUT_SHARE))
    if len(sizes) == 1 or held == 0:
        sizes, held = [sum(sizes)], 0
    generator = host_generator(seed, HostStream.TRAINING_POINTS)
    points = np.arange(active, dtype=np.uint32)
    out = _spread(active, held, generator)[:held] if held else points[:0]
    rest = np.delete(points, out)
    rest = rest[_spread(len(rest), min(len(rest), -(-sizes[0] // SAMPLES_A_POINT)), generator)]
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
    rounds, so the first one does not decide. The estimate needs samples as V to the power GAIN.
    """
    used, variance = found[-1]
    if variance <= 0.0 or len(found) < 2:
        return variance > 0.0
    earlier, larger = found[max(0, len(found) - 3)]
    fall = max(0.0, math.log(larger / variance) / math.log(used / earlier))
    left = ((used + following.count) / used) ** -fall
    a_sample = 1.0 + RAY_COST * rays
    saved = samples * a_sample * (1.0 - left**GAIN)
    return saved > following.count * (a_sample + epochs * USE_COST)


def _sizes(most: int) -> list[int]:
    """Samples of each round: as many as all before, the last one not much fewer."""
    sizes, total = [], 0
    while total < most:
        size = min(total or FIRST_ROUND, most - total)
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
        if unused == 0 or (begin == 0 and size > unused * SAMPLES_A_POINT):
            more = max(1, size // len(order))
            # Whole steps.
            more = more if more < TRAINING_PASS else more // TRAINING_PASS * TRAINING_PASS
            rounds.append(Round(order, range(given, given + more)))
            begin, given = len(order), given + more
            continue
        samples = min(size, SAMPLES_A_POINT)
        count = size // samples
        # A rest too small for a round of its own is added to this one.
        count = unused if (unused - count) * samples < size else count
        rounds.append(Round(order[begin : begin + count], range(samples)))
        begin += count
        given = samples
    return rounds
