"""The rule of method "auto", and that a render does as it says."""

from __future__ import annotations

import math
import time
from types import SimpleNamespace

import pytest
from test_determinism import assert_same_bits

from ncv_cl import load_scene, render
from ncv_cl.estimation import tuning
from ncv_cl.estimation.method import choose_method, kind_of, noise_that_stays
from ncv_cl.integrands import INTEGRANDS
from ncv_cl.points.points import find_points
from ncv_cl.points.trace import Tracer
from ncv_cl.settings.options import Sampling
from ncv_cl.settings.settings import Settings

# By integrand, sampler and visibility.
KINDS = {
    ("ao", "sobol", "points"): "SAMPLES_THAT_PAY",
    ("ao", "sobol", "lines"): "SLICES_THAT_PAY",
    ("direct", "sobol", "auto"): "LIGHT_SAMPLES_THAT_PAY",
    ("gi", "sobol", "auto"): "QUICK_PATHS_THAT_PAY",
    ("gi", "sobol", "embree"): "PATHS_THAT_PAY",
    ("ao", "independent", "points"): "NOISY_SAMPLES_THAT_PAY",
    ("ao", "independent", "lines"): "NOISY_SAMPLES_THAT_PAY",
    ("direct", "independent", "auto"): "NOISY_SAMPLES_THAT_PAY",
    ("gi", "independent", "auto"): "QUICK_PATHS_THAT_PAY",
}
OPTIONS = {"spp": 64, "size": (8, 8)}


def is_sliced(integrand, visibility):
    return integrand == "ao" and visibility == "lines"


def is_by_kernels(integrand, visibility):
    """In the Cornell box, which is of few triangles."""
    return integrand == "gi" and visibility == "auto"


def choose(integrand, sampler, visibility, spp, points):
    settings = Settings(
        INTEGRANDS[integrand](), "auto", spp, (8, 8), 0, sampling=Sampling(sampler=sampler)
    )
    sliced = is_sliced(integrand, visibility)
    source = SimpleNamespace(by_kernels=is_by_kernels(integrand, visibility))
    problem = SimpleNamespace(
        points=SimpleNamespace(active=points), sliced=sliced, source=source, no_network=None
    )
    return choose_method(problem, settings)


@pytest.mark.parametrize(("integrand", "sampler", "visibility"), list(KINDS))
@pytest.mark.parametrize("enough", [True, False])
def test_auto_is_the_method_that_the_rule_names(
    one_device, scenes, monkeypatch, integrand, sampler, visibility, enough
):
    own = KINDS[integrand, sampler, visibility]
    for name in set(KINDS.values()):
        # The others' numbers say the opposite, but those of the image for samples a point.
        alike = name == own or (own.startswith("QUICK") and name.startswith("NOISY"))
        monkeypatch.setattr(tuning, name, 0 if alike == enough else 1e30)
    scene = scenes / "cornell_box.toml"
    options = {**OPTIONS, "sampler": sampler, "visibility": visibility, "device": one_device}
    found = render(scene, integrand, "auto", **options)
    named = "ncv" if enough else "mc"
    assert found.stats["method"] == found.stats["auto"]["method"] == named
    assert ("at least" in found.stats["auto"]["reason"]) == enough
    assert_same_bits(found, render(scene, integrand, named, **options))


@pytest.mark.parametrize(("integrand", "sampler", "visibility"), list(KINDS))
def test_the_rule_counts_samples_of_lit_points(integrand, sampler, visibility):
    kind = KINDS[integrand, sampler, visibility]
    how = is_sliced(integrand, visibility), is_by_kernels(integrand, visibility)
    assert kind_of(INTEGRANDS[integrand](), sampler, *how) == kind
    enough = getattr(tuning, kind)
    if enough == math.inf:
        assert choose(integrand, sampler, visibility, 1 << 20, 1 << 20)[0] == "mc"
        return
    spp = 64
    if kind == "QUICK_PATHS_THAT_PAY":
        spp, few = int(enough), int(enough) - 1
        enough = tuning.NOISY_SAMPLES_THAT_PAY
        assert choose(integrand, sampler, visibility, few, int(enough))[0] == "mc"
    points = int(enough) // spp
    assert choose(integrand, sampler, visibility, spp, points)[0] == "ncv"
    assert choose(integrand, sampler, visibility, spp, points - 1)[0] == "mc"
    assert choose(integrand, sampler, visibility, points, spp)[0] == "ncv"


