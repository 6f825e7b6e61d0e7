"""Slices of the hemisphere: visibility along all heights over one azimuth, found without rays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..opencl.device import Device
from ..opencl.kernel import Arguments
from ..opencl.memory import HostArray
from ..opencl.program import build
from ..points.points import ShadingPoints, surface_defines
from ..scene.load import Scene
from . import tuning
from .hierarchy import CHILDREN, Hierarchy

# What rounding may move a box from a plane by, of the largest coordinate: six roundings of sums of up to
# 2 * 3^0.5.
PLANE_ROUNDING = 24 * 2.0**-24
# Slices that tell what slices cost in a scene.
COUNTED_SLICES = 1024


@dataclass(frozen=True)
class SliceCost:
    """What slices cost at the points of an image, by counts.

    Attributes
    ----------
    leaves : float
        Leaves of the scene's triangles that a slice meets, on average.
    refused : float
        Share of slices that are given up, and left to rays.
    """

    leaves: float
    refused: float

    @property
    def rays(self) -> float:
        """Rays that take the time of a slice."""
        return tuning.RAYS_A_SLICE + tuning.RAYS_A_LEAF * self.leaves


@dataclass(frozen=True)
class SliceChoice:
    """What visibility "auto" chose: `number` slices a point, 0 for rays, because of their `cost`."""

    number: int
    cost: SliceCost

    def as_dict(self) -> dict[str, object]:
        """For statistics."""
        return {
            "a_point": self.number,
            "rays_each": self.cost.rays,
            "refused": self.cost.refused,
        }


def boxes_pay(triangles: int, points: int, spp: int) -> bool:
    """Whether there are enough samples for slices to be looked into.

    Boxes take time to build. And what slices cost takes time to count, which is spared where as many
    samples as are asked for never buy enough slices.
    """
    enough = tuning.SAMPLES_A_TRIANGLE * triangles
    least = tuning.LEAST_RAYS_OF_MANY if triangles > tuning.MANY_TRIANGLES else 1.0
    return spp >= tuning.FEWEST_SLICES * least and points * spp >= enough


def slices_for(rays: int, cost: SliceCost, sampler: str) -> int:
    """How many slices a point to take in place of so many rays; 0 where rays reach an error sooner.

    Slices in the time of the rays at most. By Sobol points they are a power of two, so that they are
    equidistant, and have the error a / n^3, that of rays is b / (rays)^1.5; a slice that is refused is
    a ray at random, with the error c / n of all. In equal time slices have less error if there are
    about as many of them as rays in the time of one, and if few are refused. Of independent samples
    both errors fall like 1 / n, and all depends on what a slice costs.

    Parameters
    ----------
    rays : int
        Samples a point that were asked for.
    sampler : {"sobol", "independent"}
    """
    affordable = int(rays / cost.rays)
    if sampler == "independent":
        return affordable if cost.rays <= tuning.MOST_RAYS_A_SLICE else 0
    number = 1 << affordable.bit_length() >> 1
    few = number < max(tuning.FEWEST_SLICES, cost.rays)
    lost = cost.refused * cost.rays**1.5 * number**0.5
    return 0 if few or lost > tuning.MOST_REFUSED else number


class Slices:
    """A scene's triangles in boxes, as slices.cl walks them.

    Parameters
    ----------
    device, scene
    hierarchy : Hierarchy, optional
        The scene's, if there is one.

    Attributes
    ----------
    arguments : dict
        Those of slices.cl, by name: one over the largest coordinate, levels' first nodes, nodes of
        boxes, and leaves of triangles.
    """

    def __init__(self, device: Device, scene: Scene, hierarchy: Hierarchy | None = None) -> None:
        hierarchy = hierarchy or Hierarchy(device, scene)
        self._device = device
        self._levels = hierarchy.levels.shape[0]
        self.arguments: Arguments = {
            "unit": 1 / hierarchy.extent,
            "levels": hierarchy.levels,
            "boxes": hierarchy.boxes,
            # What fills up a leaf is without extent: no plane has its corners on two sides.
            "triangles": hierarchy.triangles,
        }

    def cost(self, points: ShadingPoints, radius: float) -> SliceCost:
        """What slices cost at the active points; the same in every run.

        Parameters
        ----------
        radius : float
            Farther occluders do not count, scene units.
        """
        program = build(
            self._device,
            ("common", "surface", "slices", "slice_cost"),
            {**surface_defines(), **self.defines()},
        )
        leaves, refused = (HostArray(self._device, COUNTED_SLICES, np.uint32) for _ in range(2))
        program.kernel("count_leaves")(
            COUNTED_SLICES,
            slice_count=COUNTED_SLICES,
            point_count=points.active,
            total_points=points.total,
            radius=radius,
            surface=points.surface,
            **self.arguments,
            leaves=leaves,
            refused=refused,
        )
        return SliceCost(float(leaves.read().mean()), float(refused.read().mean()))

    def defines(self) -> dict[str, str]:
        """The `-D` constants of slices.cl, beside those of surface.cl."""
        return {
            "CHILDREN": f"{CHILDREN}u",
            "SLICE_LEVELS": f"{self._levels}u",
            "MOST_BLOCKED": f"{tuning.MOST_BLOCKED}u",
            "PLANE_ROUNDING": f"{PLANE_ROUNDING!r}f",
        }
