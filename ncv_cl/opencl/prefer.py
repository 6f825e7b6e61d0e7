"""Whether a GPU is taken before a CPU: a rule from what devices say of themselves, without a clock."""

from __future__ import annotations

import re
from contextlib import suppress
from dataclasses import dataclass

import pyopencl as cl

# A GPU's peak over a CPU's from which on it is taken. A GPU reaches a smaller part of its peak than a
# CPU: lanes of a group part, few warps hide latencies, and the host is in between. The last table of
# docs/gpu_model.md, by `python bench/gpu_model.py`, holds the ratio of peaks over that of seconds: 13 in
# the mean.
LEAST_ADVANTAGE = 16.0
# Device memory below which an image of 1024 x 1024 points does not fit (docs/devices.md).
LEAST_MEMORY = 2 << 30
# Clocks of devices that do not tell.
CPU_MEGAHERTZ, GPU_MEGAHERTZ = 3000, 1000
# Multiply-adds a clock of one compute unit, by a vendor's name: Intel's unit is an execution unit of
# eight lanes. NVIDIA's and AMD's are asked first, see `_gpu_lanes`.
GPU_LANES_A_UNIT = {"nvidia": 64, "advanced micro devices": 64, "amd": 64, "intel": 8, "apple": 128}
# Software that may call itself a GPU.
_SOFTWARE = re.compile(r"llvmpipe|softpipe|swrast|swiftshader|oclgrind", re.IGNORECASE)


@dataclass(frozen=True)
class Facts:
    """What a device says of itself.

    Attributes
    ----------
    name : str
    is_gpu : bool
        Whether it is hardware of its own: software that calls itself a GPU is none.
    units : int
        Compute units: a CPU's threads, a GPU's multiprocessors.
    megahertz : int
    lanes : int
        float32 multiply-adds of a unit a clock; 0 where a vendor's is not known.
    shares_memory : bool
        Whether host and device share memory, as on integrated GPUs.
    memory : int
        Bytes.
    """

    name: str
    is_gpu: bool
    units: int
    megahertz: int
    lanes: int
    shares_memory: bool
    memory: int

    @property
    def peak(self) -> float:
        """Billion float32 multiply-adds a second: units times clock times lanes."""
        return 1e-3 * self.units * self.megahertz * self.lanes


def facts_of(cl_device: cl.Device) -> Facts:
    """A device's facts."""
    name, shares_memory = cl_device.name.strip(), False
    # OpenCL 2.0 deprecates the question.
    with suppress(cl.Error):
        shares_memory = bool(cl_device.host_unified_memory)
    is_gpu = bool(cl_device.type & cl.device_type.GPU) and not _SOFTWARE.search(name)
    clock = GPU_MEGAHERTZ if is_gpu else CPU_MEGAHERTZ
    return Facts(
        name=name,
        is_gpu=is_gpu,
        units=cl_device.max_compute_units,
        megahertz=cl_device.max_clock_frequency or clock,
        lanes=_gpu_lanes(cl_device) if is_gpu else max(1, cl_device.native_vector_width_float),
        shares_memory=shares_memory,
        memory=cl_device.global_mem_size,
    )


def _gpu_lanes(cl_device: cl.Device) -> int:
    """Lanes of one of a GPU's compute units; 0 where its vendor is not known."""
    # Another vendor's question is an error, or one that the headers do not know.
    with suppress(cl.Error, AttributeError):
        version = cl_device.compute_capability_major_nv, cl_device.compute_capability_minor_nv
        return 64 if version in ((6, 0), (7, 0), (7, 2), (7, 5), (8, 0)) else 128
    with suppress(cl.Error, AttributeError):
        return int(cl_device.simd_per_compute_unit_amd * cl_device.simd_width_amd)
    vendor = cl_device.vendor.lower()
    return next((lanes for name, lanes in GPU_LANES_A_UNIT.items() if name in vendor), 0)


def gpu_pays(gpu: Facts, cpu: Facts) -> tuple[bool, str]:
    """Whether a GPU is taken before a CPU, and why, in words.

    Its peak must be `LEAST_ADVANTAGE` times the CPU's, so that a laptop's integrated GPU is left, and it
    must have `LEAST_MEMORY`. A GPU whose peak is not known is left, too: who has measured it names it.
    """
    if not gpu.is_gpu:
        return False, f"{gpu.name} is software that calls itself a GPU"
    if not gpu.lanes:
        return False, f"how many lanes a unit of {gpu.name} has is not known"
    kind = "integrated" if gpu.shares_memory else "discrete"
    ratio = gpu.peak / cpu.peak
    said = f"the {kind} GPU's peak is {ratio:.2g} times the CPU's"
    if ratio < LEAST_ADVANTAGE:
        return False, f"{said}, and {LEAST_ADVANTAGE:g} times are needed to pay"
    if gpu.memory < LEAST_MEMORY:
        return False, f"{said}, but it has {gpu.memory >> 20} MiB of memory, too few"
    return True, f"{said}, and it pays from {LEAST_ADVANTAGE:g} on"
