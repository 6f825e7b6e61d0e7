"""Checkpoints: gone on from to the same bits, refused where another render is asked for."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fitting import fitting
from test_determinism import assert_same_bits

import ncv_cl
from ncv_cl import render
from ncv_cl.output import report
from ncv_cl.output.checkpoint import Checkpoint, CheckpointError

OPTIONS = {"spp": 96, "size": (12, 10), "seed": 3}
CASES = [
    {"method": "mc"},
    {"method": "mc", "sampler": "independent"},
    {"method": "mc", "allocation": "pilot"},
    {"method": "ncv"},
    {"method": "ncv", "density": "subdivision"},
    {"method": "ncv", "preset": "slides"},
    {"method": "auto"},
]


@pytest.fixture(autouse=True)
def short_passes(monkeypatch):
    monkeypatch.setattr("ncv_cl.estimation.passes.SAMPLES_A_PASS", 16)


def picture(scenes, device, **options):
    trained = {} if "network" in options else {"train_spp": 4}
    chosen = fitting(**{"method": "ncv", **trained, **OPTIONS, **options})
    return render(scenes / "cornell_box.toml", "direct", device=device, **chosen)


@pytest.mark.parametrize("case", CASES, ids=lambda case: "-".join(case.values()))
@pytest.mark.parametrize("passes", [1, 3])
def test_going_on_gives_the_bits_of_an_uninterrupted_render(one_device, scenes, tmp_path, case, passes):
    whole = picture(scenes, one_device, **case)
    file = tmp_path / "checkpoint.npz"
    asked = []

    def stop():
        asked.append(1)
        return len(asked) >= passes + ("ncv" in case.values())

    part = picture(scenes, one_device, **case, checkpoint=file, stop=stop)
    assert part.stats["samples_per_point"] < whole.stats["samples_per_point"]
    again = picture(scenes, one_device, **case, resume=file)
    assert_same_bits(whole, again)
    assert again.stats["samples_per_point"] == whole.stats["samples_per_point"]


@pytest.mark.parametrize(
    "case",
    [
        {"method": "mc"},
        {"method": "mc", "sampler": "independent"},
        {"method": "ncv", "train_spp": 4},
        {"method": "ncv", "train_spp": 4, "allocation": "relative"},
        {"method": "ncv", "train_spp": 4, "split_direct": "off"},
    ],
    ids=lambda case: "-".join(map(str, case.values())),
)
@pytest.mark.parametrize("passes", [1, 3])
def test_direct_light_apart_goes_on_with_the_rest(
    one_device, scenes, tmp_path, monkeypatch, case, passes
):
    # So that direct light is also given more where the errors say so.
    monkeypatch.setattr("ncv_cl.estimation.tuning.DIRECT_SAMPLES", 2.0)
    monkeypatch.setattr("ncv_cl.estimation.tuning.DIRECT_ERROR", 1e-4)
    common = {"integrand": "gi", "device": one_device, **OPTIONS, **case}
    whole = render(scenes / "cornell_box.toml", **common)
    file, asked = tmp_path / "checkpoint.npz", []

    def stop():
        asked.append(1)
        return len(asked) >= passes + ("ncv" in case.values())

    part = render(scenes / "cornell_box.toml", **common, checkpoint=file, stop=stop)
    assert part.stats["ended_by"] == "request"
    again = render(scenes / "cornell_box.toml", **common, resume=file)
    assert_same_bits(whole, again)
    if "split_direct" not in case:
        drawn = [image.stats["direct"]["samples_per_point"] for image in (part, again, whole)]
        # The error of direct light may be small enough after three passes.
        assert drawn[0] <= drawn[1] == drawn[2] and (passes > 1 or drawn[0] < drawn[1])
        found = Checkpoint.load(file)
        arrays = dict(np.load(file))
        arrays["direct_state0"] = arrays["direct_state0"][:, 1:]
        arrays["direct_samples0"] = arrays["direct_samples0"][1:]
        np.savez(file, **arrays)
        assert (found.counts is not None) == ("relative" in case.values())
        with pytest.raises(ValueError, match="tampered"):
            render(scenes / "cornell_box.toml", **common, resume=file)


@pytest.mark.parametrize(
    ("options", "difference"),
    [
        ({"seed": 4}, "seed is 4, was 3"),
        ({"spp": 128}, "spp is 128, was 96"),
        ({"size": (12, 11)}, "size"),
        ({"sampler": "independent"}, "sampler"),
        ({"method": "ncv"}, "method is 'ncv', was 'mc'"),
    ],
)
def test_another_render_is_refused_and_the_difference_named(
    one_device, scenes, tmp_path, options, difference
):
    file = tmp_path / "checkpoint.npz"
    picture(scenes, one_device, method="mc", checkpoint=file)
    with pytest.raises(CheckpointError, match=difference):
        picture(scenes, one_device, **{"method": "mc", **options}, resume=file)


def test_another_scene_is_refused(one_device, scenes, tmp_path):
    file = tmp_path / "checkpoint.npz"
    picture(scenes, one_device, method="mc", checkpoint=file)
    with pytest.raises(CheckpointError, match="scene"):
        render(scenes / "occluders.toml", method="mc", device=one_device, resume=file, **OPTIONS)


def test_other_kernels_and_other_shapes_of_kernels_are_refused(
    one_device, scenes, tmp_path, monkeypatch
):
    file = tmp_path / "checkpoint.npz"
    picture(scenes, one_device, method="mc", checkpoint=file)
    for name, value in {
        "vector_width": one_device.vector_width // 2 or 2,
        "lanes": 4,
        "use_fma": not one_device.use_fma,
    }.items():
        with pytest.raises(CheckpointError, match="fma" if name == "use_fma" else "device"):
            picture(scenes, replace(one_device, **{name: value}), method="mc", resume=file)
    monkeypatch.setattr("ncv_cl.output.report.kernel_digest", lambda: "another")
    with pytest.raises(CheckpointError, match="kernels is 'another'"):
        picture(scenes, one_device, method="mc", resume=file)


def test_the_hash_of_the_kernels_is_of_their_text(tmp_path, monkeypatch):
    digest = report.kernel_digest.__wrapped__
    monkeypatch.setattr(report, "kernel_folder", lambda: tmp_path)
    (tmp_path / "a.cl").write_text("kernel void a() {}")
    first = digest()
    (tmp_path / "a.cl").write_text("kernel void b() {}")
    assert digest() != first
    (tmp_path / "a.cl").rename(tmp_path / "b.cl")
    assert len({first, digest(), report.kernel_digest()}) == 3


def test_another_given_network_is_refused(one_device, scenes, tmp_path):
    """A checkpoint goes on with its own network, so the one named must be that."""
    for number in (1, 2):
        picture(scenes, one_device, method="ncv", seed=number, save_network=tmp_path / f"{number}.npz")
    file = tmp_path / "checkpoint.npz"
    options = {"method": "ncv", "network": tmp_path / "1.npz"}
    whole = picture(scenes, one_device, **options)
    picture(scenes, one_device, **options, checkpoint=file, stop=lambda: True)
    assert_same_bits(picture(scenes, one_device, **options, resume=file), whole)
    with pytest.raises(CheckpointError, match="network is"):
        picture(scenes, one_device, method="ncv", network=tmp_path / "2.npz", resume=file)


@pytest.mark.parametrize("case", [{"method": "mc"}, {"method": "ncv"}])
def test_a_render_that_ran_out_of_time_goes_on_without_a_limit(one_device, scenes, tmp_path, case):
    """Short passes first, then long ones: the same samples, added up in other parts."""
    file = tmp_path / "checkpoint.npz"
    part = picture(
        scenes, one_device, **case, time_limit=1e4, checkpoint=file, stop=lambda: file.exists()
    )
    assert part.stats["ended_by"] == "request"
    again = picture(scenes, one_device, **case, resume=file)
    whole = picture(scenes, one_device, **case)
    assert again.stats["samples_per_point"] == whole.stats["samples_per_point"]
    np.testing.assert_allclose(again.pixels, whole.pixels, rtol=2e-5, atol=1e-6)


@pytest.mark.parametrize("content", [b"", b"nonsense", b"PK\x03\x04"])
def test_broken_files_are_refused(tmp_path, content):
    file = tmp_path / "checkpoint.npz"
    file.write_bytes(content)
    with pytest.raises(CheckpointError, match="not a checkpoint"):
        Checkpoint.load(file)


def test_a_file_that_cannot_be_written_leaves_the_old_one(one_device, scenes, tmp_path, monkeypatch):
    file = tmp_path / "checkpoint.npz"
    picture(scenes, one_device, method="mc", checkpoint=file)
    before = file.read_bytes()

    def fail(*arguments):
        raise OSError("disk full")

    monkeypatch.setattr(os, "replace", fail)
    with pytest.warns(UserWarning, match="checkpoint.npz is not written: .*disk full") as warned:
        image = picture(scenes, one_device, method="mc", checkpoint=file)
    # The picture is there all the same, after one warning for all passes, and says what is not.
    assert image.pixels.any() and image.stats["samples_per_point_range"][0] == 96 and len(warned) == 1
    assert "disk full" in image.stats["not_written"][str(file)]
    assert file.read_bytes() == before and list(tmp_path.iterdir()) == [file]


@pytest.mark.slow
def test_a_killed_process_loses_at_most_one_pass(one_device, scenes, tmp_path):
    file = tmp_path / "checkpoint.npz"
    options = [
        "--method",
        "mc",
        "--size",
        "48x48",
        "--spp",
        "1000000",
        "--device",
        str(one_device.index),
    ]
    command = [sys.executable, "-m", "ncv_cl.cli", "render", scenes / "cornell_box.toml", *options]
    environment = {**os.environ, "PYTHONPATH": str(Path(ncv_cl.__file__).parent.parent)}
    for _ in range(2):
        process = subprocess.Popen(
            [*command, "-o", tmp_path / "a.exr", "--checkpoint", file], env=environment
        )
        deadline = time.monotonic() + 120
        written = None
        # Killed at no particular moment, some passes after the first file.
        while time.monotonic() < deadline and (written is None or time.monotonic() < written + 0.7):
            if written is None and file.exists():
                written = time.monotonic()
            time.sleep(0.01)
        process.send_signal(signal.SIGKILL)
        process.wait()
        found = Checkpoint.load(file)
        assert found.image.passes > 0
        # What there is are whole passes of all points.
        samples = found.image.states[0][1]
        assert (samples == samples[0]).all() and samples[0] > 0
        assert np.isfinite(found.image.states[0][0]).all()
