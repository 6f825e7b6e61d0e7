"""The control variate of all points: learned or given, folded, scaled, integrated, with its density."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..host.clock import NO_TIME, OutOfTime, Run
from ..integration.integrator import Integrator
from ..learning.alpha import can_scale, control_coefficients, scale
from ..learning.density import Density, DensityNetwork, DensityTrainer, tabulate
from ..learning.train import TrainingSamples
from ..network.fold import FoldedNetwork
from ..network.network import Network
from ..opencl.device import GROUP_SIZE, Device
from ..opencl.memory import HostArray
from ..opencl.program import build
from ..sampling.guide import Guide
from ..sampling.problem import Problem
from ..settings.settings import Settings

# Points whose neurons the statistics look at.
POINTS_LOOKED_AT = 4096
# Work-items that look at one neuron.
IDLE_PARTS = GROUP_SIZE


@dataclass(frozen=True)
class ControlVariate:
    """What the estimate needs of the network.

    Attributes
    ----------
    folded : FoldedNetwork
    integral : ndarray
        float32 (channels, points), G of each active point.
    density : Density, optional
        Where in the square the residual is large, and its mean: sampling density and magnitude.
    density_network : DensityNetwork, optional
        The network that predicts `density`.
    alpha : ndarray, optional
        float32 (channels, points), the control coefficients that are folded in; None: 1 everywhere.
    """

    folded: FoldedNetwork
    integral: np.ndarray
    density: Density | None
    density_network: DensityNetwork | None
    alpha: np.ndarray | None = None


@dataclass(frozen=True)
class Trained:
    """A network and what belongs to it, from training, a file or a checkpoint.

    Attributes
    ----------
    network : Network
    density_network : DensityNetwork, optional
        The network that predicts its residual's magnitude; None: learned from `samples`, if there are
        any.
    alpha : ndarray, optional
        float32 (channels, points), control coefficients; None: found from `samples`, if there are any.
    samples : TrainingSamples, optional
        What training has left.
    guide : Guide, optional
        Densities that guide bounces, from a file.
    """

    network: Network
    density_network: DensityNetwork | None = None
    alpha: np.ndarray | None = None
    samples: TrainingSamples | None = None
    guide: Guide | None = None


def control_variate(
    problem: Problem,
    settings: Settings,
    run: Run,
    trained: Trained,
    save: Callable[[Network, dict[str, np.ndarray]], None] = lambda network, arrays: None,
) -> ControlVariate | None:
    """Make a control variate of a trained network; None where the time limit passes before.

    Parameters
    ----------
    save : callable
        Called with the arrays of the density network once it is trained: writes the network's file
        before a later stage can fail.
    """
    try:
        return _made(problem, settings, run, trained, save)
    except OutOfTime:
        warnings.warn(NO_TIME, stacklevel=6)
        return None


def _made(
    problem: Problem,
    settings: Settings,
    run: Run,
    trained: Trained,
    save: Callable[[Network, dict[str, np.ndarray]], None],
) -> ControlVariate:
    network, points, samples = trained.network, problem.points, trained.samples
    with run.watch("fold"):
        factor = problem.factor(network.description.demodulated)
        folded = FoldedNetwork(problem.device, network, points, factor)
    alpha = trained.alpha
    with run.watch("alpha"):
        # Only an image has neighbouring points to pool samples with.
        if samples is not None and alpha is None and problem.is_image and can_scale(folded):
            alpha = control_coefficients(folded, samples, points, settings.columns)
        if alpha is not None:
            scale(folded, alpha)
    run.clock.check()
    density_network, density = trained.density_network, None
    if settings.needs_magnitude:
        with run.watch("density"):
            unit = problem.means.read().mean(axis=0) if problem.demodulated else None
            if samples is not None and density_network is None:
                density_network = _density_network(problem, run, folded, samples, unit)
            if density_network is not None:
                density = tabulate(problem.device, density_network, network, points, unit)
    save(network, density_network.arrays() if density_network is not None else {})
    with run.watch("integrate"):
        integral = integrals_of(problem.device, folded, points.active)
    return ControlVariate(folded, integral, density, density_network, alpha)


def _density_network(
    problem: Problem, run: Run, folded: FoldedNetwork, samples: TrainingSamples, unit: np.ndarray | None
) -> DensityNetwork:
    """Train a network for the residual's magnitude, in units of `unit`, on the training samples."""
    unit = np.ones(problem.points.active, np.float32) if unit is None else unit
    check = None if run.clock.limit is None else run.clock.check
    return DensityTrainer(problem.device, folded, samples, unit).fit(check)


def idle(variate: ControlVariate, points: int) -> dict[str, object]:
    """Which parts of the network the points do not need, for the statistics; see `idle_neurons`.

    ``networks`` are points whose control coefficients are all zero: neither integrated nor evaluated.
    """
    found = idle_neurons(variate.folded, points)
    if variate.alpha is not None:
        found["networks"] = int(np.count_nonzero(np.all(variate.alpha == 0, axis=0)))
    return found


def idle_neurons(folded: FoldedNetwork, points: int) -> dict[str, object]:
    """How many first-layer neurons have no line in the unit square, over a choice of the points.

    Returns
    -------
    dict
        ``lines``: share of neurons whose line misses the square, which integration does not insert;
        ``dead_neurons``: share that is zero in the whole square; ``dead_in_image``: neurons that are
        so at every point looked at.
    """
    chosen = np.linspace(0, points, min(points, POINTS_LOOKED_AT), endpoint=False)
    device, defines = folded.device, folded.network.description.defines()
    neurons = folded.network.description.hidden[0]
    counts = HostArray(device, (neurons, 2), np.uint32)
    counts.fill(0)
    build(device, ("idle",), {**defines, "PARTS": f"{IDLE_PARTS}u"}).kernel("count_idle")(
        (neurons, IDLE_PARTS),
        chosen_count=len(chosen),
        w1_stride=defines["STRIDE_W1"],
        b1_stride=defines["STRIDE_B1"],
        chosen=HostArray.of(device, chosen.astype(np.uint32)),
        w1=folded.groups["W1"],
        b1=folded.groups["B1"],
        idle=counts,
        group=(1, IDLE_PARTS),
    )
    dead, without_line = counts.read().T
    total = max(1, neurons * len(chosen))
    return {
        "lines": float(without_line.sum() / total),
        "dead_neurons": float(dead.sum() / total),
        "dead_in_image": int(np.count_nonzero(dead == len(chosen))),
    }


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
            f"{statistics.uncertified_points} exact integrals failed their certification", stacklevel=8
        )
    return integral.read().T
