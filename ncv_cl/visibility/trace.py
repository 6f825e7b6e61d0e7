"""Rays on the device: trace.cl's walks through a scene's boxes, instead of embree."""

from __future__ import annotations

from ..opencl.device import Device
from ..opencl.kernel import Arguments
from ..opencl.memory import HostArray
from .hierarchy import Hierarchy


class DeviceTracer:
    """A scene whose rays kernels answer; samples and waves take it in place of a `Tracer`.

    Parameters
    ----------
    device
    hierarchy : Hierarchy
        The scene's. Its triangles are taken for whole, whatever holes textures make.

    Attributes
    ----------
    arguments : dict
        Those of kernels that walk the hierarchy, by name.
    numbers : HostArray
        uint32, the scene's number of the triangle at each place of the hierarchy.
    """

    def __init__(self, device: Device, hierarchy: Hierarchy) -> None:
        self._hierarchy = hierarchy
        self.numbers = HostArray.of(device, hierarchy.numbers)
        self.arguments: Arguments = {
            "extent": hierarchy.extent,
            "levels": hierarchy.levels,
            "boxes": hierarchy.boxes,
            "triangles": hierarchy.triangles,
        }

    def defines(self) -> dict[str, str]:
        """The `-D` constants of trace.cl."""
        return self._hierarchy.defines()
