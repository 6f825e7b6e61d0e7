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
