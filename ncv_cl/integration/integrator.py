"""The exact integration of one network shape, on arrays that already lie on the device."""

from __future__ import annotations

import threading
from collections.abc import Sequence

import numpy as np
import pyopencl as cl

from ..opencl.device import GROUP_SIZE, Device, widest_vectors
from ..opencl.memory import HostArray
from ..opencl.program import device_defines
from .arrangement import robust_shape_constants, shape_constants, team_bytes
from .certificate import PRECISIONS, REASONS, Statistics, certificate_constants
from .stage import ROBUST_FILES, ArrangementStage, ClippingStage, Constants, Networks

INTEGRATION_METHODS = ("decoupled", "full")
# Layers that the kernels have arguments for, and the widest that tests of exactness go to.
MAX_HIDDEN_LAYERS = 4
MAX_WIDTH = 128
# Largest slope: steeper than any leaky relu, and a few layers of it stay in the range of single
# precision.
MOST_SLOPE = 1e4

# Below this a product of two differences is replaced, so that 0 / 0 and underflow cannot arise.
TINY = {"float32": "1e-37f", "float64": "1e-300"}
# Triangles that are summed before the sum is added, compensated, to the total.
TRIANGLES_A_SUM = 16
# Points of one launch at most, which bounds the list of points to be done again.
POINTS_A_LAUNCH = 1 << 20
# Bytes of all groups' workspaces at most: fewer groups where they would not fit.
SCRATCH_BYTES = 256 << 20
# Bytes of a work-item's private memory at most, where each has a point of its own. Drivers set that much
# aside for all work-items that a GPU can hold, some 2048 a compute unit: 16 MiB of each unit.
PRIVATE_BYTES = 8 << 10


