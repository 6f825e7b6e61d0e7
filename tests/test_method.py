"""The rule of method "auto", and that a render does as it says."""

from __future__ import annotations

import math
import time
from types import SimpleNamespace

import pytest
from test_determinism import assert_same_bits

from ncv_cl import render
from ncv_cl.estimation import tuning
from ncv_cl.estimation.method import choose_method, kind_of
from ncv_cl.integrands import INTEGRANDS
from ncv_cl.settings.options import Sampling
from ncv_cl.settings.settings import Settings

KINDS = {
    ("ao", "sobol"): "SAMPLES_THAT_PAY",
    ("direct", "sobol"): "LIGHT_SAMPLES_THAT_PAY",
    ("gi", "sobol"): "NOISY_SAMPLES_THAT_PAY",
    ("ao", "independent"): "NOISY_SAMPLES_THAT_PAY",
    ("direct", "independent"): "NOISY_SAMPLES_THAT_PAY",
    ("gi", "independent"): "NOISY_SAMPLES_THAT_PAY",
}
OPTIONS = {"spp": 64, "size": (8, 8)}


def choose(integrand, sampler, spp, points):
    settings = Settings(
        INTEGRANDS[integrand](), "auto", spp, (8, 8), 0, sampling=Sampling(sampler=sampler)
    )
    return choose_method(SimpleNamespace(points=SimpleNamespace(active=points)), settings)


@pytest.mark.parametrize(("integrand", "sampler"), list(KINDS))
@pytest.mark.parametrize("enough", [True, False])
def test_auto_is_the_method_that_the_rule_names(
    one_device, scenes, monkeypatch, integrand, sampler, enough
):
    own = KINDS[integrand, sampler]
    for name in set(KINDS.values()):
        # The others' numbers say the opposite.
        monkeypatch.setattr(tuning, name, 0 if (name == own) == enough else 1e30)
    scene, options = scenes / "cornell_box.toml", {**OPTIONS, "sampler": sampler, "device": one_device}
    found = render(scene, integrand, "auto", **options)
    named = "ncv" if enough else "mc"
    assert found.stats["method"] == found.stats["auto"]["method"] == named
    assert ("at least" in found.stats["auto"]["reason"]) == enough
    assert_same_bits(found, render(scene, integrand, named, **options))


@pytest.mark.parametrize(("integrand", "sampler"), list(KINDS))
def test_the_rule_counts_samples_of_lit_points(integrand, sampler):
    assert kind_of(INTEGRANDS[integrand](), sampler) == KINDS[integrand, sampler]
    enough = getattr(tuning, KINDS[integrand, sampler])
    if enough == math.inf:
        assert choose(integrand, sampler, 1 << 20, 1 << 20)[0] == "mc"
        return
    spp = 64
    points = int(enough) // spp
    assert choose(integrand, sampler, spp, points)[0] == "ncv"
    assert choose(integrand, sampler, spp, points - 1)[0] == "mc"
    assert choose(integrand, sampler, points, spp)[0] == "ncv"


def test_dark_points_and_the_background_do_not_count(one_device, scenes, monkeypatch):
    options = {"size": (8, 8), "spp": 16, "device": one_device}
    scene = scenes / "cornell_box.toml"
    points = render(scene, "direct", "mc", **options).stats["points"]
    assert 0 < points < 64
    for enough, expected in ((16 * points, "ncv"), (16 * points + 1, "mc")):
        monkeypatch.setattr(tuning, "LIGHT_SAMPLES_THAT_PAY", enough)
        assert render(scene, "direct", "auto", **options).stats["auto"]["method"] == expected


@pytest.mark.parametrize("integrand", ["ao", "gi"])
def test_no_clock_and_no_cache_has_a_say(one_device, scenes, monkeypatch, tmp_path, integrand):
    """A clock that runs a thousand times as fast, and no cache of ours, leave the bits as they are."""
    options = {"size": (16, 12), "spp": 1 << 13, "device": one_device}
    monkeypatch.setattr(tuning, KINDS[integrand, "sobol"], 1e6)
    first = render(scenes / "cornell_box.toml", integrand, **options)
    real = time.perf_counter
    monkeypatch.setattr(time, "perf_counter", lambda: 1000.0 * real())
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert_same_bits(first, render(scenes / "cornell_box.toml", integrand, **options))
    assert first.stats["method"] == "ncv" and not (tmp_path / "ncv_cl").exists()
