"""The benchmark that lists of devices show, and the record of devices that were used."""

from __future__ import annotations

import json
import os

import numpy as np
import pytest

from ncv_cl.opencl import probe
from ncv_cl.opencl.memory import HostArray
from ncv_cl.opencl.program import build


def test_chains_of_multiply_adds_match_float64(device):
    count, steps = 64 * device.vector_width, 8
    start = np.linspace(-3, 3, count).astype(np.float32)
    values = HostArray.of(device, start)
    program = build(device, ("common", "probe"), {"STEPS": f"{2 * steps}u"})
    program.kernel("multiply_add")(64, a=0.75, b=-1.5, values=values)
    first, second = start.astype(np.float64), start + 1.0
    for _ in range(steps):
        first, second = 0.75 * first - 1.5, 0.75 * second - 1.5
    np.testing.assert_allclose(values.read(), 0.5 * (first + second), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("text", ["", "{", "[]", "null", "3", '{"KEY": 1}'])
def test_a_record_of_devices_is_kept_whatever_was_there(tmp_path, monkeypatch, one_device, text):
    folder = tmp_path / "ncv_cl"
    folder.mkdir()
    (folder / "probe.json").write_text(text)
    monkeypatch.setattr(probe, "cache_folder", lambda name: tmp_path / name)
    monkeypatch.setattr(probe, "_recorded", set())
    for _ in range(2):
        probe.record(one_device)
    (found,) = (
        facts
        for key, facts in json.loads((folder / "probe.json").read_text()).items()
        if one_device.identity in key
    )
    assert found["use_fma"] == one_device.use_fma
    assert os.listdir(folder) == ["probe.json"], "no temporary file stays"


@pytest.mark.parametrize("home", ["a file", None])
def test_a_record_that_cannot_be_kept_is_no_fault(tmp_path, monkeypatch, one_device, home):
    (tmp_path / "a file").write_text("in the way")
    monkeypatch.setattr(probe, "cache_folder", lambda name: home and tmp_path / home)
    monkeypatch.setattr(probe, "_recorded", set())
    probe.record(one_device)
    assert os.listdir(tmp_path) == ["a file"]
