"""How many samples each shading point gets, and in which order they are drawn."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ..points.groups import Groups
from . import tuning

# Samples are numbered by 32 bits.
LARGEST_NUMBER_BITS = 31


class Run(NamedTuple):
    """Samples `samples` of each of the points order[i], i in `points`."""

    points: range
    samples: range


@dataclass(frozen=True)
class Allocation:
    """Numbers of samples, one a point.

    Attributes
    ----------
    chosen : ndarray
        uint32, the shading points that get samples, sorted by how many.
    counts : ndarray
        int64 (chosen,), samples of each of them.
    at_once : int
        Samples of a point that the first pass draws at least.
    grouped, members : int
        The first so many of `chosen` share paths, in groups of `members` (`Groups`).
    """

    chosen: np.ndarray
    counts: np.ndarray
    at_once: int = 1
    grouped: int = 0
    members: int = 1

    @classmethod
    def uniform(cls, chosen: np.ndarray, count: int) -> Allocation:
        """The same number for every chosen point, in the order given."""
        return cls(chosen, np.broadcast_to(np.int64(count), len(chosen)))

    @classmethod
    def of_groups(cls, groups: Groups, count: int) -> Allocation:
        """The same number for every point."""
        counts = np.full(len(groups.order), count, np.int64)
        return cls(groups.order, counts, grouped=groups.grouped, members=groups.members)

    @classmethod
    def of_counts(cls, counts: np.ndarray) -> Allocation:
        """counts[i] samples for point i."""
        chosen = np.argsort(counts, kind="stable").astype(np.uint32)
        # If drawing ends early, no point may have a single sample, of which there is no variance; nor
        # may all of a point's few samples come at once, since its error is read off the difference of
        # its halves.
        return cls(chosen, np.asarray(counts, np.int64)[chosen], 2)

    def restricted(self, points: np.ndarray, total: int) -> Allocation:
        """The same numbers for some of the points only; `total` is the number of all points.

        Of groups all members or none must be among them.
        """
        mask = np.zeros(total, bool)
        mask[points] = True
        kept = mask[self.chosen]
        grouped = int(np.count_nonzero(kept[: self.grouped]))
        return Allocation(self.chosen[kept], self.counts[kept], self.at_once, grouped, self.members)

    @property
    def samples(self) -> int:
        """Samples of all points together."""
        return int(self.counts.sum())

    def converged(self) -> dict[str, int]:
        """How many points get the fewest samples, and how many samples that saves.

        Returns
        -------
        dict
            ``converged_points``, 0 if all points get the same number, and ``converged_samples``, how
            many samples less than the average they get together.
        """
        fewest = int(self.counts.min()) if len(self.counts) else 0
        points = int(np.count_nonzero(self.counts == fewest))
        if points == len(self.counts):
            return {"converged_points": 0, "converged_samples": 0}
        saved = points * (self.samples / len(self.counts) - fewest)
        return {"converged_points": points, "converged_samples": round(saved)}

    def part(self, begin: int, end: int, whole: int) -> list[Run]:
        """The samples of parts `begin` to `end` of `whole`; the first part has `at_once` at least."""
        firsts = np.flatnonzero(np.diff(self.counts, prepend=-1)).tolist()
        runs = []
        for first, last in itertools.pairwise([*firsts, len(self.counts)]):
            count = int(self.counts[first])
            once = min(count, self.at_once)
            samples = range(*(max(-(-count * at // whole), once if at else 0) for at in (begin, end)))
            if samples:
                runs.append(Run(range(first, last), samples))
        return runs


def allocate(
    magnitude: np.ndarray,
    average: int,
    fewest: int | None = None,
) -> np.ndarray:
    """Samples for each point, as a power of its predicted residual; int64 (points,).

    Numbers are powers of two, for which Sobol points are best spread, at least `fewest` (or the average
    if that is less), and their mean is at most `average`. They do not depend on the samples that are
    then drawn, so estimates stay unbiased.

    Parameters
    ----------
    magnitude : ndarray
        (points,), non-negative: the root mean square of each point's residual.
    average : int
        Samples a point on average.
    fewest : int, optional
        A power of two; `tuning.FEWEST_SAMPLES` by default.

    Notes
    -----
    Minimises the sum of magnitude² / n^(2 / power - 1) for a given sum of n (Lagrange multiplier), power
    being `tuning.MAGNITUDE_POWER`.
    """
    if not len(magnitude):
        return np.zeros(0, np.int64)
    fewest = min(fewest or tuning.FEWEST_SAMPLES, 1 << (average.bit_length() - 1))
    most = 1 << min((tuning.LARGEST_MULTIPLE * average).bit_length() - 1, LARGEST_NUMBER_BITS)
    with np.errstate(divide="ignore"):
        # Of zero: minus infinity, which gets the fewest.
        wanted = tuning.MAGNITUDE_POWER * np.log2(np.asarray(magnitude, np.float64))
    if not np.isfinite(wanted).any():
        return np.full(len(wanted), average, np.int64)
    ranked = np.sort(wanted)
    levels = np.arange(fewest.bit_length() - 1, most.bit_length())
    numbers = np.exp2(levels)

    def mean(shift: float) -> float:
        """Mean number of samples a point if all logarithms of weights are shifted by this."""
        # A point takes the nearest level, in logarithms.
        ends = np.searchsorted(ranked, levels[:-1] + 0.5 - shift, side="left")
        return float(np.diff(ends, prepend=0, append=len(ranked)) @ numbers) / len(ranked)

    low, high = levels[0] - ranked[-1] - 1, levels[-1] - ranked[np.isfinite(ranked)][0] + 1
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if mean(middle) > average else (middle, high)
    level = np.searchsorted(levels[:-1] + 0.5 - low, wanted, side="right")
    return numbers[level].astype(np.int64)
