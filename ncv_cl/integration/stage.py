"""The kernels of exact integration: stages that integrate points and list those they do not certify."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pyopencl as cl

from ..opencl.device import GPU_LOCAL_BYTES, GROUPS_PER_COMPUTE_UNIT, Device, DeviceError
from ..opencl.memory import HostArray
from ..opencl.program import Program, build
from .certificate import COUNTERS

# A group pops so many points at most from the queue at once.
MOST_POPPED = 16
ROBUST_FILES = ("common", "number", "integrate_robust")

Constants = dict[str, int | str]


@dataclass(frozen=True)
class Networks:
    """What every stage reads and writes, as the kernels call it.

    Attributes
    ----------
    parameters : dict of HostArray
        weights_0 and biases_0 of the first layer, weights_1, ...
    outputs : dict of HostArray
        G, moments and bounds: those that are written.
    """

    parameters: dict[str, HostArray]
    outputs: dict[str, HostArray]

    @classmethod
    def of(
        cls, weights: Sequence[HostArray], biases: Sequence[HostArray], **outputs: HostArray | None
    ) -> Networks:
        """Networks of these layers; outputs that are None are not written."""
        return cls(
            layer_arguments(weights, biases),
            {name: array for name, array in outputs.items() if array is not None},
        )


def layer_arguments(weights: Sequence[HostArray], biases: Sequence[HostArray]) -> dict[str, HostArray]:
    """Layers by the names that number.cl gives them."""
    named = {"weights": weights, "biases": biases}
    return {f"{name}_{k}": array for name, arrays in named.items() for k, array in enumerate(arrays)}


class _Counters:
    """The counters of one launch at a time."""

    def __init__(self, device: Device) -> None:
        self.device = device
        self.array = HostArray(device, len(COUNTERS), np.int32)

    def read(self, points: int) -> dict[str, int]:
        """What a launch over `points` points counted.

        Raises
        ------
        DeviceError
            Not all points were integrated: the runtime cut a kernel short.
        """
        counted = dict(zip(COUNTERS, self.array.read().tolist(), strict=True))
        if counted["finished"] != points:
            name = f"{self.device.name} ({self.device.platform_version})"
            raise DeviceError(
                f"{name} integrated {counted['finished']} of {points} points: its runtime cut the "
                "kernel short. Choose another device"
            )
        return counted


class ArrangementStage:
    """Integrates by arrangements of lines.

    Parameters
    ----------
    device : Device
    files : tuple of str
        Kernel files.
    constants : dict
        The `-D` constants; `LISTED` says whether points come from a list.
    scratch_bytes : int
        Device memory for work-groups; fewer groups run where it is short.

    Attributes
    ----------
    constants : dict
        With where the workspace lies.
    scratch_bytes : int
        Device memory that the stage holds.

    Raises
    ------
    MemoryError
        One work-group needs more than `scratch_bytes` or than the device has.
    """

    def __init__(
        self, device: Device, files: tuple[str, ...], constants: Constants, scratch_bytes: int
    ) -> None:
        self.device = device
        program = build(device, files, constants)
        work_bytes, table_bytes = memory_of(program, "integrate_memory")
        # A workspace beyond it goes to global memory.
        local_bytes = min(GPU_LOCAL_BYTES, device.cl_device.local_mem_size)
        if device.lanes > 1 and work_bytes + 64 <= local_bytes:
            constants = constants | {"SPACE": "__local", "WORK_IS_LOCAL": 1}
            program = build(device, files, constants)
            work_bytes = 0
        self.constants = constants
        self._kernel = program.kernel("integrate")
        group_bytes = work_bytes + table_bytes
        available = min(scratch_bytes, device.cl_device.max_mem_alloc_size)
        if group_bytes > available:
            raise MemoryError(
                f"one work-group needs {group_bytes} bytes for layers of {constants['WIDTHS']} numbers, "
                f"but only {available} are available on {device.name}: raise scratch_bytes, or use a "
                "narrower network"
            )
        units = device.cl_device.max_compute_units
        wanted = units if device.lanes == 1 else units * GROUPS_PER_COMPUTE_UNIT
        self.groups = max(1, min(wanted, available // group_bytes))
        flags = cl.mem_flags.READ_WRITE
        self._work = cl.Buffer(device.context, flags, size=max(64, self.groups * work_bytes))
        self._tables = cl.Buffer(device.context, flags, size=self.groups * table_bytes)
        self._counters = _Counters(device)
        self._faces = HostArray(device, self.groups, np.uint64)
        self.scratch_bytes = self.groups * group_bytes

    def run(
        self,
        begin: int,
        end: int,
        networks: Networks,
        retry: cl.Buffer,
        points: cl.Buffer | None = None,
    ) -> dict[str, int]:
        """Integrate points [begin, end), or those at [begin, end) of a list.

        Returns
        -------
        dict
            `COUNTERS`, and ``faces`` of all points. The first ``retry`` numbers of `retry` are the
            points to be done again.
        """
        groups = min(self.groups, end - begin)
        run = max(1, min(MOST_POPPED, (end - begin) // (groups * 16)))
        self._counters.array.fill(0)
        self._faces.fill(0)
        self._kernel(
            groups * self.device.lanes,
            begin=begin,
            end=end,
            run=run,
            counters=self._counters.array,
            **({} if points is None else {"list": points}),
            retry=retry,
            group_faces=self._faces,
            **networks.outputs,
            all_work=self._work,
            all_tables=self._tables,
            **networks.parameters,
            group=self.device.lanes,
        )
        counted = self._counters.read(end - begin)
        return counted | {"faces": int(self._faces.read().sum())}


class ClippingStage:
    """Integrates by cutting polygons, one work-item a point: slow, but no arrangement can fail.

    Parameters
    ----------
    device : Device
    constants : dict
        The `-D` constants.
    scratch_bytes : int
    """

    def __init__(self, device: Device, constants: Constants, scratch_bytes: int) -> None:
        program = build(device, ROBUST_FILES, constants)
        table_bytes = memory_of(program, "robust_memory")[0]
        self.groups = max(1, min(device.cl_device.max_compute_units, scratch_bytes // table_bytes))
        size = self.groups * table_bytes
        self._tables = cl.Buffer(device.context, cl.mem_flags.READ_WRITE, size=size)
        self._kernel = program.kernel("integrate_robust")
        self._counters = _Counters(device)

    def run(self, count: int, networks: Networks, failed: cl.Buffer, points: cl.Buffer) -> int:
        """Integrate the first `count` points of a list; returns how many `failed` lists."""
        self._counters.array.fill(0)
        self._kernel(
            min(self.groups, count),
            count=count,
            counters=self._counters.array,
            list=points,
            failed=failed,
            **networks.outputs,
            all_work=self._tables,
            **networks.parameters,
            group=1,
        )
        return self._counters.read(count)["retry"]


def memory_of(program: Program, kernel: str) -> tuple[int, ...]:
    """Bytes of what a group keeps in memory, from the kernels' own sizeof."""
    sizes = HostArray(program.device, 2, np.int32)
    sizes.fill(0)
    program.kernel(kernel)(1, bytes=sizes, group=1)
    return tuple(sizes.read().tolist())
