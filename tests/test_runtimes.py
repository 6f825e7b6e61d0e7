"""Which OpenCL runtimes are found, and which of their devices are left out and why."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import pyopencl as cl
import pytest

from ncv_cl.opencl import choose, runtimes
from ncv_cl.opencl import device as device_module
from ncv_cl.opencl.choose import all_devices, choose_device, devices
from ncv_cl.opencl.device import DeviceError, list_cl_devices, open_device

ROOT = Path(__file__).parent.parent
UNKNOWN_CPU = "OpenCL 3.0 PoCL HSTR: pthread-x86_64-unknown-linux-gnu-generic "


def refuse(context, source):
    """A compiler as PoCL 3.0's on a CPU newer than its LLVM."""
    raise cl.RuntimeError(
        "clBuildProgram failed: BUILD_PROGRAM_FAILURE\n\nerror: unknown target CPU 'generic'\nDevice x"
    )


@pytest.fixture
def compiled(monkeypatch, one_device):
    """Contexts of stand-in devices are a real one's; lists what is compiled in them."""
    real, sources = cl.Program, []

    def build(context, source):
        sources.append(source)
        return real(context, source)

    monkeypatch.setattr(device_module, "_context", lambda cl_device: one_device.context)
    monkeypatch.setattr(cl, "Program", build)
    return sources


@pytest.mark.parametrize(
    "version",
    [
        "OpenCL 3.0 PoCL HSTR: pthread-x86_64-unknown-linux-gnu-znver3",
        "OpenCL 3.0 PoCL HSTR: pthread-aarch64-unknown-linux-gnu-generic",
        "OpenCL 3.1 (Build 0)",
        "OpenCL 3.0 CUDA",
    ],
)
def test_a_device_without_reason_to_fail_costs_no_compilation(compiled, version):
    assert device_module._problem(Mock(version=version)) is None
    assert compiled == []


def test_an_unknown_cpu_that_compiles_is_used(compiled):
    assert device_module._problem(Mock(version=UNKNOWN_CPU)) is None
    assert len(compiled) == 1


def test_an_unknown_cpu_that_does_not_compile_says_what_to_install(compiled, monkeypatch):
    monkeypatch.setattr(cl, "Program", refuse)
    problem = device_module._problem(Mock(version=UNKNOWN_CPU))
    assert "cannot compile for this CPU" in problem and "unknown target CPU 'generic'" in problem
    assert "pip install 'ncv_cl[intel]'" in problem and "apt install pocl-opencl-icd" in problem
    assert "\n" not in problem


def test_what_cannot_be_used_is_listed_and_never_chosen(monkeypatch):
    for variable in (choose.VARIABLE, "PYOPENCL_CTX"):
        monkeypatch.delenv(variable, raising=False)
    # One device twice; the second stands for another, and is broken.
    first = all_devices()[0]
    first, second = open_device(first.cl_device, 0), open_device(first.cl_device, 1)
    monkeypatch.setattr(choose, "_listed", lambda: [first, second])
    monkeypatch.setattr(
        device_module.Device, "problem", property(lambda one: "is broken" if one.index else None)
    )
    assert all_devices() == [first]
    assert choose_device().cl_device == first.cl_device and choose_device().index == 0
    # A name that both have means the one that works.
    assert choose_device(first.name).index == 0
    with pytest.raises(DeviceError, match=r"device 1, .* is broken"):
        choose_device(1)
    monkeypatch.setattr(choose, "measure", lambda device: choose.Probe(1.0))
    usable, unusable, choice = str(devices()).splitlines()
    assert choice.endswith("[0], the only device that can be used")
    assert "multiply-adds a second" in usable and "not used" not in usable
    assert unusable.startswith(second.describe()) and unusable.endswith("not used: is broken")


def test_a_device_whose_benchmark_fails_does_not_keep_others_from_the_list(monkeypatch):
    first = all_devices()[0]
    listed = [open_device(first.cl_device, index) for index in range(3)]

    def fail(device):
        if device.index == 2:
            return choose.Probe(1.0)
        raise (cl.RuntimeError, RuntimeError)[device.index](
            "building failed:\n<program>:3: error: no\nmore"
        )

    monkeypatch.setattr(choose, "_listed", lambda: listed)
    monkeypatch.setattr(choose, "measure", fail)
    lines = str(devices()).splitlines()
    assert len(lines) == 4 and "multiply-adds a second" in lines[2]
    assert all(line.endswith("not used: its benchmark failed (error: no)") for line in lines[:2])


