"""The kernels of exact integration: stages that integrate points and list those they do not certify."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pyopencl as cl

from ..opencl.device import GPU_LOCAL_BYTES, GROUPS_PER_COMPUTE_UNIT, CutShortError, Device
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

    def read(self, points: int, teams: int) -> dict[str, int]:
        """What a launch of `teams` teams over `points` points counted.

        Raises
        ------
        CutShortError
            Not all points were integrated, or a team did not come to the end of the queue: the point
            that it had in hand may be wrong.
        """
        counted = dict(zip(COUNTERS, self.array.read().tolist(), strict=True))
        if (counted["finished"], counted["teams"]) != (points, teams):
            raise CutShortError.of(
                self.device,
                f"integrated {counted['finished']} of {points} points, and {counted['teams']} of "
                f"{teams} work-groups found none left",
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
        if constants["LONE"]:
            work_bytes = table_bytes = 0
        elif device.lanes > 1 and work_bytes + 64 <= local_bytes:
            constants = constants | {"SPACE": "__local", "WORK_IS_LOCAL": 1}
            program = build(device, files, constants)
            work_bytes = 0
        self.constants = constants
        self._kernel = program.kernel("integrate")
        self._group = int(constants["GROUP_ITEMS"])
        # Each integrates one point at a time.
        self._group_teams = self._group // int(constants["LANES"])
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
        self.groups = max(1, min(wanted, available // max(1, group_bytes)))
        flags = cl.mem_flags.READ_WRITE
        self._work = cl.Buffer(device.context, flags, size=max(64, self.groups * work_bytes))
        self._tables = cl.Buffer(device.context, flags, size=max(64, self.groups * table_bytes))
        self._counters = _Counters(device)
        self._faces = HostArray(device, self.groups * self._group_teams, np.uint64)
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
        groups = min(self.groups, -(-(end - begin) // self._group_teams))
        teams = groups * self._group_teams
        run = max(1, min(MOST_POPPED, (end - begin) // (teams * 16)))
        self._counters.array.fill(0)
        self._faces.fill(0)
        self._kernel(
            groups * self._group,
            begin=begin,
            end=end,
            run=run,
            counters=self._counters.array,
            **({} if points is None else {"list": points}),
            retry=retry,
            team_faces=self._faces,
            **networks.outputs,
            all_work=self._work,
            all_tables=self._tables,
            **networks.parameters,
            group=self._group,
        )
        counted = self._counters.read(end - begin, teams)
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
        groups = min(self.groups, count)
        self._kernel(
            groups,
            count=count,
            counters=self._counters.array,
            list=points,
            failed=failed,
            **networks.outputs,
            all_work=self._tables,
            **networks.parameters,
            group=1,
        )
        return self._counters.read(count, groups)["retry"]


def memory_of(program: Program, kernel: str) -> tuple[int, ...]:
    """Bytes of what a group keeps in memory, from the kernels' own sizeof."""
    sizes = HostArray(program.device, 2, np.int32)
    sizes.fill(0)
    program.kernel(kernel)(1, bytes=sizes, group=1)
    return tuple(sizes.read().tolist())