class Integrator:
    """Integrates networks of one shape; parameters and results stay on the device.

    Every point is certified (`Statistics` lists the tests). One that fails is done again by arrangements
    in double precision, if the arrays are single and the device has double; then by cutting polygons.
    Calls of one object from several threads wait for each other.

    Parameters
    ----------
    device : Device
    widths : sequence of int
        (2, hidden widths..., channels): 0 to 4 hidden layers of 1 to 128 neurons.
    per_point_weights, per_point_biases : sequence of bool, or bool
        For each layer whether its array has a leading points axis.
    method : {"decoupled", "full"}
    precision : {"float32", "float64"}
        Type of all arrays, and of the arithmetic of certified points.
    negative_slope : float
        0 for relu, else leaky relu.
    write_moments : bool
        Also write the integrals of the last hidden layer's neurons.
    write_bounds : bool
        Also write a bound of the error of every integral.
    scratch_bytes : int
        Device memory for work-groups; fewer groups run where it is short.

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
        write_bounds: bool = False,
        scratch_bytes: int = SCRATCH_BYTES,
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
        # Rounded to the arrays' precision, so that a point has the same slope in every stage.
        self.negative_slope = float(self.dtype.type(negative_slope))
        self.write_moments = write_moments
        self.write_bounds = write_bounds
        self.per_point_weights = _one_each(per_point_weights, self.layers, "per_point_weights")
        self.per_point_biases = _one_each(per_point_biases, self.layers, "per_point_biases")
        self._scratch_bytes = scratch_bytes
        step = () if self.layers == 1 else (f"integrate_{method}",)
        self._files = (
            "common",
            "number",
            "dcel",
            "integrate_network",
            "integrate_check",
            *step,
            "integrate",
        )
        self._arrangement = ArrangementStage(
            device, self._files, self._constants(precision), scratch_bytes
        )
        self._again: ArrangementStage | None = None
        self._clipping: ClippingStage | None = None
        size = 4 * POINTS_A_LAUNCH
        self._lists = [cl.Buffer(device.context, cl.mem_flags.READ_WRITE, size=size)]
        self.scratch_bytes = self._arrangement.scratch_bytes + size
        self._lock = threading.Lock()

    def _constants(self, precision: str, *, for_single: bool = False) -> Constants:
        """The `-D` constants of arrangements in `precision`; `for_single`: of listed single points."""
        device = self.device
        vec = min(device.vector_width, widest_vectors(device.cl_device, PRECISIONS[precision].itemsize))
        # No wider than a layer: a small network's neurons would leave lanes idle.
        vec = min(vec, max(4, 1 << (max(self.widths[1:]) - 1).bit_length()))
        lone = not for_single and self._is_lone(vec, PRECISIONS[precision].itemsize)
        lanes = 1 if lone else device.lanes
        constants: Constants = shape_constants(self.widths, self.method, vec * lanes)
        constants |= certificate_constants(
            self.widths, precision, self.negative_slope, for_single=for_single
        )
        suffix = "f" if precision == "float32" else ""
        constants |= {
            "METHOD_FULL": int(self.method == "full"),
            "WRITE_MOMENTS": int(self.write_moments),
            "WRITE_BOUND": int(self.write_bounds),
            "LEAKY": int(self.negative_slope != 0),
            "NEGATIVE_SLOPE": f"{self.negative_slope!r}{suffix}",
            "DOUBLE": int(precision == "float64"),
            "SINGLE_ARRAYS": int(for_single),
            "LISTED": int(for_single),
            "VEC": vec,
            "LANES": lanes,
            "TINY": TINY[precision],
            "TRIANGLES_A_SUM": TRIANGLES_A_SUM,
            "SPACE": "__private" if lone else "__global",
            "TABLES": "__private" if lone else "__global",
            "WORK_IS_LOCAL": 0,
            "LONE": int(lone),
            "GROUP_ITEMS": GROUP_SIZE if lone else lanes,
        }
        for k in range(MAX_HIDDEN_LAYERS + 1):
            used = k < self.layers
            constants[f"PER_POINT_WEIGHTS_{k}"] = int(used and self.per_point_weights[k])
            constants[f"PER_POINT_BIASES_{k}"] = int(used and self.per_point_biases[k])
        return constants

    def _is_lone(self, vec: int, item_bytes: int) -> bool:
        """Whether each work-item of a GPU takes a point of its own, and not a group.

        So where half a group or more would have no neuron to work on, and only the leader a line to
        insert; and where the arrangement of a point is small enough for private memory.
        """
        if self.device.lanes == 1 or vec > 1 or 2 * max(self.widths[1:]) > self.device.lanes:
            return False
        alone = shape_constants(self.widths, self.method, 1)
        return team_bytes(alone, self.method, item_bytes) <= PRIVATE_BYTES

    def _robust_constants(self) -> Constants:
        """The `-D` constants of the clipping path, which is in double precision where there is one."""
        constants = self._constants(self.precision) | robust_shape_constants(self.widths)
        tolerance = str(constants["AREA_TOLERANCE"])
        in_double = self.device.has_float64
        return constants | {
            "ROBUST_DOUBLE": int(in_double),
            "ROBUST_AREA_TOLERANCE": tolerance.rstrip("f") if in_double else tolerance,
        }

    def run(
        self,
        weights: Sequence[HostArray],
        biases: Sequence[HostArray],
        out: HostArray,
        begin: int = 0,
        end: int | None = None,
        moments: HostArray | None = None,
        bounds: HostArray | None = None,
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
        bounds : HostArray, optional
            (points, channels), needed with `write_bounds`.

        Raises
        ------
        ValueError
            Arrays of another shape or type, or a range outside of them.
        CutShortError
            A DeviceError: the device's runtime did not finish all points.
        """
        self._check_arrays(weights, biases, out, moments, bounds)
        end = out.shape[0] if end is None else end
        if not 0 <= begin <= end <= out.shape[0]:
            raise ValueError(f"range [{begin}, {end}) is not within the {out.shape[0]} points of out")
        networks = Networks.of(weights, biases, G=out, moments=moments, bounds=bounds)
        statistics = Statistics(scratch_bytes=self.scratch_bytes)
        with self._lock:
            for first in range(begin, end, POINTS_A_LAUNCH):
                statistics += self._launch(first, min(end, first + POINTS_A_LAUNCH), networks)
        return statistics

    def _launch(self, begin: int, end: int, networks: Networks) -> Statistics:
        """Run one launch, then the points that it did not certify once more."""
        counted = self._arrangement.run(begin, end, networks, self._lists[0])
        found = Statistics(
            points=end - begin,
            faces=counted["faces"],
            scratch_bytes=self.scratch_bytes,
            uncertified=(),
            **{reason: counted[reason] for reason in REASONS},
        )
        count = counted["retry"]
        return found + self._do_again(count, networks) if count else found

    def _do_again(self, count: int, networks: Networks) -> Statistics:
        """Do the first `count` points of the list again, by the next stages."""
        context, flags = self.device.context, cl.mem_flags.READ_WRITE
        if len(self._lists) == 1:
            self._lists.append(cl.Buffer(context, flags, size=4 * POINTS_A_LAUNCH))
        points, failed = self._lists
        done = 0
        if self.precision == "float32" and self.device.has_float64:
            left = self._in_double().run(0, count, networks, failed, points)["retry"]
            done, count = count - left, left
            points, failed = failed, points
        clipped = count if self.layers > 1 else 0
        if clipped:
            # Without hidden layers there is nothing to cut; the only cause is a value that is not
            # finite.
            count = self._by_clipping().run(count, networks, failed, points)
            points = failed
        return Statistics(
            float64_points=done,
            clipped_points=clipped,
            uncertified=tuple(sorted(self._first_of(points, count))),
        )

    def _in_double(self) -> ArrangementStage:
        """The stage in double precision, built when the first point needs it; most calls never do."""
        if self._again is None:
            constants = self._constants("float64", for_single=True)
            self._again = ArrangementStage(self.device, self._files, constants, self._scratch_bytes)
        return self._again

    def _by_clipping(self) -> ClippingStage:
        """Built when the first point needs it."""
        if self._clipping is None:
            self._clipping = ClippingStage(self.device, self._robust_constants(), SCRATCH_BYTES)
        return self._clipping

    def _first_of(self, points: cl.Buffer, count: int) -> list[int]:
        """The first `count` numbers of a list on the device."""
        found = np.empty(count, np.int32)
        if count:
            cl.enqueue_copy(self.device.queue, found, points)
        return found.tolist()

    def programs(self) -> list[tuple[tuple[str, ...], Constants]]:
        """Files and `-D` constants of every program this object may build, the first one's first."""
        defines: Constants = dict(device_defines(self.device))
        programs = [(self._files, defines | self._arrangement.constants)]
        if self.precision == "float32" and self.device.has_float64:
            programs.append((self._files, defines | self._constants("float64", for_single=True)))
        if self.layers > 1:
            programs.append((ROBUST_FILES, defines | self._robust_constants()))
        return programs

    @property
    def has_a_point_a_work_item(self) -> bool:
        """Whether work-items do not share points (GPUs, small networks)."""
        return bool(self._arrangement.constants["LONE"])

    @property
    def workspace_is_local(self) -> bool:
        """Whether the arrangements lie in local memory (GPUs, where they fit)."""
        return bool(self._arrangement.constants["WORK_IS_LOCAL"])

    def _check_arrays(
        self,
        weights: Sequence[HostArray],
        biases: Sequence[HostArray],
        out: HostArray,
        moments: HostArray | None,
        bounds: HostArray | None,
    ) -> None:
        if len(weights) != self.layers or len(biases) != self.layers:
            raise ValueError(
                f"widths {self.widths} need {self.layers} weights and biases, "
                f"got {len(weights)} and {len(biases)}"
            )
        points = out.shape[0]
        expected: list[tuple[str, HostArray, tuple[int, ...]]]
        expected = [("out", out, (points, self.widths[-1]))]
        for k in range(self.layers):
            matrix = (self.widths[k + 1], self.widths[k])
            leading = (points,) if self.per_point_weights[k] else ()
            expected.append((f"weights[{k}]", weights[k], leading + matrix))
            leading = (points,) if self.per_point_biases[k] else ()
            expected.append((f"biases[{k}]", biases[k], leading + matrix[:1]))
        for name, array, wanted, columns in (
            ("moments", moments, self.write_moments, self.widths[-2]),
            ("bounds", bounds, self.write_bounds, self.widths[-1]),
        ):
            if wanted != (array is not None):
                raise ValueError(
                    f"write_{name} is {wanted}, so `{name}` must be {'given' if wanted else 'None'}"
                )
            if array is not None:
                expected.append((name, array, (points, columns)))
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
    if method not in INTEGRATION_METHODS:
        raise ValueError(f"method must be one of {INTEGRATION_METHODS}, is {method!r}")
    if precision not in PRECISIONS:
        raise ValueError(f"precision must be one of {tuple(PRECISIONS)}, is {precision!r}")
    if precision == "float64" and not device.has_float64:
        raise ValueError(f"{device.name} has no double precision: use precision='float32'")
    if not abs(negative_slope) <= MOST_SLOPE:
        raise ValueError(
            f"negative_slope must be between -{MOST_SLOPE:g} and {MOST_SLOPE:g}, is {negative_slope}"
        )


def _one_each(flags: Sequence[bool] | bool, layers: int, name: str) -> tuple[bool, ...]:
    if isinstance(flags, bool):
        return (flags,) * layers
    if len(flags) != layers:
        raise ValueError(f"{name} needs one flag a layer ({layers}), got {len(flags)}")
    return tuple(bool(flag) for flag in flags)
