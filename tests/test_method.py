"""The rule of method "auto", and that a render does as it says."""

from __future__ import annotations

import time

import pytest
from test_determinism import assert_same_bits

from ncv_cl import render
from ncv_cl.estimation import method

OPTIONS = {"spp": 64, "size": (8, 8)}


@pytest.mark.parametrize("integrand", ["ao", "direct", "gi"])
@pytest.mark.parametrize("enough", [True, False])
def test_auto_is_the_method_that_the_rule_names(one_device, scenes, monkeypatch, integrand, enough):
    monkeypatch.setattr(method, "SAMPLES_THAT_PAY", 0 if enough and integrand != "gi" else 1e30)
    monkeypatch.setattr(method, "NESTED_SAMPLES_THAT_PAY", 0 if enough and integrand == "gi" else 1e30)
    scene = scenes / "cornell_box.toml"
    found = render(scene, integrand, "auto", device=one_device, **OPTIONS)
    named = "ncv" if enough else "mc"
    assert found.stats["method"] == found.stats["auto"]["method"] == named
    assert ("at least" in found.stats["auto"]["reason"]) == enough
    assert_same_bits(found, render(scene, integrand, named, device=one_device, **OPTIONS))


@pytest.mark.parametrize(
    ("integrand", "samples"),
    [("direct", method.SAMPLES_THAT_PAY), ("gi", method.NESTED_SAMPLES_THAT_PAY)],
)
def test_the_rule_counts_samples_of_lit_points(one_device, scenes, integrand, samples):
    options = {"size": (8, 8), "device": one_device, "stop": lambda: True}
    few = render(scenes / "cornell_box.toml", integrand, "mc", spp=2, **options)
    spp = int(samples / few.stats["points"])
    for less, expected in ((0.99, "mc"), (1.01, "ncv")):
        image = render(scenes / "cornell_box.toml", integrand, "auto", spp=int(spp * less), **options)
        assert image.stats["auto"]["method"] == expected


@pytest.mark.parametrize("integrand", ["direct", "gi"])
def test_no_clock_and_no_cache_has_a_say(one_device, scenes, monkeypatch, tmp_path, integrand):
    """A clock that runs a thousand times as fast, and no cache of ours, leave the bits as they are."""
    options = {
        "size": (16, 12),
        "spp": 1 << 16 if integrand == "direct" else 1 << 13,
        "device": one_device,
    }
    monkeypatch.setattr(method, "SAMPLES_THAT_PAY", 1e6)
    monkeypatch.setattr(method, "NESTED_SAMPLES_THAT_PAY", 1e6)
    first = render(scenes / "cornell_box.toml", integrand, **options)
    real = time.perf_counter
    monkeypatch.setattr(time, "perf_counter", lambda: 1000.0 * real())
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert_same_bits(first, render(scenes / "cornell_box.toml", integrand, **options))
    assert first.stats["method"] == "ncv" and not (tmp_path / "ncv_cl").exists()
