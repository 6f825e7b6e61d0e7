"""Certification of exact integrals: limits, reasons to do a point again, and counts.

`cl/integration/integrate_check.cl` has the mathematics. This is the only owner of its constants.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

PRECISIONS: dict[str, np.dtype[np.floating]] = {
    "float32": np.dtype(np.float32),
    "float64": np.dtype(np.float64),
}

# |sum of absolute areas - 1| beyond which a point is done again.
AREA_TOLERANCE = {"float32": 1e-5, "float64": 1e-12}
# What a certified integral may be off by, relative to Σ |w_j| ∫|activation(z_j)| + |b|.
ACCURACY = {"float32": 1e-6, "float64": 1e-13}
# Roundings of each product's sum beside one an input: of a vertex, of an area, of a triangle's integral.
ROUNDINGS_A_LAYER = 16

# Places in the array of counters that each launch fills.
COUNTERS = (
    *("head", "retry", "finished", "teams"),
    *("walk", "area", "excess", "overflow", "condition"),
)
REASONS = COUNTERS[4:]


@dataclass(frozen=True)
class Statistics:
    """Counts of one call.

    Attributes
    ----------
    points : int
        Networks integrated.
    faces : int
        Faces of the last arrangements, over all points: of the last hidden layer but one for
        ``decoupled``, of the last one for ``full``.
    walk, area, excess, overflow, condition : int
        Points that were done again, by the first reason that was found: a line that did not pass
        through the arrangement as a line does; faces that do not add up to the unit square; neurons
        whose integrals over the faces are not those over the square; a value that is not finite; terms
        of which so little remains that their rounding may spoil the result.
    float64_points : int
        Of those, points of single precision that arrangements in double precision certified.
    clipped_points : int
        The others, which were cut polygon by polygon.
    uncertified : tuple of int
        Points that failed there as well: their value is not finite in this precision.
    scratch_bytes : int
        Device memory held for work-groups and lists; it does not grow with the number of points.
    """

    points: int = 0
    faces: int = 0
    walk: int = 0
    area: int = 0
    excess: int = 0
    overflow: int = 0
    condition: int = 0
    float64_points: int = 0
    clipped_points: int = 0
    uncertified: tuple[int, ...] = ()
    scratch_bytes: int = 0

    @property
    def uncertified_points(self) -> int:
        """How many points have no finite value in this precision."""
        return len(self.uncertified)

    @property
    def robust_points(self) -> int:
        """Points that were done again, for whatever reason."""
        return sum(getattr(self, reason) for reason in REASONS)

    def __add__(self, other: Statistics) -> Statistics:
        """The sum of two calls' counts; the larger of their scratch memories."""
        total = {one.name: getattr(self, one.name) + getattr(other, one.name) for one in fields(self)}
        return Statistics(**total | {"scratch_bytes": max(self.scratch_bytes, other.scratch_bytes)})


def certificate_constants(
    widths: Sequence[int], precision: str, negative_slope: float, *, for_single: bool = False
) -> dict[str, int | str]:
    """The `-D` constants of certification.

    Parameters
    ----------
    widths, precision, negative_slope
        As for `Integrator`.
    for_single : bool
        Whether double precision computes points whose arrays are of single precision.
    """
    suffix = "f" if precision == "float32" else ""
    accuracy = ACCURACY["float32" if for_single else precision]
    roundings = sum(inputs + ROUNDINGS_A_LAYER for inputs in widths[:-1])
    return {
        "AREA_TOLERANCE": f"{AREA_TOLERANCE[precision]!r}{suffix}",
        "EXCESS_TOLERANCE": f"{excess_tolerance(widths, precision)!r}{suffix}",
        "CONDITION_LIMIT": f"{condition_limit(precision, accuracy)!r}{suffix}",
        "ROUNDINGS": roundings,
        "GREATEST_SLOPE": f"{max(1.0, abs(float(negative_slope)))!r}{suffix}",
        **{f"COUNT_{name.upper()}": place for place, name in enumerate(COUNTERS)},
    }


def condition_limit(precision: str, accuracy: float) -> float:
    """Terms over what remains of them (integrate_check.cl) beyond which rounding may spoil `accuracy`.

    One rounding of every term. `bench_integrate.py --torture` shows that this is enough.
    """
    return accuracy * 2 / float(np.finfo(PRECISIONS[precision]).eps)


def excess_tolerance(widths: Sequence[int], precision: str) -> float:
    """Largest sum of D_i / terms_i (integrate_check.cl) that rounding alone can cause.

    Each neuron's share of it is some roundings of at most one; so is each addition of the sum, whose
    terms add up to at most the number of neurons.
    """
    epsilon = float(np.finfo(PRECISIONS[precision]).eps)
    return epsilon * (8 + 2 * sum(widths[1:-1]))
