"""The exact integration of one network shape, on arrays that already lie on the device."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pyopencl as cl

from .arrangement import robust_shape_constants, shape_constants
from .device import Device, HostArray, widest_vectors
from .program import Kernel, Program, build, device_defines

METHODS = ("decoupled", "full")
PRECISIONS = {"float32": np.dtype(np.float32), "float64": np.dtype(np.float64)}
MAX_HIDDEN_LAYERS = 4
MAX_WIDTH = 128

# |sum of absolute areas - 1| beyond which a point is done again on the robust path.
AREA_TOLERANCE = {"float32": 1e-5, "float64": 1e-12}
# Below this a product of two differences is replaced, so that 0 / 0 and underflow cannot arise.
TINY = {"float32": "1e-37f", "float64": "1e-300"}
# Triangles that are summed before the sum is added, compensated, to the total.
TRIANGLES_A_SUM = 16
# Groups on a GPU: enough to hide latencies, few enough to keep their tables in the cache.
GROUPS_PER_COMPUTE_UNIT = 8
# One launch; bounds the list of points to be done again.
POINTS_A_LAUNCH = 1 << 20
# A group pops so many points at most from the queue at once.
LONGEST_RUN = 16
# Local memory every GPU has; a workspace beyond it goes to global memory.
LOCAL_BYTES = 48 * 1024
SCRATCH_BYTES = 256 << 20
ROBUST_FILES = ("common", "number", "integrate_robust")


@dataclass(frozen=True)
class Statistics:
    """What a call did.

    Attributes
    ----------
    points : int
        Networks integrated.
    faces : int
        Faces of the last arrangements, over all points: of the last hidden layer but one for
        ``decoupled``, of the last one for ``full``.
    robust_points : int
        Points whose faces did not add up to the unit square and that were done again on the robust path.
    uncertified_points : int
        Points that failed there as well: their value is not finite in this precision.
    scratch_bytes : int
        Device memory held for work-groups and lists; it does not grow with the number of points.
    """

    points: int = 0
    faces: int = 0
    robust_points: int = 0
    uncertified_points: int = 0
    scratch_bytes: int = 0

    def __add__(self, other: Statistics) -> Statistics:
        return Statistics(
            self.points + other.points,
            self.faces + other.faces,
            self.robust_points + other.robust_points,
            self.uncertified_points + other.uncertified_points,
            max(self.scratch_bytes, other.scratch_bytes),
        )


@dataclass(frozen=True)
class _Robust:
    kernel: Kernel
    groups: int
    tables: cl.Buffer


class Integrator:
    """Integrates networks of one shape; parameters and results stay on the device.

    Parameters
    ----------
    device : Device
    widths : sequence of int
        (2, hidden widths..., channels): 0 to 4 hidden layers of 1 to 128 neurons.
    per_point_weights, per_point_biases : sequence of bool, or bool
        For each layer whether its array has a leading points axis.
    method : {"decoupled", "full"}
    precision : {"float32", "float64"}
        Type of all arrays and of the arithmetic.
    negative_slope : float
        0 for relu, else leaky relu.
    write_moments : bool
        Also write the integrals of the last hidden layer's neurons.
    scratch_bytes : int
        Device memory for work-groups; fewer groups run where it is short.
    area_tolerance : float, optional
        Certification: largest accepted deviation of the faces' total area from 1.

    Raises
    ------
    ValueError
        A shape, method or precision that is not supported; the message says which.
    MemoryError
        One work-group needs more than `scratch_bytes` or than the device has.
    """

    def __init__(
        self,
        device: Device,
        widths: Sequence[int],
        per_point_weights: Sequence[bool] | bool = False,
        per_point_biases: Sequence[bool] | bool = False,
        *,
        method: str = "decoupled",
        precision: str = "float32",
        negative_slope: float = 0.0,
        write_moments: bool = False,
        scratch_bytes: int = SCRATCH_BYTES,
        area_tolerance: float | None = None,
    ) -> None:
        self.device = device
        self.widths = tuple(int(width) for width in widths)
        self.layers = len(self.widths) - 1
        _check_shape(self.widths)
        check_options(method, precision, negative_slope, device)
        if write_moments and self.layers == 1:
            raise ValueError("a network without hidden layers has no moments")
        self.method = method
        self.precision = precision
        self.dtype = PRECISIONS[precision]
        self.write_moments = write_moments
        self.per_point_weights = _one_each(per_point_weights, self.layers, "per_point_weights")
        self.per_point_biases = _one_each(per_point_biases, self.layers, "per_point_biases")
        self._defines = self._constants(negative_slope, area_tolerance)
        self._files = self._kernel_files()
        self._allocate(scratch_bytes)
        self._robust: _Robust | None = None

    def _kernel_files(self) -> tuple[str, ...]:
        step = () if self.layers == 1 else (f"integrate_{self.method}",)
        return ("common", "number", "dcel", "integrate_network", *step, "integrate")

    def _constants(self, negative_slope: float, area_tolerance: float | None) -> dict[str, int | str]:
        """The `-D` constants of the kernels."""
        device = self.device
        suffix = "f" if self.precision == "float32" else ""
        tolerance = AREA_TOLERANCE[self.precision] if area_tolerance is None else area_tolerance
        constants = shape_constants(self.widths, self.method, device.vector_width * device.lanes)
        constants |= {
            "METHOD_FULL": int(self.method == "full"),
            "WRITE_MOMENTS": int(self.write_moments),
            "LEAKY": int(negative_slope != 0),
            "NEGATIVE_SLOPE": f"{float(negative_slope)!r}{suffix}",
            "DOUBLE": int(self.precision == "float64"),
            "VEC": min(device.vector_width, widest_vectors(device.cl_device, self.dtype.itemsize)),
            "AREA_TOLERANCE": f"{float(tolerance)!r}{suffix}",
            "TINY": TINY[self.precision],
            "TRIANGLES_A_SUM": TRIANGLES_A_SUM,
            "SPACE": "__global",
            "WORK_IS_LOCAL": 0,
        }
        for k in range(MAX_HIDDEN_LAYERS + 1):
            used = k < self.layers
            constants[f"PER_POINT_WEIGHTS_{k}"] = int(used and self.per_point_weights[k])
            constants[f"PER_POINT_BIASES_{k}"] = int(used and self.per_point_biases[k])
        return constants

    def _allocate(self, scratch_bytes: int) -> None:
        device = self.device
        program = build(device, self._files, self._defines)
        work_bytes, table_bytes = _memory(program, "integrate_memory")
        local_bytes = min(LOCAL_BYTES, device.cl_device.local_mem_size)
        if device.lanes > 1 and work_bytes + 64 <= local_bytes:
            self._defines |= {"SPACE": "__local", "WORK_IS_LOCAL": 1}
            program = build(device, self._files, self._defines)
            work_bytes = 0
        self._kernel = program.kernel("integrate")
        group_bytes = work_bytes + table_bytes
        available = min(scratch_bytes, device.cl_device.max_mem_alloc_size)
        if group_bytes > available:
            raise MemoryError(
                f"one work-group needs {group_bytes} bytes for widths {self.widths} and method "
                f"{self.method!r}, but only {available} are available on {device.name}: raise "
                "scratch_bytes, or use a narrower network"
            )
        units = device.cl_device.max_compute_units
        wanted = units if device.lanes == 1 else units * GROUPS_PER_COMPUTE_UNIT
        self.groups = max(1, min(wanted, available // group_bytes))
        flags = cl.mem_flags.READ_WRITE
        self._work = cl.Buffer(device.context, flags, size=max(64, self.groups * work_bytes))
        self._tables = cl.Buffer(device.context, flags, size=self.groups * table_bytes)
        self._retry = cl.Buffer(device.context, flags, size=4 * POINTS_A_LAUNCH)
        self._counters = HostArray(device, 2, np.int32)
        self._faces = HostArray(device, self.groups, np.uint64)
        self.scratch_bytes = self.groups * group_bytes + 4 * POINTS_A_LAUNCH

    def run(
        self,
        weights: Sequence[HostArray],
        biases: Sequence[HostArray],
        out: HostArray,
        begin: int = 0,
        end: int | None = None,
        moments: HostArray | None = None,
    ) -> Statistics:
        """Integrate the networks of points [begin, end).

        A point's result has the same bits whatever range it is computed in.

        Parameters
        ----------
        weights : sequence of HostArray
            weights[k] is (n_out, n_in), or (points, n_out, n_in) where `per_point_weights[k]`.
        biases : sequence of HostArray
            biases[k] is (n_out,), or (points, n_out) where `per_point_biases[k]`.
        out : HostArray
            (points, channels); rows [begin, end) are written.
        begin, end : int
            `end` defaults to the number of rows of `out`.
        moments : HostArray, optional
            (points, last hidden width), needed with `write_moments`.
        """
        self._check_arrays(weights, biases, out, moments)
        end = out.shape[0] if end is None else end
        if not 0 <= begin <= end <= out.shape[0]:
            raise ValueError(f"range [{begin}, {end}) is not within the {out.shape[0]} points of out")
        statistics = Statistics(scratch_bytes=self.scratch_bytes)
        for first in range(begin, end, POINTS_A_LAUNCH):
            last = min(end, first + POINTS_A_LAUNCH)
            statistics += self._launch(weights, biases, out, first, last, moments)
        return statistics

    def _launch(
        self,
        weights: Sequence[HostArray],
        biases: Sequence[HostArray],
        out: HostArray,
        begin: int,
        end: int,
        moments: HostArray | None,
    ) -> Statistics:
        groups = min(self.groups, end - begin)
        run = max(1, min(LONGEST_RUN, (end - begin) // (groups * 16)))
        self._counters.fill(0)
        self._faces.fill(0)
        parameters = [array for pair in zip(weights, biases, strict=True) for array in pair]
        written = [moments] if self.write_moments else []
        self._kernel(
            groups * self.device.lanes,
            begin,
            end,
            run,
            self._counters,
            self._retry,
            self._faces,
            out,
            *written,
            self._work,
            self._tables,
            *parameters,
            group=self.device.lanes,
        )
        failed = int(self._counters.read()[1])
        return Statistics(
            points=end - begin,
            faces=int(self._faces.read().sum()),
            robust_points=failed,
            uncertified_points=self._redo(failed, parameters, [out, *written]) if failed else 0,
        )

    def _redo(self, count: int, parameters: list[HostArray], outputs: list[HostArray]) -> int:
        """Do the first `count` points of the retry list on the robust path; returns how many fail."""
        if self.layers == 1:
            # Without hidden layers there is nothing to cut: the value itself is not finite.
            return count
        robust = self._robust or self._build_robust()
        self._counters.fill(0)
        robust.kernel(
            min(robust.groups, count),
            count,
            self._counters,
            self._retry,
            *outputs,
            robust.tables,
            *parameters,
            group=1,
        )
        return int(self._counters.read()[1])

    def _build_robust(self) -> _Robust:
        """Built when the first point needs it, which most calls never do."""
        program = build(self.device, ROBUST_FILES, self._robust_constants())
        table_bytes = _memory(program, "robust_memory")[0]
        groups = max(1, min(self.device.cl_device.max_compute_units, SCRATCH_BYTES // table_bytes))
        tables = cl.Buffer(self.device.context, cl.mem_flags.READ_WRITE, size=groups * table_bytes)
        self._robust = _Robust(program.kernel("integrate_robust"), groups, tables)
        return self._robust

    def _robust_constants(self) -> dict[str, int | str]:
        in_double = self.device.has_float64
        tolerance = repr(AREA_TOLERANCE[self.precision])
        constants = self._defines | robust_shape_constants(self.widths)
        return constants | {
            "ROBUST_DOUBLE": int(in_double),
            "ROBUST_AREA_TOLERANCE": tolerance if in_double else tolerance + "f",
        }

    def programs(self) -> list[tuple[tuple[str, ...], dict[str, int | str]]]:
        """Files and `-D` constants of every program this object may build."""
        defines = device_defines(self.device) | self._defines
        programs = [(self._files, defines)]
        if self.layers > 1:
            programs.append((ROBUST_FILES, device_defines(self.device) | self._robust_constants()))
        return programs

    @property
    def workspace_is_local(self) -> bool:
        """Whether the arrangements lie in local memory (GPUs, where they fit)."""
        return bool(self._defines["WORK_IS_LOCAL"])

    def _check_arrays(
        self,
        weights: Sequence[HostArray],
        biases: Sequence[HostArray],
        out: HostArray,
        moments: HostArray | None,
    ) -> None:
        if len(weights) != self.layers or len(biases) != self.layers:
            raise ValueError(
                f"widths {self.widths} need {self.layers} weights and biases, "
                f"got {len(weights)} and {len(biases)}"
            )
        points = out.shape[0]
        expected = [("out", out, (points, self.widths[-1]))]
        for k in range(self.layers):
            matrix = (self.widths[k + 1], self.widths[k])
            leading = (points,) if self.per_point_weights[k] else ()
            expected.append((f"weights[{k}]", weights[k], leading + matrix))
            leading = (points,) if self.per_point_biases[k] else ()
            expected.append((f"biases[{k}]", biases[k], leading + matrix[:1]))
        if self.write_moments:
            if moments is None:
                raise ValueError("write_moments needs an array for the moments")
            expected.append(("moments", moments, (points, self.widths[-2])))
        for name, array, shape in expected:
            if array.shape != shape or array.dtype != self.dtype:
                raise ValueError(
                    f"{name} must be {self.dtype} of shape {shape}, "
                    f"is {array.dtype} of shape {array.shape}"
                )


def _check_shape(widths: tuple[int, ...]) -> None:
    if len(widths) < 2 or widths[0] != 2:
        raise ValueError(f"widths are (2, hidden widths..., channels), got {widths}")
    if len(widths) - 2 > MAX_HIDDEN_LAYERS:
        raise ValueError(f"at most {MAX_HIDDEN_LAYERS} hidden layers, got {len(widths) - 2}")
    if any(not 1 <= width <= MAX_WIDTH for width in widths[1:-1]):
        raise ValueError(f"hidden widths must be 1 to {MAX_WIDTH}, got {widths[1:-1]}")
    if widths[-1] < 1:
        raise ValueError(f"a network needs at least one output, got {widths[-1]}")


def check_options(method: str, precision: str, negative_slope: float, device: Device) -> None:
    if method not in METHODS:
        raise ValueError(f"method must be one of {METHODS}, is {method!r}")
    if precision not in PRECISIONS:
        raise ValueError(f"precision must be one of {tuple(PRECISIONS)}, is {precision!r}")
    if precision == "float64" and not device.has_float64:
        raise ValueError(f"{device.name} has no double precision: use precision='float32'")
    if not np.isfinite(negative_slope):
        raise ValueError(f"negative_slope must be finite, is {negative_slope}")


def _one_each(flags: Sequence[bool] | bool, layers: int, name: str) -> tuple[bool, ...]:
    if isinstance(flags, bool):
        return (flags,) * layers
    if len(flags) != layers:
        raise ValueError(f"{name} needs one flag a layer ({layers}), got {len(flags)}")
    return tuple(bool(flag) for flag in flags)


def _memory(program: Program, kernel: str) -> list[int]:
    """Bytes of what a group keeps in memory, from the kernels' own sizeof."""
    sizes = HostArray(program.device, 2, np.int32)
    sizes.fill(0)
    program.kernel(kernel)(1, sizes, group=1)
    return sizes.read().tolist()
