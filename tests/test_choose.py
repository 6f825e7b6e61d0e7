"""Choosing a device by rules, what is said without one, and a list of all with their speeds."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import pyopencl as cl
import pytest

from ncv_cl.opencl import choose, probe
from ncv_cl.opencl.choose import all_devices, choose_device, devices
from ncv_cl.opencl.device import Device, DeviceError, prefers_fma
from ncv_cl.opencl.probe import Probe

ROOT = Path(__file__).parent.parent


@pytest.fixture(autouse=True)
def alone(monkeypatch):
    """No wishes from outside, and a benchmark that takes no time."""
    for variable in (choose.VARIABLE, "PYOPENCL_CTX"):
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.setattr(choose, "measure", lambda device: Probe(100.0 + device.index))


def stand_in(platform="Portable Computing Language", version="", kind=cl.device_type.CPU, fma=True):
    """An OpenCL device that is of some runtime; as a GPU, one of a hundred times a CPU's peak."""
    config = cl.device_fp_config.FMA if fma else cl.device_fp_config.DENORM
    runtime = SimpleNamespace(name=platform, version=version)
    found = Mock(platform=runtime, type=kind, single_fp_config=config, version="", vendor="Apple")
    found.configure_mock(
        name=platform, max_compute_units=16, max_clock_frequency=2000, host_unified_memory=False
    )
    found.native_vector_width_float, found.global_mem_size, found.local_mem_size = 1, 64 << 30, 1 << 16
    for question in ("compute_capability_major_nv", "simd_per_compute_unit_amd"):
        delattr(found, question)
    return found


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


@pytest.mark.parametrize("value", ["0", "0:0", ":"])
def test_pyopencls_variable_chooses(monkeypatch, value):
    first = choose._listed()[0]
    if first.problem is not None:
        pytest.skip("the first device cannot be used")
    monkeypatch.setenv("PYOPENCL_CTX", value)
    assert choose_device() is first


POCL_30 = "OpenCL 3.0 PoCL 3.0-rc2  Linux, Release, RELOC, LLVM 14.0.6"
POCL_31 = "OpenCL 3.0 PoCL 3.1+debian  Linux, None+Asserts, RELOC, SPIR, LLVM 15.0.6"
POCL_5 = "OpenCL 3.0 PoCL 5.0  Linux, Release, RELOC, SPIR-V, LLVM 16.0.6"
POCL_10 = "OpenCL 3.0 PoCL 10.2  Linux, Release, RELOC, LLVM 22"


def test_what_is_known_of_runtimes_decides_and_not_the_clock(monkeypatch):
    best_first = [
        stand_in("NVIDIA CUDA", "OpenCL 3.0 CUDA 12.4", cl.device_type.GPU),
        stand_in(version=POCL_10),
        stand_in(version=POCL_5),
        stand_in(version=POCL_31),
        stand_in("Intel(R) OpenCL", "OpenCL 3.1 LINUX"),
        stand_in(version=POCL_30),
        stand_in("Oclgrind", "OpenCL 1.2 (Oclgrind 21.10)"),
    ]
    for count in range(1, len(best_first) + 1):
        for order in (best_first[-count:], best_first[-count:][::-1]):
            listed = [Device(cl_device, index) for index, cl_device in enumerate(order)]
            assert choose._chosen(None, listed)[0].cl_device is best_first[-count]


def test_of_equal_devices_the_first_is_chosen():
    listed = [Device(stand_in(version=POCL_31), index) for index in range(3)]
    assert choose._chosen(None, listed)[0] is listed[0]


