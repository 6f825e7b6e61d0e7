"""One OpenCL device: what it is, and what it can do."""

from __future__ import annotations

import functools
import re
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from typing import TypeVar

import pyopencl as cl

from .limits import DeviceError, DeviceMemory
from .runtimes import loaded_elsewhere, platforms

# A group of this many work-items cooperates on one shading point on a GPU (a warp on NVIDIA) that does
# not tell how many run in step.
GPU_LANES = 32
# Work-items in a group of a kernel in which work-items do not cooperate: whole warps, and whole waves.
GROUP_SIZE = 64
# Groups on a GPU that share work among themselves: enough to hide latencies, few enough to keep their
# tables in the cache.
GROUPS_PER_COMPUTE_UNIT = 8
# Local memory that every GPU has.
GPU_LOCAL_BYTES = 48 << 10

# PoCL ends a device's version by the CPU that its LLVM compiles for; these lack AVX-512. LLVM 14 takes
# newer AMD CPUs for one; PoCL 3.0 claims vectors of 64 bytes all the same, and aborts over them.
_NO_AVX512 = re.compile(r"-(znver[123]|generic|x86-64)$")
_AVX_BYTES = 32

# What LLVM calls an x86-64 CPU that it does not know. It does not accept this name as a target.
_UNKNOWN_CPU = re.compile(r"x86_64\S*-generic$")

_POCL = re.compile(r"PoCL (\d+)\.(\d+)")

INSTALL_HINT = (
    "no OpenCL device was found. Install a runtime: `pip install 'ncv_cl[pocl]'` brings PoCL for the "
    "CPU without any system package; on Debian and Ubuntu `apt install pocl-opencl-icd` is faster; "
    "GPUs need their vendor's driver with an entry under /etc/OpenCL/vendors "
    "(NVIDIA without one: set OCL_ICD_VENDORS=libnvidia-opencl.so.1)."
)
OTHER_RUNTIME_HINT = (
    "install another runtime: `pip install 'ncv_cl[intel]'` brings Intel's for any x86-64 CPU; on "
    "Debian and Ubuntu `apt install pocl-opencl-icd` brings a newer PoCL"
)


def check_process() -> None:
    """Raise where the next OpenCL call would hang.

    Raises
    ------
    DeviceError
        In a process that was forked from one that had used OpenCL.
    """
    if loaded_elsewhere():
        raise DeviceError(
            "this process was forked from one that had used OpenCL, whose threads it does not have: "
            "start processes by multiprocessing's 'spawn' or 'forkserver', or fork before the first "
            "use of OpenCL"
        )


_Made = TypeVar("_Made")


def once(make: Callable[..., _Made]) -> Callable[..., _Made]:
    """`functools.cache` under a lock: threads that ask at the same time get the same object."""
    made, lock = functools.cache(make), threading.RLock()

    @functools.wraps(make)
    def ask(*arguments: object, **options: object) -> _Made:
        check_process()
        with lock:
            return made(*arguments, **options)

    return ask


class CutShortError(DeviceError):
    """A device's runtime ended a kernel before all its work was done, as some do after so many turns."""

    @classmethod
    def of(cls, device: Device, done: str) -> CutShortError:
        """The error of a device, and what was `done`, as in "integrated 3 of 5 points"."""
        name = f"{device.name} ({device.platform_version})"
        return cls(f"{name} {done}: its runtime cut the kernel short. Choose another device")


