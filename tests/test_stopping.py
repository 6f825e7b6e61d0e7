"""When rendering ends: an error that is believed too early, and time limits of every method."""

from __future__ import annotations

import math
import sys
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from ncv_cl import load_scene, render
from ncv_cl.estimation.passes import short_pass_edges
from ncv_cl.estimation.stopping import FEWEST_ON_A_LIGHT, ErrorTarget, Stopping
from ncv_cl.host.clock import Clock, OutOfTime, Run
from ncv_cl.integrands.lights import narrowest_strip

# A floor under a weak light; a strong one shines on the floor's other side, seen by none of its points.
TWO_LIGHTS = """
[camera]
position = [0, 5, 0.0001]
target = [0, 0, 0]
up = [0, 0, -1]
vertical_fov = 30
[materials.floor]
albedo = 0.5
[[boxes]]
min = [-5, -0.2, -5]
max = [5, 0, 5]
material = "floor"
[[boxes]]
center = [0.2, 1, 0]
size = [0.4, 0.4, 0.4]
material = "floor"
[[lights]]
corner = [-1, 6, -1]
edge1 = [2, 0, 0]
edge2 = [0, 0, 2]
radiance = 10
[[lights]]
corner = [-9, -6, -9]
edge1 = [0, 0, 18]
edge2 = [18, 0, 0]
radiance = 12345
two_sided = true
"""


@pytest.fixture
def two_lights(tmp_path):
    path = tmp_path / "two_lights.toml"
    path.write_text(TWO_LIGHTS)
    return load_scene(path)


def image_estimate(samples, error, something=True):
    """What an `ErrorTarget` asks of an image_estimate."""
    return SimpleNamespace(samples=samples, image_error=lambda: error, finds_something=lambda: something)


def test_an_error_is_believed_when_every_light_was_sampled(two_lights):
    strip = narrowest_strip(two_lights)
    assert 0 < strip < 0.5 and narrowest_strip(replace(two_lights, lights=())) == 1
    for uniform_share in (1.0, 0.1):
        target = ErrorTarget(1e-3, strip, uniform_share)
        fewest = FEWEST_ON_A_LIGHT / strip / uniform_share
        assert not target.reached(image_estimate(0.99 * fewest, 1e-9))
        assert target.reached(image_estimate(1.01 * fewest, 1e-9))
        assert not target.reached(image_estimate(1.01 * fewest, 2e-3))


def test_an_error_that_is_not_known_or_of_nothing_is_not_believed():
    target = ErrorTarget(1e-3, 1.0, 1.0)
    assert not target.reached(image_estimate(1e9, math.nan))
    assert not target.reached(image_estimate(1e9, 0.0, something=False))
    assert target.reached(image_estimate(1e9, 0.0, something=True))
    assert not ErrorTarget(None, 1.0, 1.0).reached(image_estimate(1e9, 1e-9))


def test_a_target_is_of_the_sum_and_direct_light_must_be_believed_too():
    target = ErrorTarget(1e-3, 0.5, 0.1)
    fewest = FEWEST_ON_A_LIGHT / 0.5
    rest = image_estimate(1e9, 6e-4)
    assert target.reached(rest, image_estimate(1.01 * fewest, 3e-4))
    assert not target.reached(rest, image_estimate(1.01 * fewest, 5e-4))
    assert not target.reached(rest, image_estimate(0.99 * fewest, 3e-4))
    assert not target.reached(rest, image_estimate(1e9, math.nan))


@pytest.mark.parametrize("method", ["mc", "ncv"])
def test_a_target_of_global_illumination_is_met(one_device, scenes, method):
    options = {"device": one_device, "size": (32, 32)}
    image = render(
        scenes / "cornell_box.toml", "gi", method, spp=4096, target_mse=2e-5, seed=3, **options
    )
    truth = render(scenes / "cornell_box.toml", "gi", "mc", spp=2048, split_direct="off", **options)
    assert image.stats["ended_by"] == "target_mse" and image.stats["estimated_mse"] <= 2e-5
    assert np.mean((image.pixels.astype(float) - truth.pixels) ** 2) < 4e-5


@pytest.mark.parametrize("method", ["mc", "ncv", "auto"])
@pytest.mark.filterwarnings("ignore:training diverged")
def test_a_target_is_not_met_before_the_weak_light_is_seen(one_device, two_lights, method):
    """The strong light's power is 1e5 times the other's: a strip by power is hardly ever sampled."""
    options = {"device": one_device, "size": (16, 16), "spp": 4096}
    training = {} if method == "mc" else {"train_spp": 16}
    alone = replace(two_lights, lights=two_lights.lights[:1])
    truth = render(alone, "direct", "mc", **{**options, "seed": 9})
    for seed in range(3):
        more = {"target_mse": 1e-4, "seed": seed, **training}
        image = render(two_lights, "direct", method, **options, **more)
        error = float(((image.pixels.astype(float) - truth.pixels) ** 2).mean())
        assert image.stats["ended_by"] == "samples" or error < 4e-4


def test_a_target_is_met_where_all_light_is_seen(one_device, scenes):
    options = {"device": one_device, "size": (48, 48), "spp": 4096}
    image = render(scenes / "occluders.toml", "direct", "mc", target_mse=1e-4, **options)
    assert image.stats["ended_by"] == "target_mse" and image.stats["samples_per_point"] < 1024
    assert image.stats["estimated_mse"] <= 1e-4


