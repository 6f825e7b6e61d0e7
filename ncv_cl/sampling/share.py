"""What share.cl keeps and gives where points share their paths."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..opencl.device import Device
from ..opencl.layout import Record
from ..opencl.memory import HostArray
from ..visibility.room import Batch

# What is kept of the place that a path reaches first: how far rays leave it off the surface, 0 where it
# is not shared, and the place itself; and what the path's throughput began with.
FIELDS = {"offset": 1, "position": 3, "geometric_normal": 3, "normal": 3, "reflectance": 3, "begun": 1}
SHARED = Record("SHARED", FIELDS)


def share_defines(members: int, weighted: bool) -> dict[str, int | str]:
    """The `-D` constants of place.cl and share.cl; `weighted` where samples follow densities."""
    own = {"SHARED": int(members > 1), "SHARES_DENSITY": int(weighted and members > 1)}
    return {**own, "MEMBERS": f"{members}u", **SHARED.defines()}


class Entries:
    """Memory for what shared paths give: a batch's samples, each the mean of what all members drew.

    Parameters
    ----------
    device
    members, paths, entries, slots : int
        Points of a group; paths of a batch at most, and what these give at most; sums of a path.

    Attributes
    ----------
    hits : HostArray
        float32, planes of SHARED, and of what is matte of each slot of a path's sums.
    u, v, weight, value, visible : HostArray
        As share.cl lays them out.
    """

    def __init__(self, device: Device, members: int, paths: int, entries: int, slots: int) -> None:
        self._members = members
        self.hits = HostArray(device, (SHARED.size + 3 * slots) * paths, np.float32)
        # Places that are not shared are read, and not used.
        self.hits.fill(0.0)
        self.u, self.v, self.weight = (HostArray(device, entries, np.float32) for _ in range(3))
        self.value = HostArray(device, 3 * entries, np.float32)
        self.visible = HostArray(device, entries, np.uint8)

    def batch(self, own: Batch, slot: HostArray, visible: HostArray) -> Batch:
        """The batch of these, in place of what members drew on their `own`."""
        return replace(
            own, u=self.u, v=self.v, value=self.value, slot=slot, visible=visible, weight=self.weight,
            entries=self._members,
        )  # fmt: skip
