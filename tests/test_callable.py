"""Other people's integrands: known integrals are met, by every way of sampling."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from fitting import fitting
from scipy import stats

import ncv_cl as ncv
from ncv_cl.integrands import IntegrandError

POINTS = 64
RADII = np.linspace(0.1, 0.5, POINTS)
WAYS = [
    {"method": "mc"},
    {"method": "mc", "sampler": "independent"},
    {"method": "ncv", "train_spp": 32},
    {"method": "ncv", "train_spp": 32, "sampler": "independent"},
    {"method": "ncv", "train_spp": 32, "density": "none", "allocation": "uniform"},
    {"method": "ncv", "train_spp": 32, "density": "subdivision"},
    {"method": "ncv", "train_spp": 32, "preset": "slides"},
]


def disks(u, v, point):
    """The slides' disk, one radius a point; its integral is its area."""
    return (np.hypot(u - 0.5, v - 0.5) < RADII[point]).astype(float)


def waves(u, v, point):
    """Two channels, one of either sign: integrals 0.25 + k / 10 and 0."""
    return np.stack([u * v + point / 10, np.sin(2 * math.pi * u)], axis=-1)


@pytest.mark.parametrize("way", WAYS, ids=lambda way: "-".join(map(str, way.values())))
def test_a_family_of_disks_has_its_areas(one_device, way):
    seeds = 8
    errors = np.array(
        [
            ncv.estimate(
                disks, POINTS, RADII[:, None], spp=32, seed=seed, device=one_device, **way
            ).mean[:, 0]
            - math.pi * RADII**2
            for seed in range(seeds)
        ]
    )
    # Student's t of every point, and of the mean over all points, which sees a bias that they share.
    for values in (errors, errors.mean(axis=1, keepdims=True)):
        deviation = values.std(axis=0, ddof=1) / math.sqrt(seeds)
        score = np.abs(values.mean(axis=0)) / np.maximum(deviation, 1e-7)
        assert score.max() < stats.t.isf(1e-4 / values.shape[1], seeds - 1)


def test_the_control_variate_lowers_the_variance(one_device):
    options = {"spp": 64, "sampler": "independent", "device": one_device}
    plain = ncv.estimate(disks, POINTS, RADII[:, None], method="mc", **options)
    found = ncv.estimate(disks, POINTS, RADII[:, None], train_spp=256, **options)
    assert found.variance.mean() < 0.4 * plain.variance.mean()
    assert found.stats["residual_variance_ratio"] < 0.4
    assert found.network_integral.shape == (POINTS, 1)


def test_channels_and_signs(device):
    found = ncv.estimate(waves, 5, np.arange(5.0)[:, None], channels=2, spp=256, device=device)
    expected = np.stack([0.25 + np.arange(5) / 10, np.zeros(5)], axis=-1)
    np.testing.assert_allclose(found.mean, expected, atol=1e-2)


def test_one_integral_needs_no_features(one_device):
    found = ncv.estimate(lambda u, v, point: u + v, spp=64, device=one_device)
    assert found.mean[0, 0] == pytest.approx(1, abs=1e-2)


def test_a_seed_gives_the_same_bits(one_device):
    first, second = (
        ncv.estimate(disks, POINTS, RADII[:, None], spp=16, device=one_device) for _ in range(2)
    )
    np.testing.assert_array_equal(first.mean, second.mean)


