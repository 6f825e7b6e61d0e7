"""The integrals of a render: one a shading point, and the source of their samples."""

from __future__ import annotations

import functools
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ..network.encode import GridCube, varying_inputs
from ..opencl.device import Device
from ..opencl.memory import HostArray
from ..points.points import ShadingPoints
from ..settings.settings import Settings
from ..visibility.rays import RayCount
from ..visibility.slices import SliceChoice
from .paths import PathSource
from .samples import Batches


@dataclass(frozen=True)
class Apart:
    """Direct light that is estimated apart from the rest of the integrand.

    Attributes
    ----------
    source : Batches
        Draws its samples, at the same points.
    lit : ndarray
        uint32, the points that face a light; at all others it is zero.
    """

    source: Batches
    lit: np.ndarray


@dataclass(frozen=True)
class Decisions:
    """What is decided for all points of a render together.

    Attributes
    ----------
    most_occluders : (int, int), optional
        Longest list of occluders there is room for, and the longest that is kept; None: there are none.
    lines : bool
        Whether samples lie where lines see the lights.
    sliced : bool
        Whether samples are slices of the hemisphere.
    split : bool
        Whether direct light is estimated apart.
    """

    most_occluders: tuple[int, int] | None = None
    lines: bool = False
    sliced: bool = False
    split: bool = False


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
    glow : ndarray, optional
        float32 (3, points.active), what surfaces add to the integrals by themselves.
    apart : Apart, optional
        A part of the integrals that `source` leaves out.
    slices : SliceChoice, optional
        How many slices of the hemisphere to take in place of the samples that were asked for, if that
        was looked into.
    decisions : Decisions
        How samples are drawn, decided by what was seen of all points.
    no_network : str, optional
        Why a network pays for no number of samples, in words, where that is known of the scene.
    carrier : object, optional
        Draws passes on other machines (`rendering.carried.carrier.Carrier`).
    """

    device: Device
    points: ShadingPoints
    source: Batches
    bounds: np.ndarray
    candidates: tuple[str, ...]
    demodulated: bool = False
    is_image: bool = True
    narrowest: float = 1.0
    glow: np.ndarray | None = None
    apart: Apart | None = None
    slices: SliceChoice | None = None
    decisions: Decisions = field(default_factory=lambda: Decisions())
    no_network: str | None = None
    carrier: Any = None

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

    def sampled(self, settings: Settings) -> Settings:
        """The settings with as many samples a point as there are to be slices, where these are taken."""
        if self.slices is None or not self.slices.number:
            return settings
        return replace(settings, spp=self.slices.number)

    @property
    def rays(self) -> RayCount:
        """The rays of all samples so far."""
        own = self.source.rays
        return own if self.apart is None else own + self.apart.source.rays

    @property
    def paths(self) -> PathSource:
        """`source`, where it draws paths, which can be guided."""
        if not isinstance(self.source, PathSource):
            raise TypeError(f"a {type(self.source).__name__} has no paths to guide")
        return self.source

    def factor(self, demodulated: bool) -> HostArray | None:
        """The factor of a demodulated network's output: `means`; None for others."""
        return self.means if demodulated else None
