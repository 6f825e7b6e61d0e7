"""Signals that ask a render to end: the picture so far is written, and nothing is cut off."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pyopencl as cl
import pytest
from processes import PATIENCE, environment

from ncv_cl.opencl import program
from ncv_cl.output.image import Image


def begin_long_render(scenes, device, folder: Path, *wrapper: str) -> subprocess.Popen:
    """A render of hours, once it draws samples."""
    scene, checkpoint = scenes / "cornell_box.toml", folder / "checkpoint.npz"
    process = subprocess.Popen(
        [
            *wrapper, sys.executable, "-m", "ncv_cl.cli", "render", str(scene),
            "-o", str(folder / "a.exr"), "--json", str(folder / "a.json"), "--method", "mc",
            "--checkpoint", str(checkpoint), "--size", "64x64", "--spp", str(1 << 24),
            "--device", str(device.index),
        ],
        env=environment(), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    until = time.monotonic() + PATIENCE
    while not checkpoint.exists() and process.poll() is None and time.monotonic() < until:
        time.sleep(0.05)
    return process


def assert_stopped_early(process: subprocess.Popen, folder: Path) -> None:
    out, err = process.communicate(timeout=PATIENCE)
    assert process.returncode == 0 and "stopped early" in out, err
    samples = json.loads((folder / "a.json").read_text())["samples_per_point"]
    image = Image.read(folder / "a.exr")
    assert 0 < samples < 1 << 24 and image.metadata["spp"] == samples
    assert np.isfinite(image.pixels).all() and image.pixels.any() and image.variance.any()


ASKING = [name for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]


@pytest.mark.skipif(os.name != "posix", reason="sends signals")
@pytest.mark.parametrize("name", ASKING)
def test_a_signal_leaves_the_image_of_the_passes_done(scenes, one_device, tmp_path, name):
    with begin_long_render(scenes, one_device, tmp_path) as process:
        process.send_signal(getattr(signal, name))
        assert_stopped_early(process, tmp_path)


@pytest.mark.skipif(shutil.which("nohup") is None, reason="needs nohup")
def test_a_signal_that_is_to_be_ignored_stays_ignored(scenes, one_device, tmp_path):
    with begin_long_render(scenes, one_device, tmp_path, "nohup") as process:
        process.send_signal(signal.SIGHUP)
        time.sleep(1.0)
        assert process.poll() is None and not (tmp_path / "a.exr").exists()
        process.send_signal(signal.SIGTERM)
        assert_stopped_early(process, tmp_path)


def test_a_compilation_that_a_signal_broke_off_is_done_again(one_device, monkeypatch):
    # LLVM deletes its temporary files when a signal comes, and then does not find them.
    real, builds = cl.Program.build, []

    def build(program, *arguments, **options):
        builds.append(program)
        if len(builds) == 1:
            raise cl.RuntimeError("unable to rename temporary: No such file or directory")
        return real(program, *arguments, **options)

    monkeypatch.setattr(cl.Program, "build", build)
    monkeypatch.setattr(program, "source", lambda files: "kernel void nothing(global int *a) {}")
    assert program.Program(one_device, (), {}).kernel("nothing").name == "nothing"
    assert len(builds) == 2
    monkeypatch.setattr(program, "source", lambda files: "this is no kernel")
    with pytest.raises(RuntimeError, match=r"building .* failed"):
        program.Program(one_device, (), {})


@pytest.mark.skipif(os.name != "posix", reason="sends signals")
def test_a_second_signal_ends_at_once(scenes, one_device, tmp_path):
    with begin_long_render(scenes, one_device, tmp_path) as process:
        process.send_signal(signal.SIGTERM)
        # The answer to the first one comes before the second is sent.
        assert any("stopping" in line for line in process.stderr)
        process.send_signal(signal.SIGTERM)
        process.communicate(timeout=PATIENCE)
        assert process.returncode == 0 or process.returncode == -signal.SIGTERM
