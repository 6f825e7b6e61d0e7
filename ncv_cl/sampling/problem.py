"""The integrals of a render: one a shading point, and the source of their samples."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from ..network.encode import GridCube, varying_inputs
from ..opencl.device import Device
from ..opencl.memory import HostArray
from ..points.points import ShadingPoints
from ..visibility.slices import SliceChoice
from .samples import Batches


@dataclass(frozen=True)
class Problem:
    """The integrals of an image, or of a function of the user.

    Attributes
    ----------
    device : Device
    points : ShadingPoints
        One integral each.
    source : Batches
        Draws samples of their integrands.
    bounds : ndarray
        float (2, 3), bounds of the scene in world space.
    candidates : tuple of str
        Inputs that the integrand depends on, some of `INPUTS`.
    demodulated : bool
        Whether the network learns f over its mean without shadows.
    is_image : bool
        Whether points lie side by side in an image.
    narrowest : float
        Width of the narrowest light's strip of the square; 1 without lights.
    slices : SliceChoice, optional
        How many slices of the hemisphere to take in place of the samples that were asked for, if that
        was looked into.
    """

    device: Device
    points: ShadingPoints
    source: Batches
    bounds: np.ndarray
    candidates: tuple[str, ...]
    demodulated: bool = False
    is_image: bool = True
    narrowest: float = 1.0
    slices: SliceChoice | None = None

    @property
    def sliced(self) -> bool:
        """Whether samples are slices of the hemisphere."""
        return self.source.sliced

    @functools.cached_property
    def inputs(self) -> tuple[str, ...]:
        """Those of `candidates` that vary over the points."""
        return varying_inputs(self.points, self.candidates)

    @functools.cached_property
    def cube(self) -> GridCube:
        """The cube that a network's hash grid divides."""
        if self.is_image:
            return GridCube.of_points(self.points, self.bounds)
        return GridCube.around(self.bounds)

    @functools.cached_property
    def means(self) -> HostArray:
        """Means of the integrands without shadows, float32 (channels, points.active)."""
        return self.source.unshadowed_means()

    def factor(self, demodulated: bool) -> HostArray | None:
        """The factor of a demodulated network's output: `means`; None for others."""
        return self.means if demodulated else None
