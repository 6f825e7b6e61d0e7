"""How much memory a device has, whether it is the host's too, and how much of it arrays take."""

from __future__ import annotations

import gc
import threading

import pyopencl as cl

HINT = "Take a smaller image, less supersampling, or a device with more memory"

# A stage's working memory is this part of what is left: the next stages' points need some, too.
WORKING_PART = 4


class DeviceError(RuntimeError):
    """No usable OpenCL device, or the one asked for does not exist."""


class DeviceMemoryError(DeviceError, MemoryError):
    """An array is larger than the device can hold, or than is left."""


class DeviceMemory:
    """The memory of a device, and how many bytes of it are taken.

    Parameters
    ----------
    shared : bool
        Whether host and device use the same memory, so that nothing need be copied.
    largest, total : int
        Bytes that one array and all arrays may have.
    name : str
        The device's, for errors.

    Attributes
    ----------
    taken : int
        Bytes of the arrays that there are.
    """

    def __init__(self, shared: bool, largest: int, total: int, name: str = "the device") -> None:
        self.shared, self.largest, self.total, self.name = shared, largest, total, name
        self.taken = 0
        # An array may end while another is made, in the same thread.
        self._lock = threading.RLock()

    @classmethod
    def of(cls, cl_device: cl.Device) -> DeviceMemory:
        """What a device says of itself."""
        is_cpu = bool(cl_device.type & cl.device_type.CPU)
        shared = is_cpu or bool(cl_device.host_unified_memory)
        largest, total = cl_device.max_mem_alloc_size, cl_device.global_mem_size
        return cls(shared, largest, total, cl_device.name.strip())

    @property
    def left(self) -> int:
        """Bytes that nobody has taken."""
        return self.total - self.taken

    def check(self, size: int, what: object) -> None:
        """Raise if an array of `size` bytes does not fit, saying `what` it is.

        Raises
        ------
        DeviceMemoryError
        """
        if size > self.largest:
            raise DeviceMemoryError(
                f"{self.name}: {what} needs {size:,} bytes, the device allows {self.largest:,} in one "
                f"array. {HINT}"
            )
        if size > self.left:
            # What only cycles of references hold is still counted.
            gc.collect()
        if size > self.left:
            raise DeviceMemoryError(
                f"{self.name}: {what} needs {size:,} bytes, {max(self.left, 0):,} of {self.total:,} are "
                f"left. {HINT}"
            )

    def fitting(self, wanted: int, element_bytes: int) -> int:
        """How many elements of `wanted`, of so many bytes in all, go into the working memory of a stage.

        At least one. That of a stage may be a quarter of what is left; and one array may not be larger
        than the device allows, so this holds whatever part of the bytes it has.
        """
        return max(1, min(wanted, min(self.left // WORKING_PART, self.largest) // element_bytes))

    def take(self, size: int, what: object) -> None:
        """Count an array of `size` bytes, until it is given back; raises as `check`."""
        with self._lock:
            self.check(size, what)
            self.taken += size

    def give_back(self, size: int) -> None:
        """Count an array no longer."""
        with self._lock:
            self.taken -= size
