"""The control variate of all points: folded, integrated, and with the density of its residual."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np

from .density import Density, DensityNetwork
from .device import Device, HostArray
from .integrator import Integrator
from .network import FoldedNetwork


@dataclass(frozen=True)
class ControlVariate:
    """What the estimate needs of the network.

    Attributes
    ----------
    folded : FoldedNetwork
    integral : ndarray
        float32 (channels, points), G of each active point.
    density : Density, optional
        Where the residual is.
    learned : DensityNetwork, optional
        What predicts it.
    """

    folded: FoldedNetwork
    integral: np.ndarray
    density: Density | None
    learned: DensityNetwork | None


def integrals_of(device: Device, folded: FoldedNetwork, points: int) -> np.ndarray:
    """G of `points` points, float32 (channels, points); warns where one is not certified."""
    description = folded.network.description
    integrator = Integrator(
        device,
        widths=(2, *description.hidden, description.channels),
        per_point_weights=folded.per_point[0],
        per_point_biases=folded.per_point[1],
    )
    integral = HostArray(device, (points, description.channels), np.float32)
    statistics = integrator.run(*folded.layers(), integral)
    if statistics.uncertified_points:
        warnings.warn(
            f"{statistics.uncertified_points} exact integrals failed their certification", stacklevel=5
        )
    return integral.read().T