@pytest.mark.parametrize(
    ("function", "options", "message"),
    [
        (lambda u, v, point: u[:-1], {}, "f must return"),
        (lambda u, v, point: np.stack([u, v]), {"channels": 2}, "f must return"),
        (lambda u, v, point: np.where(point == 3, np.nan, u), {}, "not finite at .* point 3"),
        (lambda u, v, point: np.where(point > 61, np.inf, u), {}, "at 34 of .* of 2 points.* point 62"),
        (lambda u, v, point: np.where(point == 5, 1e30, u), {}, "beyond its median .* point 5"),
        (lambda u, v, point: u + 1j, {}, "real numbers"),
        (lambda u, v, point: np.full(u.shape, "one"), {}, "real numbers"),
        (disks, {"features": np.full((POINTS, 1), "one")}, "features must be real numbers"),
        (disks, {"features": np.zeros(POINTS)}, r"features must be \(64, 1 to 3\)"),
        (disks, {"features": np.full((POINTS, 1), np.inf)}, "features must be finite"),
        (disks, {"points": 0}, "at least 1"),
        (disks, {"channels": 0}, "at least 1"),
        (disks, {"method": "auto"}, "method must be ncv or mc"),
        (disks, {"spp": 0}, "spp must be a whole number"),
    ],
)
def test_bad_input_is_refused_by_name(one_device, function, options, message):
    with pytest.raises((ValueError, IntegrandError), match=message):
        ncv.estimate(function, **{"points": POINTS, "device": one_device, **options})


def test_one_integral_is_learned_from_few_samples(device):
    found = ncv.estimate(
        lambda u, v, _: np.exp(-4 * ((u - 0.4) ** 2 + (v - 0.6) ** 2)),
        spp=256,
        train_spp=64,
        sampler="independent",
        density="none",
        device=device,
    )
    # Eight passes over 64 samples are 32 steps, after which a fourteenth is left.
    assert found.stats["residual_variance_ratio"] < 0.03


def error_of(function, features, device, shift=0.0, **way):
    """Root mean square over points and a few seeds, of f plus a constant."""
    found = [
        ncv.estimate(
            lambda u, v, point: function(u, v, point) + shift,
            POINTS,
            features,
            spp=32,
            seed=seed,
            device=device,
            **way,
        ).mean[:, 0]
        for seed in range(4)
    ]
    return float(np.sqrt(np.mean((np.array(found) - shift - math.pi * RADII**2) ** 2)))


@pytest.mark.parametrize("way", WAYS, ids=lambda way: "-".join(map(str, way.values())))
def test_a_constant_costs_nothing(one_device, way):
    alone = error_of(disks, RADII[:, None], one_device, **way)
    for shift in (1e4, -1e6):
        # float64 rounds f plus 1e6 to 1e-10.
        assert error_of(disks, RADII[:, None], one_device, shift, **way) == pytest.approx(
            alone, rel=0.02
        )


def test_constants_of_channels_are_their_own(one_device):
    shift = np.array([1e5, -3.0])
    found = ncv.estimate(
        lambda u, v, point: waves(u, v, point) + shift,
        5,
        np.arange(5.0)[:, None],
        channels=2,
        train_spp=64,
        device=one_device,
    )
    expected = np.stack([0.25 + np.arange(5) / 10, np.zeros(5)], axis=-1) + shift
    np.testing.assert_allclose(found.mean, expected, rtol=0, atol=2e-2)
    # What the network integrates to is of f itself, too.
    np.testing.assert_allclose(found.network_integral, expected, rtol=0, atol=0.5)


@pytest.mark.parametrize(("shift", "scale"), [(1e6, 1.0), (-1e12, 1e3), (0.0, 1e300)])
def test_features_far_from_zero_are_told_apart(one_device, shift, scale):
    way = {"method": "ncv", "train_spp": 32}
    near = error_of(disks, RADII[:, None], one_device, **way)
    far = error_of(disks, RADII[:, None] * scale + shift, one_device, **way)
    # Rounding of the features themselves, 1e-10 to 1e-7 of their range, is all that differs.
    assert far == pytest.approx(near, rel=0.1)


@pytest.mark.parametrize("method", ["mc", "ncv"])
@pytest.mark.parametrize("sampler", ["sobol", "independent"])
def test_one_sample_has_no_variance(one_device, method, sampler):
    options = fitting(method, sampler=sampler, spp=1, allocation="uniform", train_spp=4)
    found = ncv.estimate(disks, POINTS, RADII[:, None], device=one_device, **options)
    assert np.isfinite(found.mean).all() and np.isnan(found.variance).all()
    json.dumps(found.stats, allow_nan=False)
