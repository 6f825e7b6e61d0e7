"""What is to be integrated: one integral a shading point, and where its samples come from."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from ..network.encode import GridCube, varying_inputs
from ..opencl.device import Device, HostArray
from ..points.points import ShadingPoints
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
        float (2, 3), what the points lie in, world space.
    candidates : tuple of str
        What of φ the integrand depends on.
    demodulated : bool
        Whether integrands are to be divided by their means without shadows.
    is_image : bool
        Whether points lie side by side in an image.
    narrowest : float
        Part of the square that the light with the least of it has to itself.
    """

    device: Device
    points: ShadingPoints
    source: Batches
    bounds: np.ndarray
    candidates: tuple[str, ...]
    demodulated: bool = False
    is_image: bool = True
    narrowest: float = 1.0

    @functools.cached_property
    def inputs(self) -> tuple[str, ...]:
        """What of φ varies over the points."""
        return varying_inputs(self.points, self.candidates)

    @functools.cached_property
    def cube(self) -> GridCube:
        """What a network's hash grid divides."""
        if self.is_image:
            return GridCube.of_points(self.points, self.bounds)
        return GridCube.around(self.bounds)

    @functools.cached_property
    def means(self) -> HostArray:
        """Means of the integrands without shadows, float32 (channels, points.active)."""
        return self.source.unshadowed_means()

    def factor(self, demodulated: bool) -> HostArray | None:
        """What a network's output is multiplied by, if it is demodulated."""
        return self.means if demodulated else None
