"""Slices of the hemisphere: visibility along all heights over one azimuth, found without rays."""

from __future__ import annotations

import numpy as np

from ..opencl.device import Device
from ..opencl.memory import HostArray
from ..scene.load import Scene
from . import tuning
from .hierarchy import CHILDREN, box_levels, in_nodes, packed_order, padded

# What rounding may move a box from a plane by, of the largest coordinate: six roundings of sums of up to
# 2 * 3^0.5.
PLANE_ROUNDING = 24 * 2.0**-24


class Slices:
    """A scene's triangles in boxes, as slices.cl walks them.

    Parameters
    ----------
    device, scene

    Attributes
    ----------
    arguments : dict
        Those of slices.cl, by name: one over the largest coordinate, levels' first nodes, nodes of
        boxes, and leaves of triangles.
    """

    def __init__(self, device: Device, scene: Scene) -> None:
        corners = scene.vertices[scene.triangles].astype(np.float32)
        lower, upper = corners.min(axis=1), corners.max(axis=1)
        order = packed_order(lower, upper)
        levels = box_levels(lower[order], upper[order])
        firsts = np.cumsum([0, *(len(level) for level in levels[:-1])])
        self._levels = len(levels)
        self.arguments = {
            "unit": 1 / float(np.abs(corners).max()),
            "levels": HostArray.of(device, firsts.astype(np.uint32)),
            "boxes": HostArray.of(device, np.concatenate(levels)),
            # What fills up a leaf is without extent: no plane has its corners on two sides.
            "triangles": HostArray.of(device, in_nodes(padded(corners[order].reshape(-1, 9), 0.0))),
        }

    def defines(self) -> dict[str, str]:
        """The `-D` constants of slices.cl, beside those of surface.cl."""
        return {
            "CHILDREN": f"{CHILDREN}u",
            "SLICE_LEVELS": f"{self._levels}u",
            "MOST_BLOCKED": f"{tuning.MOST_BLOCKED}u",
            "PLANE_ROUNDING": f"{PLANE_ROUNDING!r}f",
        }
