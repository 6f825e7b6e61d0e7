"""What a render does when a stage fails, or is asked to stop."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ncv_cl import Image, render
from ncv_cl.integrands import IntegrandError
from ncv_cl.output.report import about_values
from ncv_cl.settings.presets import PRESETS

OPTIONS = {"spp": 64, "size": (8, 8)}


def test_training_that_diverges_falls_back_to_monte_carlo(one_device, scenes, monkeypatch):
    preset = PRESETS["default"]
    wild = replace(preset, schedule=replace(preset.schedule, rate=1e30, final_rate=1e30))
    monkeypatch.setitem(PRESETS, "default", wild)
    with pytest.warns(UserWarning, match="diverged"):
        image = render(
            scenes / "cornell_box.toml", "ao", "ncv", train_spp=16, device=one_device, **OPTIONS
        )
    assert np.isfinite(image.pixels).all() and image.pixels.any()
    assert "G" not in image.layers
    # What was drawn for training still counts.
    stats = image.stats
    assert stats["samples_per_point"] == 64 + 16 + 64 * stats["points_done_twice"] / stats["points"]


def test_a_render_that_is_stopped_keeps_the_passes_done(one_device, scenes, monkeypatch):
    monkeypatch.setattr("ncv_cl.estimation.passes.SAMPLES_A_PASS", 32)
    image = render(
        scenes / "cornell_box.toml", "ao", "mc", device=one_device, stop=lambda: True,
        visibility="points", **OPTIONS,
    )  # fmt: skip
    assert image.stats["samples_per_point_range"] == [32, 64]
    assert np.isfinite(image.pixels).all() and image.pixels.any()


@pytest.mark.parametrize("method", ["mc", "ncv"])
def test_rendering_ends_at_the_error_asked_for(one_device, scenes, monkeypatch, method):
    monkeypatch.setattr("ncv_cl.estimation.passes.SAMPLES_A_PASS", 16)
    options = {**OPTIONS, "spp": 1024, "size": (24, 24)}
    full = render(scenes / "cornell_box.toml", "ao", method, device=one_device, **options)
    target = 16 * float(full.variance.mean())
    image = render(
        scenes / "cornell_box.toml", "ao", method, device=one_device, target_mse=target, **options
    )
    assert image.stats["samples_per_point"] < 0.7 * full.stats["samples_per_point"]
    # The last pass before was above it.
    assert 0.3 * target < image.variance.mean() <= 1.1 * target


def test_rendering_ends_in_time(one_device, scenes):
    options = {**OPTIONS, "spp": 1 << 20, "size": (32, 32)}
    image = render(scenes / "cornell_box.toml", "ao", "mc", device=one_device, time_limit=1.0, **options)
    # All of the samples would take minutes.
    assert 0 < image.stats["samples_per_point"] < 1 << 20


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"method": "mc", "density": "table"}, "trains and uses no network: density"),
        ({"method": "mc", "train_spp": 4}, "trains and uses no network: train_spp"),
        ({"method": "mc", "save_network": "n.npz"}, "no network to save"),
        ({"method": "mc", "allocation": "magnitude"}, "plain Monte Carlo learns no residual"),
        ({"method": "ncv", "allocation": "pilot"}, "'pilot' is for method 'mc'"),
        ({"density": "tree"}, "density must be one of table, subdivision, none"),
        ({"allocation": "all"}, "allocation must be one of"),
        ({"target_mse": 0}, "target_mse must be a positive number"),
        ({"time_limit": -1.0}, "time_limit must be a positive number"),
    ],
)
def test_options_that_do_not_go_together_are_refused(one_device, scenes, options, message):
    with pytest.raises(ValueError, match=message):
        render(scenes / "cornell_box.toml", device=one_device, **options)


@pytest.mark.parametrize("integrand", ["direct", "gi"])
def test_light_beyond_float32_is_refused(one_device, scenes, tmp_path, integrand):
    """Its records would be infinite or NaN, and every sample of it black."""
    text = (scenes / "plane_light.toml").read_text()
    (tmp_path / "hot.toml").write_text(text.replace("radiance = 5", "radiance = 3e38"))
    with pytest.raises(IntegrandError, match="beyond float32"):
        render(tmp_path / "hot.toml", integrand, "mc", spp=1, size=(4, 4), device=one_device)


def test_pixels_that_are_not_finite_are_counted_and_named():
    pixels = np.ones((4, 5, 3))
    pixels[2, 3, 1], pixels[3, 0] = np.nan, np.inf
    image = Image(pixels, np.ones((4, 5, 3)))
    with pytest.warns(UserWarning, match="2 of 20 pixels are not finite, the first in row 2, column 3"):
        about_values(image, np.ones((4, 5, 3)))
    assert image.stats["pixels_not_finite"] == 2
    # There is no error to speak of, and the picture is not lost over it.
    assert image.stats["mse"] is None and image.stats["relmse"] is None


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"size": (8,)}, "size must be a width and a height"),
        ({"size": "8x8"}, "size must be a width and a height"),
        ({"size": (8.5, 8)}, r"size\[0\] must be a whole number"),
        ({"size": (float("nan"), 8)}, r"size\[0\] must be a whole number"),
        ({"spp": "4"}, "spp must be a whole number"),
        ({"spp": float("inf")}, "spp must be a whole number"),
        ({"spp": None}, "spp must be a whole number"),
        ({"spp": True}, "spp must be a whole number"),
        ({"supersample": 2.5}, "supersample must be a whole number"),
        ({"seed": -1}, "seed must be an integer"),
        ({"seed": "1"}, "seed must be an integer"),
        ({"train_spp": "many"}, "train_spp must be a positive number"),
        ({"target_mse": "1"}, "target_mse must be a positive number"),
        ({"time_limit": float("nan")}, "time_limit must be a positive number"),
        ({"reference": np.ones((8, 9, 3))}, "reference must be"),
        ({"reference": np.full((8, 8, 3), np.nan)}, "reference: 192 of 192 values are NaN"),
        ({"reference": np.zeros((8, 8, 3))}, "black"),
        ({"reference": [["a"]]}, "reference must be"),
        ({"integrand": 5}, "integrand must be"),
        ({"method": "mc", "network": "n.npz"}, "uses no network: network"),
    ],
)
def test_bad_arguments_are_refused_before_the_work(one_device, scenes, monkeypatch, options, message):
    monkeypatch.setattr("ncv_cl.rendering.prepare.find_points", lambda *arguments: pytest.fail("worked"))
    with pytest.raises(ValueError, match=message):
        render(scenes / "cornell_box.toml", device=one_device, **{"size": (8, 8), **options})
