"""The control variate of all points: folded, scaled, integrated, with the density of its residual."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..host.clock import UNLIMITED, Clock
from ..integration.integrator import Integrator
from ..learning.alpha import scale
from ..learning.density import Density, DensityNetwork, tabulate
from ..learning.learn import Learned, learn_alpha, learn_density
from ..network.network import FoldedNetwork, Network
from ..opencl.device import Device, HostArray
from ..points.points import ShadingPoints
from ..settings.settings import RenderSettings, Stopwatch

# Points whose neurons the statistics look at.
POINTS_LOOKED_AT = 4096


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
    alpha : ndarray, optional
        float32 (channels, points), the control coefficients that are folded in; None: 1 everywhere.
    """

    folded: FoldedNetwork
    integral: np.ndarray
    density: Density | None
    learned: DensityNetwork | None
    alpha: np.ndarray | None = None


def control_variate(
    device: Device,
    points: ShadingPoints,
    settings: RenderSettings,
    network: Network,
    watch: Stopwatch,
    learned: Learned | None = None,
    density: DensityNetwork | None = None,
    alpha: np.ndarray | None = None,
    columns: int | None = None,
    factor: HostArray | None = None,
    unit: np.ndarray | None = None,
    save: Callable[[dict[str, np.ndarray]], None] | None = None,
    clock: Clock = UNLIMITED,
) -> ControlVariate:
    """Make a control variate of a trained network.

    Parameters
    ----------
    learned : Learned, optional
        What training left, from which coefficients and density are learned.
    density, alpha : optional
        Those of a network that was trained before.
    columns : int, optional
        Sub-pixels of a row of the image; without an image there are no coefficients to learn.
    factor : HostArray, optional
        As `FoldedNetwork` takes it.
    unit : ndarray, optional
        As `tabulate` takes it.
    save : callable, optional
        Keeps the network with these arrays of its density, before anything else can fail.
    clock : Clock

    Raises
    ------
    OutOfTime
        Where the time limit has passed before the densities are known.
    """
    check = None if clock.limit is None else clock.check
    with watch("fold"):
        folded = FoldedNetwork(device, network, points, factor)
    with watch("alpha"):
        if learned is not None and columns is not None:
            alpha = learn_alpha(points, folded, learned.trainer, columns)
        if alpha is not None:
            scale(folded, alpha)
    clock.check()
    table = None
    if settings.uses_density or settings.allocates:
        with watch("density"):
            if learned is not None:
                density = learn_density(device, points, folded, learned.trainer, unit, check)
            if density is not None:
                table = tabulate(device, density, network, points, unit)
    if save is not None:
        save(density.arrays() if density is not None else {})
    with watch("integrate"):
        integral = integrals_of(device, folded, points.active)
    return ControlVariate(folded, integral, table, density, alpha)


def idle(variate: ControlVariate, points: int) -> dict[str, object]:
    """What of the network `points` points do not need; see `idle_neurons`.

    ``networks`` are points whose control coefficients are all zero: neither integrated nor evaluated.
    """
    found = idle_neurons(variate.folded, points)
    if variate.alpha is not None:
        found["networks"] = int(np.count_nonzero(np.all(variate.alpha == 0, axis=0)))
    return found


def idle_neurons(folded: FoldedNetwork, points: int) -> dict[str, object]:
    """How many first-layer neurons need no line in the square: shares over some of the points.

    Returns
    -------
    dict
        ``lines``: share of neurons whose line misses the square, which integration does not insert;
        ``dead_neurons``: share that is zero in the whole square; ``dead_in_image``: neurons that are
        so at every point looked at.
    """
    chosen = np.linspace(0, points, min(points, POINTS_LOOKED_AT), endpoint=False).astype(int)
    weights, biases = (_chosen_weights(folded, name, chosen) for name in ("W1", "B1"))
    corners = np.array([(0, 0), (1, 0), (0, 1), (1, 1)], np.float32)
    values = np.einsum("pji,ki->pjk", weights, corners) + biases[..., None]
    dead = np.all(values <= 0, axis=2)
    return {
        "lines": float(np.mean(dead | np.all(values >= 0, axis=2))),
        "dead_neurons": float(np.mean(dead)),
        "dead_in_image": int(np.count_nonzero(dead.all(axis=0))),
    }


def _chosen_weights(folded: FoldedNetwork, name: str, chosen: np.ndarray) -> np.ndarray:
    """One group's weights at some points, (points, ...)."""
    group = folded.groups[name]
    with group.mapped() as view:
        if name in folded.network.description.modulated:
            return view[chosen]
        return np.broadcast_to(view, (len(chosen), *view.shape)).copy()


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
