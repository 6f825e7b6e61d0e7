"""When a GPU is taken before a CPU: made-up devices, and what they say of themselves."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import pyopencl as cl
import pytest

from ncv_cl.opencl.choose import all_devices
from ncv_cl.opencl.prefer import LEAST_ADVANTAGE, Facts, facts_of, gpu_pays

H100 = Facts("NVIDIA H100 80GB HBM3", True, 132, 1980, 128, False, 80 << 30)
LAPTOP = Facts("Intel(R) Iris(R) Xe Graphics", True, 96, 1300, 8, True, 12 << 30)
SIXTEEN_CORES = Facts("16 cores with AVX-512", False, 32, 3000, 16, True, 64 << 30)
LAPTOP_CORES = Facts("8 cores with AVX2", False, 16, 3000, 8, True, 16 << 30)
TWO_CORES = Facts("2 cores with AVX-512", False, 2, 2500, 16, True, 8 << 30)
LLVMPIPE = Facts("llvmpipe (LLVM 15.0.6, 256 bits)", False, 16, 0, 8, True, 16 << 30)


@pytest.mark.parametrize(
    ("gpu", "cpu", "expected", "why"),
    [
        (H100, SIXTEEN_CORES, True, "the discrete GPU's peak is 22 times the CPU's"),
        (H100, TWO_CORES, True, "discrete"),
        (LAPTOP, LAPTOP_CORES, False, "the integrated GPU's peak is 2.6 times the CPU's"),
        (LAPTOP, SIXTEEN_CORES, False, "8 times are needed to pay"),
        (LLVMPIPE, TWO_CORES, False, "software that calls itself a GPU"),
        (replace(H100, lanes=0), TWO_CORES, False, "is not known"),
        (replace(H100, memory=1 << 30), TWO_CORES, False, "1024 MiB of memory"),
    ],
)
def test_a_gpu_must_be_far_ahead(gpu, cpu, expected, why):
    pays, said = gpu_pays(gpu, cpu)
    assert pays is expected and why in said


@pytest.mark.parametrize("part", [0.99, 1.0, 1.01])
def test_the_advantage_is_where_it_is_said_to_be(part):
    cpu = Facts("", False, 1, 1000, 10, True, 1)
    gpu = Facts("", True, 1, 1000, round(10 * LEAST_ADVANTAGE * part * 100), False, 1 << 40)
    assert gpu_pays(replace(gpu, units=1, megahertz=10), cpu)[0] is (part >= 1.0)


def told(**answers):
    """A device that answers these questions, and to none of other vendors."""
    common = {
        "name": "some",
        "type": cl.device_type.GPU,
        "vendor": "",
        "max_compute_units": 10,
        "max_clock_frequency": 1500,
        "native_vector_width_float": 16,
        "host_unified_memory": 1,
        "global_mem_size": 8 << 30,
    }
    return SimpleNamespace(**common | answers)


@pytest.mark.parametrize(
    ("answers", "lanes"),
    [
        ({"compute_capability_major_nv": 9, "compute_capability_minor_nv": 0}, 128),
        ({"compute_capability_major_nv": 8, "compute_capability_minor_nv": 0}, 64),
        ({"simd_per_compute_unit_amd": 4, "simd_width_amd": 16}, 64),
        ({"vendor": "Intel(R) Corporation"}, 8),
        ({"vendor": "Someone"}, 0),
        ({"type": cl.device_type.CPU}, 16),
    ],
)
def test_lanes_follow_from_what_a_device_tells(answers, lanes):
    facts = facts_of(told(**answers))
    assert facts.lanes == lanes and facts.shares_memory
    assert facts.peak == 10 * 1.5 * lanes


@pytest.mark.parametrize("name", ["llvmpipe (LLVM 15.0.6, 256 bits)", "softpipe"])
@pytest.mark.parametrize("kind", [cl.device_type.GPU, cl.device_type.CPU])
def test_software_is_no_gpu_whatever_it_claims(name, kind):
    assert not facts_of(told(name=name, type=kind)).is_gpu


def test_clocks_that_are_not_told_are_assumed():
    assert facts_of(told(max_clock_frequency=0)).megahertz == 1000
    assert facts_of(told(max_clock_frequency=0, type=cl.device_type.CPU)).megahertz == 3000


def test_devices_that_are_there_have_a_peak():
    for device in all_devices():
        facts = facts_of(device.cl_device)
        assert facts.peak > 0 and facts.memory > 0 and facts.is_gpu <= device.is_gpu
