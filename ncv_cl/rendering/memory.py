"""What a render takes of the device's memory for each point, checked before anything is sampled."""

from __future__ import annotations

import math

from ..network.network import NetworkDescription
from ..sampling.accumulate import STATE
from ..sampling.problem import Problem
from ..sampling.warp import DENSITY_WORDS
from ..settings.settings import Settings

_WORD = 4


def point_bytes(
    channels: int, stratified: bool, description: NetworkDescription | None, has_density: bool
) -> dict[str, int]:
    """Bytes that a render's arrays have for each point, by what they hold; each is one array.

    Parameters
    ----------
    channels : int
        Of the integrand.
    stratified : bool
        Whether points are estimated twice, as for variances of well spread samples.
    description : NetworkDescription, optional
        Of the control variate, if there is one.
    has_density : bool
        Whether its samples follow a density.
    """
    quantities = 1 if description is None else 2
    state = _WORD * quantities * channels * STATE.size
    found = {"sums": state, "order": _WORD}
    if stratified:
        found |= {"sums of the second estimate": state}
    if description is None:
        return found
    for group, shape in description.group_shapes.items():
        if group in description.modulated:
            found[f"weights {group}"] = _WORD * math.prod(shape)
    found["integrals"] = _WORD * channels
    if description.demodulated:
        found["factors"] = _WORD * channels
    if has_density:
        found |= {"densities": _WORD * DENSITY_WORDS, "magnitudes": _WORD}
    return found


def check_memory(problem: Problem, settings: Settings, description: NetworkDescription | None) -> None:
    """Raise if the device cannot hold what the estimate of `problem` needs of each point.

    Raises
    ------
    DeviceMemoryError
        Says how many bytes are asked for and left.
    """
    points, memory = problem.points.active, problem.device.memory
    stratified = settings.sampling.sampler != "independent"
    needed = point_bytes(problem.source.channels, stratified, description, settings.needs_magnitude)
    if problem.carrier is not None:
        # The workers have the sums.
        needed = {name: size for name, size in needed.items() if "sums" not in name}
    network = "" if description is None else " with a network (method mc needs less)"
    for name, size in needed.items():
        memory.check(points * size, f"a render of {points:,} points{network}: its {name}")
    memory.check(points * sum(needed.values()), f"a render of {points:,} points{network}")
