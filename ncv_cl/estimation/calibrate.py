"""Variances of estimates from stratified samples, calibrated by points that are estimated twice."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..points.sampler import HostStream, host_generator
from ..sampling.accumulate import Estimate
from . import tuning
from .allocate import Allocation

# Points that are worked at together: 24 MiB of three channels; more would only take memory.
POINTS_AT_ONCE = 1 << 20
# Stands for a ratio of zero, which has no logarithm.
LEAST_RATIO = 1e-9


def points_done_twice(points: int, seed: int, allocation: Allocation | None = None) -> np.ndarray:
    """Indices of the points to estimate a second time, uint32, sorted; at random.

    Where the `allocation` has groups, which share paths, it has all points, and groups are estimated a
    second time as wholes.
    """
    wanted = np.clip(points * tuning.TWICE_SHARE, tuning.FEWEST_TWICE, tuning.MOST_TWICE)
    count = max(min(points, 1), int(min(wanted, points * tuning.LARGEST_TWICE_SHARE)))
    generator = host_generator(seed, HostStream.POINTS_DONE_TWICE)
    if allocation is None or not allocation.grouped:
        return np.sort(generator.choice(points, count, replace=False)).astype(np.uint32)
    groups = allocation.chosen[: allocation.grouped].reshape(-1, allocation.members)
    others = allocation.chosen[allocation.grouped :]
    number = max(1, round(count / points * len(groups)))
    chosen = groups[generator.choice(len(groups), number, replace=False)].ravel()
    alone = generator.choice(len(others), round(count / points * len(others)), replace=False)
    return np.sort(np.concatenate([chosen, others[alone]]))


def local_mean(values: np.ndarray, cell: np.ndarray, columns: int, rows: int) -> np.ndarray:
    """Mean of `values` (points,) over the points within so many sub-pixels, along both axes.

    `cell` holds the points' sub-pixels, row-major on a grid of `rows` x `columns`. Neighbours help where
    a point's few samples missed what theirs saw. NaN values do not count; the mean is 0 where all are
    NaN.
    """
    known = ~np.isnan(values)
    total = _box_sums(np.where(known, values, 0.0), cell, columns, rows)
    count = _box_sums(known, cell, columns, rows)
    np.maximum(count, 1, out=count)
    np.divide(total, count, out=total)
    return np.maximum(total, 0.0, out=total)


def _box_sums(values: np.ndarray, cell: np.ndarray, columns: int, rows: int) -> np.ndarray:
    """Sum of `values` (points,) over each point's box, float64, in little memory."""
    radius = tuning.LOCAL_RADIUS
    width, stride = 2 * radius + 1, columns + 2 * radius + 1
    sums = np.zeros((rows + width, stride))
    found = np.empty(len(cell))
    parts = [slice(first, first + POINTS_AT_ONCE) for first in range(0, len(cell), POINTS_AT_ONCE)]

    def corner(part: slice, down: int, right: int) -> np.ndarray:
        own = cell[part].astype(np.int64)
        return (own // columns + down) * stride + own % columns + right

    flat = sums.reshape(-1)
    for part in parts:
        flat[corner(part, radius + 1, radius + 1)] = values[part]
    # Sums over boxes as differences of sums over all that lies above and to the left.
    np.cumsum(sums, axis=0, out=sums)
    np.cumsum(sums, axis=1, out=sums)
    for part in parts:
        found[part] = (
            flat[corner(part, width, width)]
            - flat[corner(part, 0, width)]
            - flat[corner(part, width, 0)]
            + flat[corner(part, 0, 0)]
        )
    return found


def calibrate(
    first: Estimate, second: Estimate, twice: np.ndarray, expected: np.ndarray, repeated: np.ndarray
) -> Estimate:
    """Merge two estimates into one, with a variance that holds for stratified samples.

    Half the squared difference of two independent estimates of a point is an unbiased estimate of their
    variance, but a single one is very noisy. So points are sorted by their expected variance and cut
    into classes; each class gives one ratio of measured to expected variance. Between the classes'
    middles the ratio is interpolated, and every point's expected variance is multiplied by it.

    Parameters
    ----------
    first : Estimate
        Of all points.
    second : Estimate
        Of the points `twice` alone, with as many samples as the first and another scramble.
    twice : ndarray
        uint32.
    expected : ndarray
        (channels, points), the first estimate's expected variance, from `steadied` or `halves`. Only its
        order and its ratios within a class matter.
    repeated : ndarray
        (channels, points done twice), the same of the second estimate.
    """
    difference = first.mean[:, twice] - second.mean
    measured = 0.5 * difference**2
    # With fewer than two samples a point has no variance of its own.
    expected = np.where(first.known, expected, np.nan)
    both = 0.5 * (expected[:, twice] + repeated)
    if np.any(both > 0):
        found = _scaled_by_ratio(both.ravel(), measured.ravel(), expected)
    else:
        # Even if no point's samples differ, its two estimates may.
        found = np.where(np.isnan(expected), np.nan, measured.mean())
    mean, variance, samples = first.mean.copy(), found, first.samples.copy()
    mean[:, twice] = 0.5 * (first.mean[:, twice] + second.mean)
    variance[:, twice] *= 0.5
    samples[twice] += second.samples
    return replace(first, mean=mean, samples=samples, calibrated=variance)


def halves(mean: np.ndarray, part: np.ndarray, cell: np.ndarray, columns: int, rows: int) -> np.ndarray:
    """Expected variance of `mean`, from its difference to the mean of a `part` of the samples.

    Up to a factor that all points share, the squared difference between parts of a point's samples
    estimates its variance, for any sampler. It is averaged with its neighbours', which makes it less
    noisy.

    Parameters
    ----------
    mean, part : ndarray
        (channels, points).
    cell, columns, rows
        As `local_mean` takes them.
    """
    squares = mean - part
    np.square(squares, out=squares)
    for row in squares:
        near = local_mean(row, cell, columns, rows)
        near *= 1 - tuning.OWN_SHARE
        row *= tuning.OWN_SHARE
        row += near
    return squares


def steadied(estimate: Estimate, prior: np.ndarray | None) -> np.ndarray:
    """Variances of single samples, (channels, points), each averaged with the prior.

    The variance of few samples is itself uncertain, so the prior counts as `PRIOR_SAMPLES` more. With
    fewer than two samples it stays unknown.

    Parameters
    ----------
    prior : ndarray, optional
        (points,), what the variance of a point's sample was predicted to be, up to a common factor.
    """
    if prior is None or not np.any(prior):
        return estimate.variance
    degrees = np.maximum(estimate.samples - 1, 0)
    squares = np.where(estimate.known, estimate.variance * degrees, 0.0)
    scale = squares.sum(axis=1) / max(np.sum(prior * degrees), 1e-300)
    expected = scale[:, None] * prior
    found = (squares + tuning.PRIOR_SAMPLES * expected) / (degrees + tuning.PRIOR_SAMPLES)
    return np.where(estimate.known, found, np.nan)


def _scaled_by_ratio(expected: np.ndarray, measured: np.ndarray, where: np.ndarray) -> np.ndarray:
    """`where` times the ratio measured / expected, which is a function of expected."""
    positive = np.flatnonzero(expected > 0)
    ranked = positive[np.argsort(expected[positive], kind="stable")]
    number = np.clip(len(ranked) // tuning.VALUES_A_CLASS, 1, tuning.MOST_CLASSES)
    classes = np.array_split(ranked, int(number))
    sums = np.array([expected[one].sum() for one in classes])
    # The middle of a class is the mean logarithm weighted by the expected variance, as its sum is; else
    # steep curves would be read at the wrong place.
    middle = np.array([(expected[one] @ np.log(expected[one])) for one in classes]) / sums
    ratios = np.array([measured[one].sum() for one in classes]) / sums
    # Straight between logarithms, constant beyond the first and the last class.
    logarithms = np.log(np.maximum(ratios, LEAST_RATIO))
    found = np.empty_like(where)
    for first in range(0, where.shape[1], POINTS_AT_ONCE):
        part = where[:, first : first + POINTS_AT_ONCE]
        places = np.log(np.maximum(part, np.exp(middle[0] - 1)))
        found[:, first : first + POINTS_AT_ONCE] = part * np.exp(np.interp(places, middle, logarithms))
    return found
