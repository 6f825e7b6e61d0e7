"""Streams of random numbers: no two stages of a render share one, and variances rest on that."""

from __future__ import annotations

import sys
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest

import ncv_cl as ncv
from ncv_cl import render
from ncv_cl.estimation import tuning
from ncv_cl.learning.density import DensityTrainer
from ncv_cl.opencl.program import Kernel
from ncv_cl.points.sampler import HostStream, Stream, host_generator

SIZE = (24, 24)
# Which function, in which module, draws for which purpose; the innermost one counts.
STAGES = {
    ("image_estimate", "warm_up"): "warm-up",
    ("samples", "unshadowed_means"): "unshadowed",
    ("pilot", "draw_pilot"): "pilot",
    ("callable", "centre"): "offset",
    ("learn", "_train"): "training",
    ("learn", "_rounds"): "held out",
    ("direct", "follow"): "direct",
    ("pipeline", "_drawn"): "passes",
}
PURPOSES = {
    "warm-up": {Stream.WARM_UP},
    "unshadowed": {Stream.UNSHADOWED},
    "pilot": {Stream.PILOT},
    "offset": {Stream.OFFSET},
    "training": {Stream.TRAINING},
    "held out": {Stream.HELD_OUT},
    "direct": {Stream.DIRECT, Stream.DIRECT_AGAIN},
}
PASSES = {
    "mc": {Stream.PLAIN, Stream.PLAIN_AGAIN},
    "ncv": {Stream.RESIDUAL, Stream.RESIDUAL_AGAIN},
}


def stage() -> str:
    """What asks for random numbers."""
    frame = sys._getframe(2)
    while frame is not None:
        key = (Path(frame.f_code.co_filename).stem, frame.f_code.co_name)
        if key in STAGES and f"{Path(ncv.__file__).parent}" in frame.f_code.co_filename:
            return STAGES[key]
        frame = frame.f_back
    return "nobody"


@pytest.fixture
def drawn(monkeypatch):
    """What kernels are given: streams by stage, seeds, and how often each sample is drawn."""
    streams, seeds, samples = defaultdict(set), set(), defaultdict(int)
    launch = Kernel.__call__

    def spied(self, work_items, **given):
        if "stream" in given:
            streams[stage()].add(given["stream"])
            seeds.add((given["seed_low"], given["seed_high"]))
        if self.name == "draw_samples":
            first, count = given["first_point"], given["point_count"]
            numbers = range(given["first_sample"], given["first_sample"] + given["sample_count"])
            for point in given["order"].read()[first : first + count].tolist():
                for number in numbers:
                    samples[given["stream"], point, number] += 1
        return launch(self, work_items, **given)

    monkeypatch.setattr(Kernel, "__call__", spied)
    return streams, seeds, samples


@pytest.fixture
def forced(monkeypatch):
    """Method "auto" takes a control variate."""
    for kind in ("", "NOISY_", "LIGHT_"):
        monkeypatch.setattr(tuning, f"{kind}SAMPLES_THAT_PAY", 0)
    monkeypatch.setattr(tuning, "PATHS_THAT_PAY", 0)


@pytest.mark.parametrize("limit", [None, 1e3])
@pytest.mark.parametrize(
    ("integrand", "options"),
    [
        ("direct", {"method": "mc"}),
        ("direct", {"method": "mc", "allocation": "pilot"}),
        ("direct", {"method": "ncv"}),
        ("direct", {"method": "ncv", "density": "subdivision"}),
        ("direct", {"method": "auto"}),
        ("ao", {"method": "auto", "sampler": "independent"}),
        ("ao", {"method": "ncv", "preset": "slides"}),
        ("gi", {"method": "mc"}),
        ("gi", {"method": "auto"}),
    ],
)
def test_no_two_stages_of_a_render_share_a_stream(
    one_device, scenes, drawn, forced, integrand, options, limit
):
    streams, seeds, samples = drawn
    seed = 5 + (7 << 32)
    options = {"spp": 40, "size": SIZE, "seed": seed, "time_limit": limit, **options}
    image = render(scenes / "occluders.toml", integrand, device=one_device, **options)
    chosen = image.stats["method"]
    assert chosen == ("mc" if options["method"] == "mc" else "ncv")
    assert seeds == {(5, 7)}
    assert streams.pop("passes") <= PASSES[chosen]
    for name, found in streams.items():
        assert found <= PURPOSES[name], name
    if options["method"] == "auto":
        assert "training" in streams
    assert ("direct" in streams) == (integrand == "gi")
    # And so no sample counts twice.
    stages = {stream for stream, _, _ in samples}
    assert len(stages) > 1 or options["method"] == "mc"
    assert {key for key, times in samples.items() if times > 1 and key[0] != Stream.WARM_UP} == set()


def test_streams_of_a_callable_are_apart(one_device, drawn):
    streams, _, _ = drawn
    ncv.estimate(lambda u, v, point: u * v, 64, spp=16, device=one_device)
    assert streams.pop("passes") == PASSES["ncv"]
    assert {name: found for name, found in streams.items() if not found <= PURPOSES[name]} == {}
    assert {"offset", "training"} <= set(streams)


def test_streams_of_the_host_are_apart(one_device, scenes, monkeypatch):
    """One stream each for what chooses points, shuffles them and begins networks."""
    users, keys = defaultdict(set), set()
    philox = np.random.Philox

    def spied(key):
        caller = sys._getframe(2).f_code
        users[tuple(key)].add((Path(caller.co_filename).stem, caller.co_name))
        keys.add(tuple(key))
        return philox(key)

    monkeypatch.setattr(np.random, "Philox", spied)
    for options in ({}, {"train_spp": 4}):
        render(
            scenes / "occluders.toml",
            "ao",
            "ncv",
            spp=16,
            size=SIZE,
            seed=9,
            device=one_device,
            **options,
        )
    # Points to train on are chosen in two ways, of which a render takes one.
    assert users.pop((9, HostStream.TRAINING_POINTS)) == {
        ("budget", "plan"),
        ("settings", "training_points"),
    }
    others = {HostStream.TRAINING_POINTS, HostStream.PATCH_RAYS}  # the second is of view factors
    assert {len(found) for found in users.values()} == {1}
    assert len(users) == len(HostStream) - len(others)
    values = {host_generator(0, stream).integers(1 << 62) for stream in HostStream}
    assert len(values) == len(HostStream)
    assert DensityTrainer._start.__code__.co_names.count("host_generator") == 1