def test_a_gpu_that_does_not_pay_is_left_and_the_reason_told(monkeypatch):
    weak = stand_in("Intel(R) OpenCL Graphics", "OpenCL 3.0 NEO", cl.device_type.GPU)
    weak.vendor, weak.host_unified_memory = "Intel(R) Corporation", True
    listed = [Device(weak, 0), Device(stand_in(version=POCL_31), 1)]
    weak.max_compute_units = 4
    device, why = choose._chosen(None, listed)
    assert device is listed[1]
    assert why == "the integrated GPU's peak is 2 times the CPU's, and 8 times are needed to pay"
    # Alone it is taken, and by its name.
    assert choose._chosen(None, listed[:1])[0] is listed[0]
    assert choose._chosen("graphics", listed) == (listed[0], "as asked for")
    monkeypatch.setenv(choose.VARIABLE, "0")
    assert choose._chosen(None, listed) == (listed[0], f"as {choose.VARIABLE} says")


def test_of_two_gpus_the_one_of_the_higher_peak_is_chosen():
    listed = [Device(stand_in("NVIDIA CUDA", "", cl.device_type.GPU), index) for index in range(2)]
    listed[1].cl_device.max_compute_units = 132
    assert choose._chosen(None, listed) == (
        listed[1],
        "the GPU of the highest peak, without a CPU's runtime beside it",
    )


@pytest.mark.parametrize(
    ("cl_device", "expected"),
    [
        (stand_in(version=POCL_30), False),
        (stand_in(version=POCL_31), True),
        (stand_in(version=POCL_10), True),
        # A CPU without the instruction: there `fma` is a function.
        (stand_in(version=POCL_31, fma=False), False),
        # Intel's runtime does not say that it has it, but does.
        (stand_in("Intel(R) OpenCL", "OpenCL 3.1 LINUX", fma=False), True),
        (stand_in(version=POCL_30, kind=cl.device_type.GPU), True),
        (stand_in("NVIDIA CUDA", "OpenCL 3.0 CUDA 12.4", cl.device_type.GPU), True),
    ],
)
def test_fma_follows_from_the_runtime(cl_device, expected):
    assert prefers_fma(cl_device) is expected


def test_what_is_chosen_is_compiled_by_the_rule():
    for device in all_devices():
        chosen = choose_device(device.index)
        assert chosen is device and chosen.use_fma == prefers_fma(device.cl_device)
        assert ("fma" if chosen.use_fma else "multiply-add") in chosen.describe()


def test_devices_prints_one_line_each_with_its_benchmark():
    reports = devices()
    lines = str(reports).splitlines()
    assert len(lines) == len(reports) + 1 == len(choose._listed()) + 1
    assert lines[-1].startswith(f"taken unless another is named: [{choose_device().index}], ")
    for line, device in zip(lines[:-1], choose._listed(), strict=True):
        assert line.startswith(device.describe())
        assert ("multiply-adds a second" if device in all_devices() else "not used: ") in line
    assert repr(reports) == str(reports)


def test_a_wish_that_cannot_be_met_does_not_keep_devices_from_the_list(monkeypatch):
    monkeypatch.setenv(choose.VARIABLE, "nonsense")
    assert devices().choice.startswith("none is taken: no device matches 'nonsense'; choose by index")


def test_without_any_opencl_the_error_says_what_to_install(tmp_path):
    # A file, not an empty folder: with a folder the loader adds the runtime that pip installed.
    environment = {**os.environ, "OCL_ICD_VENDORS": f"{tmp_path}/none.icd"}
    program = (
        "import ncv_cl.opencl.choose as c\ntry: c.choose_device()\nexcept c.DeviceError as e: print(e)"
    )
    run = subprocess.run(
        [sys.executable, "-c", program], env=environment, cwd=ROOT, capture_output=True, text=True
    )
    assert "pip install 'ncv_cl[pocl]'" in run.stdout and "pocl-opencl-icd" in run.stdout, run.stderr
    assert run.returncode == 0 and "Traceback" not in run.stderr


def test_the_real_benchmark_measures_a_speed(monkeypatch, device):
    monkeypatch.setattr(probe, "SECONDS", 0.0)
    assert 0 < probe.measure(device).multiply_adds < 1e6
