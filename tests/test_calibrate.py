"""The variance of stratified estimates, found by estimating some points twice."""

from __future__ import annotations

import numpy as np
import pytest

from ncv_cl.estimation.calibrate import (
    calibrate,
    halves,
    local_mean,
    points_done_twice,
    steadied,
)
from ncv_cl.estimation.tuning import LOCAL_RADIUS, OWN_SHARE
from ncv_cl.sampling.accumulate import Estimate


@pytest.mark.parametrize("points", [1, 3, 100, 5000, 300_000])
def test_some_points_are_done_twice(points):
    twice = points_done_twice(points, 7)
    assert 1 <= len(twice) <= max(1, points / 4)
    assert len(np.unique(twice)) == len(twice) and twice.max() < points
    assert np.array_equal(twice, points_done_twice(points, 7))
    assert points < 10 or not np.array_equal(twice, points_done_twice(points, 8))


def two_estimates(points, generator, stratification, choices):
    """A point's truth, and two estimates with as many samples; independent ones would vary more.

    The better spread samples help the more the smaller a point's variance is.
    """
    deviation = 10 ** generator.uniform(-3, 0, points) * np.array([[1.0], [0.5], [0.1]])
    samples = generator.choice(choices, points)
    error = deviation / np.sqrt(samples) * deviation**stratification
    truth = generator.uniform(size=(3, points))
    # What a few samples say of their variance is itself uncertain.
    seen = [
        deviation**2 * generator.chisquare(samples - 1, deviation.shape) / (samples - 1) for _ in "12"
    ]
    both = [
        Estimate(truth + error * generator.normal(size=truth.shape), variance, samples.copy())
        for variance in seen
    ]
    return truth, both, deviation[0] ** 2 * generator.lognormal(0, 0.3, points)


@pytest.mark.parametrize("stratification", [0.0, 0.25, 0.5])
@pytest.mark.parametrize(("choices", "has_prior"), [([64.0], False), ([4.0, 16.0, 64.0], True)])
@pytest.mark.parametrize("points", [4000, 20_000])
def test_errors_over_predicted_deviations_have_unit_variance(points, choices, has_prior, stratification):
    generator = np.random.default_rng(2)
    standardised, of_twice, ratios = [], [], []
    for seed in range(20):
        truth, (first, second), prior = two_estimates(points, generator, stratification, choices)
        twice = points_done_twice(points, seed)
        expected, again = (
            steadied(one, prior if has_prior else None) / one.samples for one in (first, second)
        )
        found = calibrate(first, second.at(twice), twice, expected, again[:, twice])
        errors = (found.mean - truth) / np.sqrt(found.variance_of_mean)
        standardised.append(np.mean(errors**2))
        # Points done twice are known better, and know it.
        of_twice.append(np.mean(errors[:, twice] ** 2))
        ratios.append(found.variance_of_mean.mean() / np.mean((found.mean - truth) ** 2))
        np.testing.assert_array_equal(found.samples[twice], 2 * first.samples[twice])
    assert abs(np.sqrt(np.mean(standardised)) - 1) < 0.1
    assert abs(np.sqrt(np.mean(of_twice)) - 1) < 0.1
    assert abs(np.mean(ratios) - 1) < 0.1


def test_points_without_variance_stay_without():
    mean, variance = np.full((1, 40), 0.3), np.zeros((1, 40))
    variance[:, 20:] = 1.0
    estimate = Estimate(mean, variance, np.full(40, 8.0))
    twice = np.arange(0, 40, 4)
    found = calibrate(estimate, estimate.at(twice), twice, variance / 8, variance[:, twice] / 8)
    assert not found.variance_of_mean[:, :20].any() and (found.variance_of_mean < 1e-9).all()
    np.testing.assert_array_equal(found.mean, mean)


def test_local_means_are_those_of_the_neighbours_that_exist():
    rows, columns = 9, 7
    generator = np.random.default_rng(5)
    cell = np.sort(generator.choice(rows * columns, 40, replace=False))
    values = generator.uniform(size=40)
    found = local_mean(values, cell, columns, rows)
    row, column = cell // columns, cell % columns
    for point in range(40):
        near = (abs(row - row[point]) <= LOCAL_RADIUS) & (abs(column - column[point]) <= LOCAL_RADIUS)
        assert found[point] == pytest.approx(values[near].mean())


@pytest.mark.parametrize("share", [0.25, 0.5])
def test_parts_of_the_samples_say_where_the_error_is(share):
    """Where errors fall faster than samples do, all the same, up to one factor for all points."""
    generator = np.random.default_rng(3)
    rows = columns = 64
    cell = np.arange(rows * columns)
    deviation = 10.0 ** (cell // columns / 32 - 2)[None]
    part, rest = (generator.normal(0, deviation / s**0.75) for s in (share, 1 - share))
    found = halves(share * part + (1 - share) * rest, part, cell, columns, rows)
    ratio = (found / deviation**2).reshape(8, -1).mean(axis=1)
    # Means over neighbours smooth a slope of tenfold in 32 rows.
    assert ratio.max() / ratio.min() < 1.5
    own = np.corrcoef(found.ravel(), ((1 - share) * (part - rest)).ravel() ** 2)[0, 1]
    assert own > OWN_SHARE
