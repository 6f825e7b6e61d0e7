"""Samples over the image: how many, and cut into which passes."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from ncv_cl import render
from ncv_cl.estimation.allocate import Allocation, allocate
from ncv_cl.estimation.pilot import DARK_SHARE, expected, scales
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


# ------------------------------------------------------------------------------- relative errors


def expected_of(integral, alpha=None, before=None, direct=None, glow=None, side=1, columns=4):
    """`expected` of points that fill the first sub-pixels."""
    integral = np.asarray(integral, np.float32)
    points = SimpleNamespace(active=integral.shape[1], cell=np.arange(integral.shape[1]))
    settings = SimpleNamespace(
        columns=columns, rows=-(-integral.shape[1] // columns),
        sampling=SimpleNamespace(supersample=side),
    )  # fmt: skip
    if before is not None:
        before = SimpleNamespace(mean=np.asarray(before[0], float), samples=np.asarray(before[1]))
    if direct is not None:
        found = SimpleNamespace(mean=np.asarray(direct, float))
        direct = SimpleNamespace(result=lambda: found)
    variate = SimpleNamespace(integral=integral, alpha=None if alpha is None else np.asarray(alpha))
    problem = SimpleNamespace(points=points, glow=glow)
    return expected(problem, settings, variate, before, direct)


def test_the_integral_tells_a_pixels_value():
    np.testing.assert_allclose(expected_of([[1, 2, -3, 4], [3, 2, -3, 0]]), [2, 2, 0, 2])
    # It is divided by the coefficient that was folded in, and there is other light.
    found = expected_of([[1, 2], [1, 2]], alpha=[[0.5, 1], [2, 1]], direct=[[0, 4], [1, 4]])
    np.testing.assert_allclose(found, [(2 + 0.5 + 1) / 2, 6])
    np.testing.assert_allclose(expected_of([[1, 2]], glow=np.array([[3, 0]])), [4, 2])


def test_where_there_is_no_network_training_samples_near_it_tell_the_value():
    before = ([[2, 4, 99, 6]], [8, 8, 0, 8])
    found = expected_of([[0, 7, 7, 7]], alpha=[[0, 1, 1, 1]], before=before)
    np.testing.assert_allclose(found, [4, 7, 7, 7])


def test_points_of_a_pixel_have_its_value():
    found = expected_of([[1, 3, 5, 5, 1, 3, 5, 9]], side=2)
    np.testing.assert_allclose(found, [2, 2, 6, 6, 2, 2, 6, 6])


def test_errors_are_relative_to_values_and_a_part_of_their_mean():
    value = np.array([0.0, 1.0, 3.0])
    np.testing.assert_allclose(scales(value), value + DARK_SHARE * 4 / 3)
    assert np.array_equal(scales(np.zeros(3)), np.ones(3))


def test_relative_errors_are_less_where_samples_go_by_them(one_device, scenes):
    """Both are estimated errors, of one network; the picture has dark parts."""
    errors = {}
    for allocation in ("magnitude", "relative"):
        image = render(
            scenes / "occluders.toml", "direct", "ncv", spp=64, size=(48, 48), seed=1, density="none",
            visibility="points", sampler="independent", allocation=allocation, device=one_device,
        )  # fmt: skip
        scale = np.maximum(image.pixels, 0) + DARK_SHARE * image.pixels.mean()
        lit = image.variance > 0
        relative = (image.variance / scale**2)[lit].mean()
        errors[allocation] = (image.variance.mean(), relative)
    assert errors["relative"][1] < 0.8 * errors["magnitude"][1]
    assert errors["magnitude"][0] < 0.8 * errors["relative"][0]
