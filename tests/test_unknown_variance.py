"""A variance that is not known is said to be so: NaN, null and a note, never zero."""

from __future__ import annotations

import json

import numpy as np
import pytest

from ncv_cl import GlobalIllumination, Image, render
from ncv_cl.cli import main
from ncv_cl.estimation.calibrate import calibrate, local_mean, steadied
from ncv_cl.estimation.pilot import allocate_by_pilot
from ncv_cl.output.report import finite
from ncv_cl.output.resolve import combine
from ncv_cl.sampling.accumulate import Estimate

SIZE = (24, 20)
WAYS = [
    ("direct", {"method": "mc"}),
    ("direct", {"method": "mc", "sampler": "independent"}),
    ("direct", {"method": "mc", "allocation": "pilot"}),
    ("direct", {"method": "ncv", "train_spp": 2}),
    ("direct", {"method": "ncv", "train_spp": 2, "sampler": "independent"}),
    ("direct", {"method": "ncv", "train_spp": 2, "allocation": "uniform", "density": "none"}),
    ("ao", {"method": "ncv", "train_spp": 1, "preset": "slides"}),
    ("direct", {"method": "auto"}),
    ("gi", {"method": "mc"}),
    ("gi", {"method": "ncv", "train_spp": 2}),
]


def hit(image):
    """Pixels that are neither background nor light."""
    return (image.layers["depth"] > 0) & image.layers["albedo"].any(axis=2)


@pytest.mark.parametrize(("integrand", "options"), WAYS)
def test_one_sample_a_point_has_no_variance(one_device, scenes, integrand, options):
    image = render(scenes / "occluders.toml", integrand, spp=1, size=SIZE, device=one_device, **options)
    assert np.isfinite(image.pixels).all() and image.pixels.any()
    unknown = np.isnan(image.variance).any(axis=2)
    assert unknown.sum() > 0.5 * hit(image).sum() and not unknown[~hit(image)].any()
    # Where it is known it is not zero for want of samples: points with one are not among these.
    assert image.stats["estimated_mse"] is None
    assert image.stats["pixels_without_variance"] == unknown.sum()
    assert image.metadata["variance"].startswith(f"not known at {unknown.sum()} of {unknown.size}")
    json.dumps(image.stats, allow_nan=False)


def test_an_unknown_variance_is_no_reason_to_stop(one_device, scenes):
    for sampler in ("sobol", "independent"):
        image = render(
            scenes / "occluders.toml",
            "ao",
            "mc",
            2,
            SIZE,
            sampler=sampler,
            device=one_device,
            target_mse=1e3,
        )
        # Passes of one sample each.
        assert image.stats["ended_by"] == "samples"
        assert image.stats["samples_per_point_range"][0] == 2
        assert image.stats["estimated_mse"] > 0 and "variance" not in image.metadata


def test_a_pixel_with_one_unknown_point_is_unknown(one_device, scenes):
    image = render(
        scenes / "occluders.toml", "direct", "ncv", spp=1, train_spp=2, supersample=3, size=SIZE,
        device=one_device,
    )  # fmt: skip
    known = hit(image) & np.isfinite(image.variance).all(axis=2)
    assert np.isfinite(image.pixels).all() and np.isnan(image.variance).any()
    # A pixel has nine points, of which most have one sample.
    assert known.sum() < 0.1 * hit(image).sum()


def test_a_sum_of_two_estimates_knows_no_more_than_either(one_device, scenes):
    options = {"spp": 1, "size": SIZE, "method": "mc", "device": one_device}
    image = render(scenes / "occluders.toml", "gi", **options)
    assert np.isnan(image.variance).any() and image.stats["estimated_mse"] is None
    # Of direct light there are more samples.
    assert image.stats["direct"]["estimated_mse"] > 0
    known = render(scenes / "occluders.toml", "gi", **{**options, "spp": 8})
    rest = render(scenes / "occluders.toml", GlobalIllumination(direct=False), **{**options, "spp": 8})
    parts = [known.stats["direct"]["estimated_mse"], rest.stats["estimated_mse"]]
    assert known.stats["estimated_mse"] == pytest.approx(sum(parts), rel=1e-5)
    assert "variance" not in known.metadata and "pixels_without_variance" not in known.stats


