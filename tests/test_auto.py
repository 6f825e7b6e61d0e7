"""Whether a control variate pays: what is predicted, and that a render does as predicted."""

from __future__ import annotations

import numpy as np
import pytest
from test_determinism import assert_same_bits

from ncv_cl import render
from ncv_cl.estimation import auto
from ncv_cl.estimation.auto import predict, too_short
from ncv_cl.opencl.probe import Probe
from ncv_cl.sampling.accumulate import Estimate

POINTS = 4096
OPTIONS = {"spp": 64, "train_spp": 16, "size": (8, 8)}


@pytest.fixture
def fast_probe(monkeypatch):
    """A device whose inference sample takes ten nanoseconds."""
    monkeypatch.setattr(auto, "cached_probe", lambda device: Probe(10.0, True))


@pytest.fixture
def asked(monkeypatch):
    """No image is too short for a first pass."""
    monkeypatch.setattr(auto, "LONGEST_SAMPLE", np.inf)


def first_pass(variance):
    return Estimate(np.zeros((1, POINTS)), variance[None], np.full(POINTS, 16.0))


def prediction(share=1.0, spp=4096, seconds=0.1, **options):
    """Where a `share` of the points has all the variance."""
    variance = np.where(np.arange(POINTS) < share * POINTS, 1.0, 0.0)
    return predict(None, first_pass(variance), None, seconds, spp, **options)


def test_plain_monte_carlo_is_predicted_by_its_first_pass(fast_probe):
    assert prediction(spp=1616, seconds=0.5).mc_seconds == pytest.approx(50)


def test_allocation_gains_where_few_points_have_the_variance(fast_probe):
    alike, few = prediction(1.0), prediction(0.25)
    assert alike.variance_gain == pytest.approx(auto.DENSITY_GAIN)
    assert few.variance_gain == pytest.approx(4 * auto.DENSITY_GAIN)
    assert few.ncv_seconds < alike.ncv_seconds


def test_differences_of_points_done_twice_say_where_the_error_is(fast_probe):
    """Half of them differ, normally distributed: a gain of two."""
    difference = np.random.default_rng(0).normal(size=(1, 20000)) * (np.arange(20000) % 2)
    found = predict(None, first_pass(np.ones(POINTS)), difference, 0.1, 4096)
    assert found.variance_gain == pytest.approx(2 * auto.DENSITY_GAIN, rel=0.05)


def test_shadows_of_many_triangles_gain_less(fast_probe):
    few, many = (prediction(0.25, occluders=count) for count in (0.0, auto.HALVING_OCCLUDERS))
    assert many.variance_gain == pytest.approx(few.variance_gain / 2)


def test_a_few_points_that_differ_promise_no_more_than_was_ever_gained(fast_probe):
    assert prediction(0.001).variance_gain == auto.DENSITY_GAIN * auto.LARGEST_ALLOCATION_GAIN


@pytest.mark.parametrize(
    ("share", "spp", "method"),
    [(0.25, 65536, "ncv"), (0.25, 64, "mc"), (0.0, 65536, "mc")],
    ids=["long", "short", "no variance"],
)
def test_the_method_is_what_is_predicted_to_be_faster(fast_probe, share, spp, method):
    found = prediction(share, spp)
    assert found.method == method
    if share:
        assert (found.ncv_seconds < auto.MARGIN * found.mc_seconds) == (method == "ncv")


def test_nested_samples_gain_by_the_length_of_their_paths(fast_probe):
    short, long = (prediction(spp=256, nested_rays=rays) for rays in (2.0, 12.0))
    assert short.variance_gain == 1.0 and short.method == "mc"
    assert long.variance_gain == 12 * auto.NESTED_GAIN and long.method == "ncv"


def test_training_samples_that_are_dear_count(fast_probe):
    free, dear = (prediction(training_samples=count, nested_rays=8.0) for count in (0.0, 16.0))
    # As many as the first pass took, and their use.
    assert dear.ncv_seconds > free.ncv_seconds + 0.1


def test_short_images_are_not_asked(fast_probe):
    training = 1e-8 * auto.FIXED_INFERENCE_SAMPLES
    samples = training / (1e-8 * auto.LONGEST_SAMPLE)
    found = too_short(None, 0.9 * samples, 0.0)
    assert found.method == "mc" and not found.first_pass and found.ncv_seconds == training
    assert found.mc_seconds == pytest.approx(0.9 * training)
    assert too_short(None, 1.1 * samples, 0.0) is None
    assert too_short(None, 0.0, 0.9 * samples) is None


# ---- renders ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("cost", [0.0, 1e30])
def test_auto_chooses_by_what_the_network_costs(one_device, scenes, monkeypatch, asked, cost):
    monkeypatch.setattr(auto, "FIXED_INFERENCE_SAMPLES", cost)
    monkeypatch.setattr(auto, "INFERENCE_SAMPLES_A_POINT", 0.0)
    image = render(scenes / "cornell_box.toml", "direct", "auto", device=one_device, **OPTIONS)
    assert image.stats["method"] == image.stats["auto"]["method"] == ("mc" if cost else "ncv")
    assert ("G" in image.layers) == (not cost)
    assert image.stats["auto"]["mc_seconds"] > 0 and image.stats["auto"]["first_pass"]


def test_auto_that_keeps_to_monte_carlo_is_monte_carlo(one_device, scenes, monkeypatch, asked):
    monkeypatch.setattr(auto, "FIXED_INFERENCE_SAMPLES", 1e30)
    kept, plain = (
        render(scenes / "cornell_box.toml", "direct", method, device=one_device, **OPTIONS | {"spp": 96})
        for method in ("auto", "mc")
    )
    assert kept.stats["samples_per_point"] == plain.stats["samples_per_point"]
    # The same samples, in passes of other lengths.
    np.testing.assert_allclose(kept.pixels, plain.pixels, rtol=1e-5, atol=1e-7)


def test_an_image_too_short_to_ask_is_plain_monte_carlo_bit_for_bit(one_device, scenes, tmp_path):
    scene, file = scenes / "cornell_box.toml", tmp_path / "checkpoint.npz"
    short, plain = (
        render(scene, "direct", method, device=one_device, checkpoint=file, **OPTIONS)
        for method in ("auto", "mc")
    )
    assert not short.stats["auto"]["first_pass"]
    assert_same_bits(short, plain)
    render(scene, "direct", "auto", device=one_device, checkpoint=file, stop=lambda: True, **OPTIONS)
    assert_same_bits(render(scene, "direct", "auto", device=one_device, resume=file, **OPTIONS), plain)