@dataclass(frozen=True, eq=False)
class Device:
    """An OpenCL device with its context and in-order queue.

    Attributes
    ----------
    cl_device : pyopencl.Device
    index : int
        Position in the list that `devices()` prints; a selector accepts it.
    vector_width : int
        VEC: samples per work-item, as `floatN` (1, 4, 8 or 16). CPU runtimes do not vectorise scalar
        work-items with private arrays, GPUs do not want vectors.
    lanes : int
        LANES: work-items that cooperate on one shading point.
    use_fma : bool
        Whether kernels call `fma` or write `a * b + c` with ``-cl-mad-enable``; see `prefers_fma`.
    memory : DeviceMemory
        How much there is, and whether the host shares it.
    context, queue
        pyopencl's; raise `DeviceError` where `check_process` does.
    """

    cl_device: cl.Device
    index: int = 0
    vector_width: int = 1
    lanes: int = 1
    use_fma: bool = True
    # A device that is only listed needs none of these; whoever asks for one has opened it.
    memory: DeviceMemory = field(repr=False, default=None)  # type: ignore[assignment]
    _context: cl.Context = field(repr=False, default=None)  # type: ignore[assignment]
    _queue: cl.CommandQueue = field(repr=False, default=None)  # type: ignore[assignment]

    @property
    def context(self) -> cl.Context:
        check_process()
        return self._context

    @property
    def queue(self) -> cl.CommandQueue:
        check_process()
        return self._queue

    @property
    def name(self) -> str:
        return self.cl_device.name.strip()

    @property
    def platform_name(self) -> str:
        return self.cl_device.platform.name.strip()

    @property
    def platform_version(self) -> str:
        return " ".join(self.cl_device.platform.version.split())

    @property
    def is_cpu(self) -> bool:
        return bool(self.cl_device.type & cl.device_type.CPU)

    @property
    def is_gpu(self) -> bool:
        return bool(self.cl_device.type & cl.device_type.GPU)

    @property
    def has_float64(self) -> bool:
        return "cl_khr_fp64" in self.cl_device.extensions

    @property
    def identity(self) -> str:
        """A line that tells this device and driver from every other."""
        return f"{self.platform_version} | {self.name} | {self.cl_device.driver_version.strip()}"

    @property
    def shape(self) -> str:
        """What kernels are compiled for, beside the device itself."""
        how = "fma" if self.use_fma else "multiply-add"
        return f"VEC {self.vector_width}, LANES {self.lanes}, {how}"

    def describe(self) -> str:
        """One line for `ncv-cl devices` and for bug reports."""
        kind = "GPU" if self.is_gpu else "CPU" if self.is_cpu else "device"
        return (
            f"[{self.index}] {kind} {self.name} | {self.platform_name}: {self.platform_version} | "
            f"{self.cl_device.max_compute_units} compute units, native float{self.native_vector_width}, "
            f"{self.cl_device.local_mem_size // 1024} KiB local memory | "
            f"{self.shape}"
        )

    @property
    def problem(self) -> str | None:
        """Why the device cannot be used, and what to do instead; None where it can."""
        return _problem(self.cl_device)

    @property
    def native_vector_width(self) -> int:
        return max(1, self.cl_device.native_vector_width_float)


def first_error(error: Exception) -> str:
    """What a compiler complains of first, in one line; else the first line of the message."""
    said = re.search("error: .*", str(error))
    return said[0] if said else str(error).partition("\n")[0]


@once
def _problem(cl_device: cl.Device) -> str | None:
    """See `Device.problem`; compiles only for a device that has reason to fail."""
    if not _UNKNOWN_CPU.search(cl_device.version.strip()):
        return None
    try:
        cl.Program(_context(cl_device), "kernel void nothing(void) {}").build()
    except cl.Error as error:
        return (
            "cannot compile for this CPU, which its LLVM does not know yet "
            f"({first_error(error)}); {OTHER_RUNTIME_HINT}"
        )
    return None


def default_widths(cl_device: cl.Device) -> tuple[int, int]:
    """(VEC, LANES) for a device: whole vectors and one lane on CPUs, the reverse on GPUs."""
    if cl_device.type & cl.device_type.GPU:
        return 1, lanes_in_step(cl_device)
    native = min(cl_device.native_vector_width_float, widest_vectors(cl_device))
    return (16 if native >= 16 else 8 if native >= 8 else 4), 1