def test_the_note_and_the_layer_are_in_the_file(one_device, scenes, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    device = str(one_device.index)
    options = ["--size", "12x8", "--spp", "1", "--device", device, "-o", "a.exr", "-o", "a.png"]
    assert main(["render", str(scenes / "occluders.toml"), *options, "--json", "a.json"]) == 0
    assert "estimated MSE not known" in capsys.readouterr().out
    image = Image.read("a.exr")
    assert np.isnan(image.variance).any() and "not known" in image.metadata["variance"]
    stats = json.loads((tmp_path / "a.json").read_text(), parse_constant=lambda name: 1 / 0)
    assert stats["estimated_mse"] is None


# ---- parts -----------------------------------------------------------------------------------------


def estimate(samples, variance=1.0, mean=0.0):
    samples = np.asarray(samples, float)
    known = np.where(samples > 1, variance, np.nan)[None]
    return Estimate(np.full(known.shape, mean), known, samples)


def test_unknown_values_do_not_spoil_their_neighbours_mean():
    values = np.array([np.nan, 2.0, 4.0, np.nan, np.nan])
    # The first three are neighbours, the others are alone.
    found = local_mean(values, np.array([0, 1, 2, 15, 30]), 40, 1)
    np.testing.assert_allclose(found, [3, 3, 3, 0, 0])


def test_calibration_leaves_out_what_is_not_known():
    generator = np.random.default_rng(0)
    samples = np.where(np.arange(400) % 5, 8.0, 1.0)
    first, second = estimate(samples), estimate(samples)
    first.mean[...], second.mean[...] = generator.normal(0, 0.25, (2, 1, 400))
    twice = np.arange(0, 400, 2)
    expected = steadied(first, np.ones(400)) / samples
    found = calibrate(first, second.at(twice), twice, expected, expected[:, twice]).variance_of_mean
    assert np.array_equal(np.isnan(found[0]), samples < 2)
    alone = np.setdiff1d(np.flatnonzero(samples > 1), twice)
    assert found[0, alone] == pytest.approx(0.0625, rel=0.2)


def test_two_estimates_that_differ_have_a_variance_though_their_samples_do_not():
    first, second = (estimate([4.0] * 8, 0.0, mean) for mean in (1.0, 3.0))
    twice = np.array([1, 5])
    nothing = np.zeros((1, 8))
    found = calibrate(first, second.at(twice), twice, nothing, nothing[:, twice])
    np.testing.assert_allclose(
        found.variance_of_mean, np.where(np.isin(np.arange(8), twice), 1.0, 2.0)[None]
    )


def test_where_no_variance_is_known_samples_are_weighed_by_their_number():
    mean, unknown = np.ones((1, 4)), np.full((1, 4), np.nan)
    training = estimate([3, 3, 0, 3], 1.0, 5.0)
    combined, variance = combine(mean, unknown, training, 1.0)
    np.testing.assert_allclose(combined, [[4, 4, 1, 4]])
    assert np.isnan(variance).all()


def test_points_whose_variance_is_unknown_do_not_decide_the_weight():
    generator = np.random.default_rng(2)
    variance = np.full((1, 8000), 0.04)
    mean = generator.normal(0, 0.2, variance.shape)
    training = estimate(np.full(8000, 4.0), 0.16)
    training.mean[...] = generator.normal(0, 0.2, variance.shape)
    whole = combine(mean, variance, training, 1.0)[0]
    variance[:, ::2] = np.nan
    half, found = combine(mean, variance, training, 1.0)
    np.testing.assert_allclose(half, whole, atol=0.03)
    assert np.array_equal(np.isnan(found[0]), np.arange(8000) % 2 == 0)
    # Single training samples have the error that was seen of all.
    lone = Estimate(training.mean, np.full(variance.shape, np.nan), np.ones(8000))
    assert combine(mean, variance, lone, 1.0)[1][0, 1] == pytest.approx(0.02, rel=0.1)


def test_a_pilot_of_one_sample_tells_nothing_apart():
    found = allocate_by_pilot(estimate(np.ones(100)), 9)
    assert (found.counts == 8).all()


def test_what_json_does_not_know_becomes_null():
    mixed = {"a": [1, float("nan"), (np.float32("inf"), "x")], "b": {"c": -np.inf, "d": None}, "e": True}
    expected = {"a": [1, None, [None, "x"]], "b": {"c": None, "d": None}, "e": True}
    assert finite(mixed) == expected