@pytest.mark.parametrize("variable", [None, choose.VARIABLE, "PYOPENCL_CTX"])
def test_with_nothing_left_the_error_says_why_and_what_to_do(monkeypatch, variable):
    monkeypatch.setattr(device_module, "_problem", lambda cl_device: "is broken; install another")
    for name in (choose.VARIABLE, "PYOPENCL_CTX"):
        monkeypatch.delenv(name, raising=False)
    if variable is not None:
        monkeypatch.setenv(variable, "0")
    assert all_devices() == []
    with pytest.raises(DeviceError, match=r"is broken; install another$"):
        choose_device()


@pytest.mark.parametrize("value", ["9:9", "9", "no such platform", "0:99", "0:no such device"])
def test_a_wish_of_pyopencls_that_names_nothing_is_a_clear_error(monkeypatch, value):
    monkeypatch.delenv(choose.VARIABLE, raising=False)
    monkeypatch.setenv("PYOPENCL_CTX", value)
    with pytest.raises(DeviceError) as caught:
        choose_device()
    assert f"PYOPENCL_CTX={value} names no device" in str(caught.value)
    assert choose._listed()[0].describe() in str(caught.value)


def named(name, *found, error=None):
    """A platform; `name` is an argument of Mock's own."""
    made = Mock(get_devices=Mock(return_value=list(found), side_effect=error))
    made.name = name
    return made


def test_a_driver_without_its_hardware_takes_no_other_runtime_with_it(monkeypatch):
    broken = named("NVIDIA CUDA", error=cl.LogicError("clGetDeviceIDs failed: OUT_OF_HOST_MEMORY"))
    registered = [broken, named("PoCL", "a", "b"), named("PoCL again", "b"), named("empty")]
    monkeypatch.setattr(device_module, "platforms", lambda: registered)
    assert list_cl_devices() == ["a", "b"]
    monkeypatch.setattr(device_module, "platforms", lambda: [broken, named("empty")])
    with pytest.raises(DeviceError) as caught:
        list_cl_devices()
    said = str(caught.value)
    assert "NVIDIA CUDA: clGetDeviceIDs failed: OUT_OF_HOST_MEMORY; empty: none" in said
    assert "Install a runtime" in said


def test_a_platforms_name_chooses():
    device = all_devices()[0]
    assert device.platform_name not in device.identity
    name = f"{device.platform_name} | {device.identity}"
    assert choose_device(name).cl_device == device.cl_device


def test_a_library_of_the_environment_is_registered_while_the_loader_looks(tmp_path):
    entries = [entry.read_text().strip() for entry in runtimes._VENDORS.glob("pocl*.icd")]
    if not entries or not runtimes._LOADER.is_dir():
        pytest.skip("needs PoCL of the system and pyopencl's own loader")
    # PoCL's library in the place of Intel's, with no system entries: only the registration finds it.
    program = f"""
import os, pathlib, tempfile
from ncv_cl.opencl import runtimes
runtimes._VENDORS = pathlib.Path({str(tmp_path)!r})
runtimes._intel_library = lambda: {entries[0]!r}
before = set(os.listdir(tempfile.gettempdir()))
assert runtimes.platforms()
assert "OCL_ICD_VENDORS" not in os.environ
assert not {{n for n in set(os.listdir(tempfile.gettempdir())) - before if n.startswith("ncv_cl-")}}
print({entries[0]!r} in pathlib.Path("/proc/self/maps").read_text())
"""
    environment = {key: value for key, value in os.environ.items() if key != "OCL_ICD_VENDORS"}
    run = subprocess.run(
        [sys.executable, "-c", program], env=environment, cwd=ROOT, capture_output=True, text=True
    )
    assert run.returncode == 0, run.stderr
    assert run.stdout.strip() == "True"


@pytest.mark.parametrize("known", [True, False])
def test_the_library_is_found_where_the_package_put_it(tmp_path, monkeypatch, known):
    library = tmp_path / "lib" / "libintelocl.so"
    library.parent.mkdir()
    library.write_bytes(b"")
    file = SimpleNamespace(name=library.name, locate=lambda: library)
    other = SimpleNamespace(name="libother.so", locate=lambda: tmp_path / "lib" / "libother.so")
    monkeypatch.setattr(runtimes, "distribution", lambda name: SimpleNamespace(files=[other, file]))
    monkeypatch.setattr(runtimes, "_VENDORS", tmp_path)
    if known:
        # The system has a runtime of that name already.
        (tmp_path / "intel64.icd").write_text("/opt/intel/lib/libintelocl.so\n")
        assert runtimes._intel_library() is None
    else:
        assert runtimes._intel_library() == library.resolve()
        library.unlink()
        assert runtimes._intel_library() is None


def test_without_the_package_nothing_is_registered(monkeypatch):
    def missing(name):
        raise runtimes.PackageNotFoundError(name)

    monkeypatch.setattr(runtimes, "distribution", missing)
    assert runtimes._intel_library() is None