def test_points_with_few_samples_do_not_hide_the_error(one_device, scenes):
    """Where points are given four of many samples, their variance is known after the first pass."""
    options = {"device": one_device, "size": (24, 24), "spp": 1 << 16, "train_spp": 16}
    image = render(scenes / "cornell_box.toml", "direct", "ncv", target_mse=1e-4, **options)
    assert image.stats["ended_by"] == "target_mse" and image.stats["samples_per_point"] < 1 << 12
    assert np.isfinite(image.variance).all()


# ---- time ------------------------------------------------------------------------------------------


def test_a_clock_counts_down_to_parts_of_its_limit(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])
    clock = Clock(10.0, 100.0)
    assert clock.left() == 10 and clock.left(0.5) == 5 and not clock.over(0.5)
    clock.check()
    now[0] = 106.0
    assert clock.over(0.5) and not clock.over()
    with pytest.raises(OutOfTime):
        clock.check(0.5)
    assert Clock().left() == math.inf and not Clock().over()


def test_a_pass_that_would_outlast_the_limit_is_not_begun(monkeypatch):
    now = [0.0]
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])
    lengths = [1, 1, 4, 4]
    passes = SimpleNamespace(number=4, length=lambda number: lengths[number])
    target = SimpleNamespace(reached=lambda found, direct: False)
    under_way = SimpleNamespace(passes=passes)
    stopping = Stopping(under_way, target, Run(clock=Clock(5.5, 0.0)))
    now[0] = 1.0
    assert not stopping.enough(1)
    # The next one is four times as long: it would end at 6.
    now[0] = 2.0
    assert stopping.enough(2) and stopping.ended_by == "time_limit"


@pytest.mark.parametrize(("samples", "shortest"), [(1, 1), (1000, 1), (1000, 50), (10**9, 3), (64, 999)])
def test_short_passes_grow_slowly_and_cover_all_samples(samples, shortest):
    edges = short_pass_edges(samples, 128, shortest)
    lengths = np.diff(edges)
    assert edges[0] == 0 and edges[-1] == samples and (lengths > 0).all()
    assert lengths[0] <= shortest and lengths.max() <= 128
    assert (lengths <= np.maximum(shortest, edges[:-1] // 16 + 1)).all()


WAYS = [
    ("direct", {"method": "mc"}),
    ("direct", {"method": "mc", "allocation": "pilot"}),
    ("direct", {"method": "ncv"}),
    ("direct", {"method": "ncv", "density": "subdivision"}),
    ("ao", {"method": "ncv", "preset": "slides"}),
    ("ao", {"method": "auto"}),
    ("gi", {"method": "mc"}),
    ("gi", {"method": "ncv"}),
    ("gi", {"method": "auto"}),
    ("gi", {"method": "ncv", "split_direct": "off"}),
]


@pytest.mark.parametrize("limit", [0.05, 2.0])
@pytest.mark.parametrize(
    ("integrand", "options"),
    WAYS,
    ids=lambda way: "-".join(way.values()) if isinstance(way, dict) else way,
)
@pytest.mark.filterwarnings("ignore:the time limit left none")
def test_every_method_ends_in_time(one_device, scenes, integrand, options, limit):
    # The interior is closed: no point sees the sky.
    scene = scenes / ("occluders.toml" if integrand == "ao" else "interior.toml")

    def picture(**more):
        return render(scene, integrand, device=one_device, size=(64, 64), **options, **more)

    # No limit interrupts the compilation of kernels.
    picture(spp=64)
    picture(spp=64, time_limit=5.0)
    began = time.perf_counter()
    image = picture(spp=10**9, time_limit=limit)
    seconds = time.perf_counter() - began
    # Generous: other work may share the machine. What is drawn without a limit would take hours.
    assert seconds < 2 * limit + 3
    assert image.stats["ended_by"] == "time_limit" and image.stats["samples_per_point"] >= 1
    assert np.isfinite(image.pixels).all() and image.pixels.any()


class Countdown(Clock):
    """Time is up when it has been asked so often."""

    times = 0

    def over(self, share=1.0):
        Countdown.times -= 1
        return Countdown.times < 0

    def check(self, share=1.0):
        if self.over(share):
            raise OutOfTime


@pytest.mark.filterwarnings("ignore:the time limit left none")
@pytest.mark.parametrize("method", ["ncv", "auto"])
def test_training_is_given_up_wherever_it_is(one_device, scenes, method, monkeypatch):
    """Its samples still count, once each."""
    monkeypatch.setattr("ncv_cl.estimation.tuning.SAMPLES_THAT_PAY", 0)
    monkeypatch.setattr(sys.modules["ncv_cl.rendering.render"], "Clock", Countdown)
    options = {"spp": 32, "size": (24, 24), "time_limit": 1e6, "device": one_device}
    truth = render(scenes / "occluders.toml", "ao", "mc", **{**options, "time_limit": None, "spp": 512})
    methods = []
    for times in range(12):
        Countdown.times = times
        image = render(scenes / "occluders.toml", "ao", method, **options)
        methods.append(image.stats["method"])
        errors = (image.pixels.astype(float) - truth.pixels) ** 2
        assert errors.mean() < 0.05
    # Given up at first, then all of it done.
    assert methods[0] == "mc" and methods[-1] == "ncv" and methods == sorted(methods)
