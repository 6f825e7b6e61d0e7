"""Choosing a device, what is said without one, and the cached micro-benchmark."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from ncv_cl import choose, probe
from ncv_cl.choose import all_devices, choose_device, devices
from ncv_cl.device import DeviceError
from ncv_cl.probe import Probe, cached_probe

ROOT = Path(__file__).parent.parent


@pytest.fixture(autouse=True)
def measured(tmp_path, monkeypatch):
    """An empty cache folder, no wishes from outside, and a benchmark that only counts its calls."""
    calls = []

    def count(device):
        calls.append(device.index)
        # Later devices are faster, so that the choice is not simply the first.
        return Probe(100.0 - device.index, use_fma=bool(device.index % 2))

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    for variable in (choose.VARIABLE, "PYOPENCL_CTX"):
        monkeypatch.delenv(variable, raising=False)
    for module in (probe, choose):
        monkeypatch.setattr(module, "measure", count)
    return calls


def cache_file(tmp_path: Path) -> Path:
    return tmp_path / "ncv_cl" / "probe.json"


def test_every_device_is_chosen_by_its_index():
    for device in all_devices():
        for selector in (device.index, str(device.index), f" {device.index} "):
            assert choose_device(selector).cl_device == device.cl_device


def test_a_device_is_chosen_by_a_part_of_its_own_name():
    found = all_devices()
    for device in found:
        for name in (device.identity, device.identity.upper()):
            assert choose_device(name).cl_device == device.cl_device
    assert choose_device(found[0]) is found[0]


@pytest.mark.parametrize("selector", ["99", 99, "no such thing", -1])
def test_an_unknown_device_is_refused_with_the_list(selector):
    with pytest.raises(DeviceError, match=f"no device.*{str(selector).strip()}") as caught:
        choose_device(selector)
    for device in all_devices():
        assert device.describe() in str(caught.value)


def test_an_ambiguous_name_is_refused_with_the_list():
    found = all_devices()
    if len(found) < 2:
        pytest.skip("one device cannot be ambiguous")
    with pytest.raises(DeviceError, match=r"more than one device matches 'OpenCL'.*index") as caught:
        choose_device("OpenCL")
    assert all(device.describe() in str(caught.value) for device in found)


def test_the_variable_chooses_and_an_argument_overrides_it(monkeypatch):
    last = all_devices()[-1]
    monkeypatch.setenv(choose.VARIABLE, str(last.index))
    assert choose_device().index == last.index
    assert choose_device(0).index == 0
    monkeypatch.setenv(choose.VARIABLE, "nonsense")
    with pytest.raises(DeviceError, match="no device matches 'nonsense'"):
        choose_device()


def test_pyopencls_variable_chooses(monkeypatch):
    monkeypatch.setenv("PYOPENCL_CTX", "0")
    assert choose_device().index == 0


def test_the_fastest_is_chosen_and_takes_its_measured_fma(measured):
    found = all_devices()
    if any(device.is_gpu for device in found):
        pytest.skip("a GPU comes first")
    chosen = choose_device()
    assert chosen.index == len(found) - 1
    assert chosen.use_fma == bool(chosen.index % 2)
    assert sorted(measured) == [device.index for device in found]


def test_the_benchmark_is_cached_for_each_device_and_driver(tmp_path, measured):
    found = all_devices()
    first = [cached_probe(device) for device in found]
    assert len(measured) == len(found)
    assert [cached_probe(device) for device in found] == first
    assert len(measured) == len(found)
    known = json.loads(cache_file(tmp_path).read_text())
    assert len(known) == len(found)
    for device in found:
        assert any(device.identity in key for key in known)
    assert os.listdir(tmp_path / "ncv_cl") == ["probe.json"], "no temporary file stays"


@pytest.mark.parametrize("text", ["", "{", "[]", "null", "3", '{"KEY": 1}', '{"KEY": {"old": 1}}'])
def test_a_damaged_cache_is_measured_again(tmp_path, measured, one_device, text):
    cached_probe(one_device)
    (key,) = json.loads(cache_file(tmp_path).read_text())
    cache_file(tmp_path).write_text(text.replace("KEY", key.replace("\\", "\\\\")))
    expected = Probe(100.0 - one_device.index, bool(one_device.index % 2))
    assert cached_probe(one_device) == expected
    assert len(measured) == 2
    assert cached_probe(one_device) == expected
    assert len(measured) == 2


def test_a_cache_that_cannot_be_written_is_no_error(tmp_path, monkeypatch, one_device):
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    assert cached_probe(one_device).nanoseconds == 100.0 - one_device.index


def test_devices_prints_one_line_each_with_its_benchmark():
    reports = devices()
    lines = str(reports).splitlines()
    assert len(lines) == len(reports) == len(all_devices())
    for line, device in zip(lines, all_devices(), strict=True):
        assert line.startswith(device.describe()) and "ns a sample" in line
    assert repr(reports) == str(reports)


def test_without_any_opencl_the_error_says_what_to_install(tmp_path):
    # A file, not an empty folder: with a folder the loader adds the runtime that pip installed.
    environment = {**os.environ, "OCL_ICD_VENDORS": f"{tmp_path}/none.icd"}
    program = "import ncv_cl.choose as c\ntry: c.choose_device()\nexcept c.DeviceError as e: print(e)"
    run = subprocess.run(
        [sys.executable, "-c", program], env=environment, cwd=ROOT, capture_output=True, text=True
    )
    assert "pip install 'ncv_cl[pocl]'" in run.stdout and "pocl-opencl-icd" in run.stdout, run.stderr
    assert run.returncode == 0 and "Traceback" not in run.stderr


def test_the_real_benchmark_measures_a_time(monkeypatch, one_device):
    monkeypatch.undo()
    monkeypatch.setattr(probe, "_SECONDS", 0.0)
    measured = probe.measure(one_device)
    assert 0 < measured.nanoseconds < 1e6
