"""What share.cl keeps and gives where points share their paths."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..opencl.device import Device
from ..opencl.kernel import Arguments
from ..opencl.layout import Record
from ..opencl.memory import HostArray
from ..opencl.program import Program
from ..points.points import ShadingPoints
from ..visibility.room import Batch
from .warp import Warp
from .waves.waves import Waves

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
        self._device, self._members = device, members
        self.hits = HostArray(device, (SHARED.size + 3 * slots) * paths, np.float32)
        # Places that are not shared are read, and not used.
        self.hits.fill(0.0)
        self.u, self.v, self.weight = (HostArray(device, entries, np.float32) for _ in range(3))
        self.value = HostArray(device, 3 * entries, np.float32)
        self.visible = HostArray(device, entries, np.uint8)

    def gather(
        self,
        program: Program,
        waves: Waves,
        points: ShadingPoints,
        own: Batch,
        density: Warp | None,
        casters: HostArray,
        most: float,
        radiance: HostArray,
    ) -> float:
        """What paths of a group's members found on their `own`, for all members; embree's seconds.

        Parameters
        ----------
        density : Warp, optional
            What the samples follow.
        casters, most, radiance
            Those of share.cl.
        """
        places = len(own.points) * own.stride
        common: Arguments = {
            "first_point": own.points.start,
            "point_count": len(own.points),
            "total_points": points.total,
            "stride": own.stride,
            "places": places,
            "order": own.order,
            "surface": points.surface,
            "hits": self.hits,
            "visible": self.visible,
            "own_u": own.u,
        }
        samples = places // (self._members * self._device.vector_width)
        wave = waves.begin(0, places * self._members)
        arguments: Arguments = {"casters": casters, "plane": wave.plane, "wave": wave.words}
        program.kernel("share_rays")(samples, **common, **arguments)
        seconds = waves.trace("shared")
        waves.each_lit(program, "share_seen", visible=self.visible)
        waves.end(program)
        weights: Arguments = {}
        if density is not None:
            weights = {"density": density.records(own.order, own.points), "own_weight": own.weight}
        program.kernel("share_paths")(
            samples,
            **common,
            most=most,
            radiance=radiance,
            own_v=own.v,
            **weights,
            u=self.u,
            v=self.v,
            weight=self.weight,
            value=self.value,
        )
        return seconds

    def batch(self, own: Batch, slot: HostArray, visible: HostArray) -> Batch:
        """The batch of these, in place of what members drew on their `own`."""
        return replace(
            own, u=self.u, v=self.v, value=self.value, slot=slot, visible=visible, weight=self.weight,
            entries=self._members,
        )  # fmt: skip
