"""What a render does when a stage fails, or is asked to stop."""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
import pytest

from ncv_cl import render
from ncv_cl.presets import PRESETS

OPTIONS = {"spp": 64, "train_spp": 16, "size": (8, 8)}


def test_training_that_diverges_falls_back_to_monte_carlo(one_device, scenes, monkeypatch):
    preset = PRESETS["default"]
    wild = replace(preset, settings=replace(preset.settings, rate=1e30, final_rate=1e30))
    monkeypatch.setitem(PRESETS, "default", wild)
    with pytest.warns(UserWarning, match="diverged"):
        image = render(scenes / "cornell_box.toml", "ao", "ncv", device=one_device, **OPTIONS)
    assert np.isfinite(image.pixels).all() and image.pixels.any()
    assert "G" not in image.layers
    # What was drawn for training still counts.
    stats = image.stats
    assert stats["samples_per_point"] == 64 + 16 + 64 * stats["points_done_twice"] / stats["points"]


def test_a_render_that_is_stopped_keeps_the_passes_done(one_device, scenes, monkeypatch):
    monkeypatch.setattr(sys.modules["ncv_cl.render"], "RESIDUAL_PASS", 32)
    image = render(
        scenes / "cornell_box.toml", "ao", "mc", device=one_device, stop=lambda: True, **OPTIONS
    )
    assert image.stats["samples_per_point_range"] == [32, 64]
    assert np.isfinite(image.pixels).all() and image.pixels.any()


@pytest.mark.parametrize("method", ["mc", "ncv"])
def test_rendering_ends_at_the_error_asked_for(one_device, scenes, monkeypatch, method):
    monkeypatch.setattr(sys.modules["ncv_cl.render"], "RESIDUAL_PASS", 16)
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
        ({"method": "mc", "density": "table"}, "plain Monte Carlo learns no residual"),
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
