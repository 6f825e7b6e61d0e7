"""Kernels that take their arguments by name, as their own signatures have them."""

from __future__ import annotations

import numbers
import re
import threading
from typing import Any, TypeAlias

import numpy as np
import pyopencl as cl

from .device import GROUP_SIZE, Device
from .memory import HostArray

_TYPES = {
    "char": np.int8,
    "uchar": np.uint8,
    "int": np.int32,
    "uint": np.uint32,
    "long": np.int64,
    "ulong": np.uint64,
    "float": np.float32,
    "double": np.float64,
}
# Arguments of a kernel by name, numbers and arrays mixed: a call checks them by the kernel's signature.
Arguments: TypeAlias = dict[str, Any]
# What is passed for a pointer to a type that the program defines: the kernel alone knows what it is.
_ANY = object()


class Kernel:
    """A kernel with the names and types of its arguments, taken from its own signature.

    Threads may share one: OpenCL kernels hold their arguments, so a call sets them and enqueues under a
    lock. `bind` and `repeat` are two calls, for a kernel that nobody else has (`Program.own_kernel`).

    Attributes
    ----------
    name : str
    arguments : tuple of str
        Names of the arguments, in the signature's order.

    Raises
    ------
    TypeError
        If an argument is called `group`, as what a call says of work-groups is.
    """

    def __init__(self, device: Device, kernel: cl.Kernel) -> None:
        self.device = device
        self.name = kernel.function_name
        info = cl.kernel_arg_info
        scalars: list[type | None] = []
        # Of each argument its name, and the class of a scalar (int, float) or what an array holds.
        self._signature: list[tuple[str, Any]] = []
        self._type_names: dict[str, str] = {}
        for position in range(kernel.num_args):
            type_name = str(kernel.get_arg_info(position, info.TYPE_NAME)).strip("\0 ")
            name = str(kernel.get_arg_info(position, info.NAME)).strip("\0 ")
            self._type_names[name] = type_name
            if type_name.endswith("*"):
                scalars.append(None)
                self._signature.append((name, _pointed_at(type_name)))
            else:
                scalar = _TYPES[type_name]
                scalars.append(scalar)
                self._signature.append((name, float if issubclass(scalar, np.floating) else int))
        self.arguments = tuple(self._type_names)
        if "group" in self.arguments:
            raise TypeError(f"{self.name}: an argument cannot be called group, give it another name")
        kernel.set_scalar_arg_dtypes(scalars)
        self._kernel = kernel
        self._lock = threading.Lock()

    def __call__(
        self,
        work_items: int | tuple[int, ...],
        /,
        *,
        group: int | tuple[int, ...] = GROUP_SIZE,
        **arguments: Any,
    ) -> cl.Event | None:
        """Enqueue over at least `work_items`, rounded up to whole groups (kernels guard the tail).

        Parameters
        ----------
        work_items, group : int or tuple of int
            Work-items in all and in a group, along each axis.
        arguments
            What the signature names: numbers for scalars, a `HostArray` of the pointer's type or a plain
            buffer for pointers.

        Raises
        ------
        TypeError
            If an argument is missing, unknown or of another type, naming kernel and argument.
        """
        plain = self._in_order(arguments)
        sizes = (work_items,) if isinstance(work_items, int) else work_items
        groups = (group,) if isinstance(group, int) else group
        rounded = tuple(-(-size // one) * one for size, one in zip(sizes, groups, strict=True))
        if 0 in rounded:
            return None
        with self._lock:
            return self._kernel(self.device.queue, rounded, groups, *plain)

    def bind(self, **arguments: Any) -> None:
        """Set all arguments, as those of a call, for `repeat`."""
        self._kernel.set_args(*self._in_order(arguments))

    def repeat(self, number: int, work_items: int, group: int = GROUP_SIZE) -> None:
        """Enqueue with the arguments that `bind` set: for kernels that run for microseconds only.

        All that differs is `number`, in which the kernel can look up the rest: it is what
        ``get_global_offset(0) / get_local_size(0)`` yields.
        """
        rounded = -(-work_items // group) * group
        cl.enqueue_nd_range_kernel(
            self.device.queue, self._kernel, (rounded,), (group,), (number * group,)
        )

    def _in_order(self, arguments: dict[str, Any]) -> list[Any]:
        """What pyopencl takes, checked; the common cases at the cost of a comparison or two each."""
        if len(arguments) != len(self._signature):
            raise self._misnamed(arguments)
        plain = []
        try:
            for name, expected in self._signature:
                value = arguments[name]
                kind = value.__class__
                if kind is HostArray and value.dtype is expected:
                    plain.append(value.buffer)
                elif kind is expected:
                    plain.append(value)
                else:
                    plain.append(self._checked(name, expected, value))
        except KeyError:
            raise self._misnamed(arguments) from None
        return plain

    def _checked(self, name: str, expected: Any, value: Any) -> Any:
        """What pyopencl takes for a value of a less common type; TypeError if it does not fit."""
        if expected is int or expected is float:
            if isinstance(value, numbers.Integral if expected is int else numbers.Real):
                return value
        elif isinstance(value, HostArray):
            if expected is _ANY or value.dtype == expected:
                return value.buffer
        elif isinstance(value, cl.MemoryObjectHolder):
            return value
        what = value.__class__.__name__
        if isinstance(value, HostArray):
            what = f"a HostArray of {value.dtype}, shape {value.shape}"
        elif not isinstance(value, cl.MemoryObjectHolder | np.ndarray):
            what = f"{what} {value!r}"
        raise TypeError(f"{self.name}: argument {name} is {self._type_names[name]}, got {what}")

    def _misnamed(self, arguments: dict[str, Any]) -> TypeError:
        """The error that says which arguments are missing and which unknown."""
        missing = [name for name in self.arguments if name not in arguments]
        unknown = [name for name in arguments if name not in self._type_names]
        said = [
            f"{word} {', '.join(names)}"
            for word, names in (("missing", missing), ("unknown", unknown))
            if names
        ]
        return TypeError(
            f"{self.name}: {' and '.join(said)}; its arguments are {', '.join(self.arguments)}"
        )


def _pointed_at(type_name: str) -> Any:
    """The dtype of a pointer's numbers, alone or in vectors; `_ANY` for a program's own types."""
    base = re.sub(r"^unsigned ", "u", type_name.rstrip("* "))
    found = _TYPES.get(re.sub(r"\d+$", "", base))
    return _ANY if found is None else np.dtype(found)