# Words of the reason, and the number that would allow a network.
NOISY_SCENES = {
    "glass": ("glass", None),
    "sky_room": ("outside", None),
    "lit_mesh": ("lights", "LIGHTS_OF_A_NETWORK"),
    "veach_plates": ("lobes", "LOBES_OF_A_NETWORK"),
}


@pytest.mark.parametrize("scene", [*NOISY_SCENES, "interior"])
def test_paths_that_keep_their_noise_get_no_network(one_device, scenes, monkeypatch, scene):
    """However many there are."""
    for name in ("PATHS_THAT_PAY", "QUICK_PATHS_THAT_PAY", "NOISY_SAMPLES_THAT_PAY"):
        monkeypatch.setattr(tuning, name, 0)
    options = {"size": (8, 8), "spp": 4, "device": one_device}
    found = render(scenes / f"{scene}.toml", "gi", **options)
    if scene == "interior":
        assert found.stats["auto"]["method"] == "ncv"
        return
    word, number = NOISY_SCENES[scene]
    assert found.stats["auto"]["method"] == "mc" and word in found.stats["auto"]["reason"]
    assert_same_bits(found, render(scenes / f"{scene}.toml", "gi", "mc", **options))
    if number is not None:
        monkeypatch.setattr(tuning, number, 1e3)
        assert render(scenes / f"{scene}.toml", "gi", **options).stats["auto"]["method"] == "ncv"


@pytest.mark.parametrize("allocation", ["relative", "magnitude"])
def test_paths_are_shared_rather_than_allocated(one_device, scenes, monkeypatch, allocation):
    monkeypatch.setattr(tuning, "PATHS_THAT_PAY", 0)
    options = {"size": (8, 8), "spp": 4, "device": one_device}
    scene = scenes / "interior.toml"
    found = render(scene, "gi", allocation=allocation, **options)
    assert found.stats["method"] == "mc" and allocation in found.stats["auto"]["reason"]
    assert_same_bits(found, render(scene, "gi", "mc", **options))
    # Of one part, none are shared.
    one = render(scene, "gi", allocation=allocation, split_direct="off", **options)
    assert one.stats["method"] == "ncv"


def test_what_no_paths_lead_through_says_nothing_of_networks(one_device, scenes):
    """Glass and skies count for paths alone; a network that is wanted is trained nonetheless."""
    scene = load_scene(scenes / "sky_room.toml")
    points = find_points(one_device, scene, Tracer(scene), 8, 8)
    assert noise_that_stays(scene, INTEGRANDS["gi"](), points) is not None
    assert noise_that_stays(scene, INTEGRANDS["direct"](), points) is None
    options = {"size": (8, 8), "spp": 4, "device": one_device}
    assert render(scene, "gi", "ncv", **options).stats["method"] == "ncv"


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
    for kind in set(KINDS.values()):
        monkeypatch.setattr(tuning, kind, 1e3 if kind.startswith("QUICK") else 1e5)
    first = render(scenes / "cornell_box.toml", integrand, **options)
    real = time.perf_counter
    monkeypatch.setattr(time, "perf_counter", lambda: 1000.0 * real())
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert_same_bits(first, render(scenes / "cornell_box.toml", integrand, **options))
    assert first.stats["method"] == "ncv" and not (tmp_path / "ncv_cl").exists()
