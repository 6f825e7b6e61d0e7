"""Samples over the image: how many, and cut into which passes."""

from __future__ import annotations

import numpy as np
import pytest

from ncv_cl.estimation.allocate import Allocation, allocate
from ncv_cl.estimation.tuning import FEWEST_SAMPLES, LARGEST_MULTIPLE


def magnitudes(points=5000, decades=4):
    return 10 ** np.random.default_rng(1).uniform(-decades, 0, points)


@pytest.mark.parametrize("average", [1, 3, 4, 16, 100, 4096])
def test_numbers_are_powers_of_two_and_keep_the_average(average):
    counts = allocate(magnitudes(), average)
    assert np.array_equal(counts, 2 ** np.rint(np.log2(counts)))
    assert 0.6 * average < counts.mean() <= average
    assert counts.min() >= min(FEWEST_SAMPLES, 2 ** int(np.log2(average)))
    assert counts.max() <= LARGEST_MULTIPLE * average


def test_larger_residuals_get_no_fewer_samples():
    magnitude = np.sort(magnitudes())
    assert (np.diff(allocate(magnitude, 64)) >= 0).all()


def test_numbers_depend_on_ratios_only():
    magnitude = magnitudes()
    np.testing.assert_array_equal(allocate(magnitude, 64), allocate(1e-9 * magnitude, 64))


@pytest.mark.parametrize("magnitude", [np.zeros(7), np.ones(7), np.full(7, 1e-30)])
def test_equal_points_get_the_same(magnitude):
    assert np.array_equal(allocate(magnitude, 64), np.full(7, 64))


def test_points_without_residual_get_the_fewest():
    counts = allocate(np.array([0.0, 1.0, 1.0, 1.0]), 64, fewest=16)
    assert counts[0] == 16 and (counts[1:] > 32).all()


def test_no_points_are_no_samples():
    assert allocate(np.empty(0), 16).size == 0
    assert Allocation.of_counts(np.empty(0, int)).part(0, 1, 1) == []


def test_the_allocation_lessens_the_error_of_the_image():
    magnitude = magnitudes()
    counts = allocate(magnitude, 64)
    assert np.sum(magnitude**2 / counts) < 0.6 * np.sum(magnitude**2 / 64)


@pytest.mark.parametrize("passes", [1, 2, 3, 7, 100])
def test_passes_draw_every_sample_once_and_something_of_every_point_at_first(passes):
    counts = np.random.default_rng(3).choice([1, 4, 5, 64, 256], 200)
    allocation = Allocation.of_counts(counts)
    next_sample = np.zeros(200, int)
    for number in range(passes):
        for points, samples in allocation.part(number, number + 1, passes):
            chosen = allocation.chosen[points.start : points.stop]
            assert (next_sample[chosen] == samples.start).all()
            next_sample[chosen] = samples.stop
        # The same share of everybody's, but enough for a variance at once.
        share = np.maximum(counts * (number + 1) / passes, np.minimum(counts, 2))
        assert (np.abs(next_sample - share) <= 1).all() and (next_sample >= np.minimum(counts, 2)).all()
    np.testing.assert_array_equal(next_sample, counts)


def test_a_restricted_allocation_keeps_its_points_numbers():
    counts = np.random.default_rng(4).choice([4, 16, 64], 50)
    some = np.array([3, 17, 44], np.uint32)
    part = Allocation.of_counts(counts).restricted(some, 50)
    assert sorted(part.chosen) == [3, 17, 44]
    np.testing.assert_array_equal(part.counts, counts[part.chosen])


def test_points_that_converge_early_are_counted():
    allocation = Allocation.of_counts(np.array([4, 64, 4, 24]))
    # Two points have 20 less than the average of 24 each.
    assert allocation.converged() == {"converged_points": 2, "converged_samples": 40}


def test_where_all_get_alike_nothing_has_converged():
    allocation = Allocation.uniform(np.arange(5, dtype=np.uint32), 16)
    assert allocation.converged() == {"converged_points": 0, "converged_samples": 0}