def lanes_in_step(cl_device: cl.Device) -> int:
    """How many work-items of a GPU run in step: a warp on NVIDIA, a wave of 32 or 64 on AMD.

    Asked of the device and not of a kernel, which would have to be compiled first. `GPU_LANES` where the
    device does not tell.
    """
    for name in ("warp_size_nv", "wavefront_width_amd", "preferred_work_group_size_multiple"):
        # Another vendor's question is an error, or one that the headers do not know.
        with suppress(cl.Error, AttributeError):
            lanes = int(getattr(cl_device, name))
            if lanes in (8, 16, 32, 64):
                return lanes
    return GPU_LANES


def pocl_version(cl_device: cl.Device) -> tuple[int, int] | None:
    """PoCL's version; None for other runtimes."""
    found = _POCL.search(cl_device.platform.version)
    return (int(found[1]), int(found[2])) if found else None


def prefers_fma(cl_device: cl.Device) -> bool:
    """Whether ``fma`` is at least as fast on a device as ``a * b + c`` that may be contracted.

    The two differ in the last bit, so the choice must not depend on a clock: it follows from the
    device's name and version. Measured: PoCL 3.0 calls a function for `fma`, at half the speed; PoCL 3.1
    and Intel's runtime make one instruction of either; GPU compilers contract by themselves.
    """
    version = pocl_version(cl_device)
    if version is None or cl_device.type & cl.device_type.GPU:
        return True
    return version >= (3, 1) and bool(cl_device.single_fp_config & cl.device_fp_config.FMA)


def widest_vectors(cl_device: cl.Device, item_bytes: int = 4) -> int:
    """The widest VEC, for numbers of this many bytes, that the device's compiler does not abort over."""
    claims_avx512 = cl_device.native_vector_width_float >= 16
    if claims_avx512 and _NO_AVX512.search(cl_device.version.strip()):
        return _AVX_BYTES // item_bytes
    return 16


@once
def open_device(
    cl_device: cl.Device,
    index: int = 0,
    vector_width: int | None = None,
    lanes: int | None = None,
    use_fma: bool | None = None,
) -> Device:
    """Open a device with a context and a queue; the last arguments override its default shape.

    Raises
    ------
    DeviceError
        If `vector_width` is wider than the device's compiler survives (`widest_vectors`).
    """
    widest = widest_vectors(cl_device)
    if vector_width is not None and vector_width > widest:
        raise DeviceError(
            f"{cl_device.name.strip()} ({cl_device.version.strip()}) cannot compile vectors of "
            f"{vector_width} floats; ask for at most {widest}"
        )
    default_vector_width, default_lanes = default_widths(cl_device)
    context = _context(cl_device)
    return Device(
        cl_device,
        index,
        vector_width or default_vector_width,
        lanes or default_lanes,
        prefers_fma(cl_device) if use_fma is None else use_fma,
        _memory(cl_device),
        context,
        cl.CommandQueue(context),
    )


@once
def _memory(cl_device: cl.Device) -> DeviceMemory:
    """One count for all that use the device, whatever their shape."""
    return DeviceMemory.of(cl_device)


@once
def _context(cl_device: cl.Device) -> cl.Context:
    return cl.Context([cl_device])


def list_cl_devices() -> list[cl.Device]:
    """Every OpenCL device of every platform, in the loader's order, usable or not.

    Raises
    ------
    DeviceError
        If there is no platform or no device; the message says what to install.
    """
    check_process()
    try:
        registered = platforms()
    except cl.Error as error:
        raise DeviceError(f"{INSTALL_HINT} (the OpenCL loader said: {error})") from error
    found: list[cl.Device] = []
    without: list[str] = []
    for platform in registered:
        # A driver without its hardware raises; the other runtimes are listed all the same.
        try:
            of_platform, said = platform.get_devices(), "none"
        except cl.Error as error:
            of_platform, said = [], str(error)
        found += of_platform
        if not of_platform:
            without.append(f"{platform.name.strip()}: {said}")
    if not found:
        raise DeviceError(
            f"{INSTALL_HINT} (devices of the runtimes that are there: {'; '.join(without)})"
        )
    # A runtime that is registered twice gives the same devices twice.
    return list(dict.fromkeys(found))
