"""Integrands over the unit square whose integrals are known, alone and in families.

Every integral is a closed form, derived where it stands, so there is no quadrature error to state: they
are exact to a few roundings of float64. `tests/test_peers.py` holds each against scipy's quadrature.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from scipy.special import ndtr
from scipy.stats import qmc

FamilyFunction = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]

DISK_CENTER, DISK_RADIUS = (0.5, 0.5), 0.35
WAVE = (6.0, 4.0)
# The ridge and the line run along u = start + slope v, inside the square for all v.
RIDGE_START, RIDGE_SLOPE, RIDGE_HALF_WIDTH = 0.75, -0.5, 0.2
LINE_START, LINE_SLOPE, LINE_HALF_WIDTH = 0.2, 0.55, 0.01
# Odd: no grid of a power of two fits it.
CHECKER_CELLS = 5
# Weight, mean (u, v) and standard deviation (u, v).
MIXTURE = (
    (0.5, 0.30, 0.35, 0.08, 0.12),
    (0.3, 0.70, 0.60, 0.05, 0.05),
    (0.2, 0.55, 0.90, 0.20, 0.03),
)
PEAK = (5.0, 5.0)
# Midpoints an axis by which `spread` finds a variance, of one integrand alone and in a family.
SPREAD_CELLS = (1500, 250)


@dataclass(frozen=True)
class Planar:
    """One integrand.

    Attributes
    ----------
    name : str
    function : callable
        f(u, v) of arrays of one shape, elementwise.
    integral : float
        Over the unit square, exact.
    breaks : tuple of float
        Where f is not smooth along u at a given v, as functions of v: what a quadrature should know.
    source : str
        Where the closed form stands.
    """

    name: str
    function: Callable[[np.ndarray, np.ndarray], np.ndarray]
    integral: float
    breaks: Callable[[float], list[float]] = field(default=lambda v: [])
    source: str = "derived in planar.py"

    def family(self) -> Family:
        """The same, as a family of one."""

        def function(u: np.ndarray, v: np.ndarray, index: np.ndarray) -> np.ndarray:
            return self.function(u, v)

        return Family(self.name, function, np.array([self.integral]), np.empty((1, 0)))


@dataclass(frozen=True)
class Family:
    """Integrands that differ by what is fixed while (u, v) varies.

    Attributes
    ----------
    name : str
    function : callable
        f(u, v, index) of arrays that broadcast to one shape; index says which integrand.
    integrals : ndarray
        float64 (points,), exact.
    features : ndarray
        float64 (points, k), what tells them apart; k is 0 for a family of one.
    """

    name: str
    function: FamilyFunction
    integrals: np.ndarray
    features: np.ndarray

    @property
    def points(self) -> int:
        return len(self.integrals)

    def spread(self) -> np.ndarray:
        """Variance of f over the square, float64 (points,).

        By midpoints for each of at most 64 integrands spread over the family, whose mean stands for
        all of a larger family's: for reports, good to a few per mille for jumps.
        """
        cells = SPREAD_CELLS[self.points > 1]
        side = (np.arange(cells) + 0.5) / cells
        chosen = np.unique(np.linspace(0, self.points - 1, min(self.points, 64)).astype(int))
        found = [
            float(np.var(self.function(side[:, None], side[None, :], np.array(index))))
            for index in chosen
        ]
        return np.array(found) if len(found) == self.points else np.full(self.points, np.mean(found))


def disk(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """The slides' disk; its integral is its area, pi r²."""
    return (np.hypot(u - DISK_CENTER[0], v - DISK_CENTER[1]) < DISK_RADIUS).astype(float)


def smooth(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """(1 + sin(a u + b v)) / 2."""
    return 0.5 * (1 + np.sin(WAVE[0] * u + WAVE[1] * v))


def smooth_integral() -> float:
    """Integrating sin twice: (sin a + sin b - sin(a + b)) / (a b)."""
    a, b = WAVE
    return 0.5 * (1 + (math.sin(a) + math.sin(b) - math.sin(a + b)) / (a * b))


def ridge(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """A tent across a slanted line: at every v a triangle of height 1, whose half width is its area."""
    return np.maximum(0.0, 1 - np.abs(u - RIDGE_START - RIDGE_SLOPE * v) / RIDGE_HALF_WIDTH)


def checker(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Cells of zeros and ones, zeros in the corners."""
    return (np.floor(CHECKER_CELLS * u) + np.floor(CHECKER_CELLS * v)) % 2


def thin_line(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """One inside a thin slanted band, whose width along u is its integral."""
    return (np.abs(u - LINE_START - LINE_SLOPE * v) < LINE_HALF_WIDTH).astype(float)


def mixture(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Normal densities times weights."""
    total = 0.0
    for weight, mean_u, mean_v, deviation_u, deviation_v in MIXTURE:
        exponent = ((u - mean_u) / deviation_u) ** 2 + ((v - mean_v) / deviation_v) ** 2
        total = total + weight / (2 * math.pi * deviation_u * deviation_v) * np.exp(-0.5 * exponent)
    return total


def mixture_integral() -> float:
    """Products of what the normal distributions leave inside [0, 1]."""
    return sum(
        weight * float(_inside(mean_u, deviation_u) * _inside(mean_v, deviation_v))
        for weight, mean_u, mean_v, deviation_u, deviation_v in MIXTURE
    )


def corner_peak(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """(1 + a u + b v)^-3: Genz's third family in two dimensions."""
    return (1 + PEAK[0] * u + PEAK[1] * v) ** -3


def corner_peak_integral() -> float:
    """(1 - 1 / (1 + a) - 1 / (1 + b) + 1 / (1 + a + b)) / (2 a b), Genz 1984."""
    a, b = PEAK
    return (1 - 1 / (1 + a) - 1 / (1 + b) + 1 / (1 + a + b)) / (2 * a * b)


def _inside(mean: np.ndarray | float, deviation: np.ndarray | float) -> np.ndarray:
    return ndtr((1 - mean) / deviation) - ndtr((0 - mean) / deviation)


def _disk_breaks(v: float) -> list[float]:
    half = math.sqrt(max(DISK_RADIUS**2 - (v - DISK_CENTER[1]) ** 2, 0.0))
    return [DISK_CENTER[0] - half, DISK_CENTER[0] + half]


def _band_breaks(start: float, slope: float, half_width: float) -> Callable[[float], list[float]]:
    return lambda v: [start + slope * v + half_width * side for side in (-1, 0, 1)]


GENZ = (
    "Genz, Testing multidimensional integration routines, in Tools, Methods and Languages for "
    "Scientific and Engineering Computation, 1984; Kaarnioja, Explicit solutions of Genz test "
    "integrals, 2024, doi 10.1016/j.aml.2024.109444"
)
INTEGRANDS = {
    one.name: one
    for one in (
        Planar("disk", disk, math.pi * DISK_RADIUS**2, _disk_breaks),
        Planar("smooth", smooth, smooth_integral()),
        Planar(
            "ridge",
            ridge,
            RIDGE_HALF_WIDTH,
            _band_breaks(RIDGE_START, RIDGE_SLOPE, RIDGE_HALF_WIDTH),
        ),
        Planar(
            "checker",
            checker,
            CHECKER_CELLS**2 // 2 / CHECKER_CELLS**2,
            lambda v: [k / CHECKER_CELLS for k in range(1, CHECKER_CELLS)],
        ),
        Planar(
            "thin line",
            thin_line,
            2 * LINE_HALF_WIDTH,
            _band_breaks(LINE_START, LINE_SLOPE, LINE_HALF_WIDTH),
        ),
        Planar("mixture", mixture, mixture_integral(), lambda v: [row[1] for row in MIXTURE]),
        Planar("corner peak", corner_peak, corner_peak_integral(), source=GENZ),
    )
}


def disk_family(points: int) -> Family:
    """Disks inside the square, of radius 0.1 to 0.35 and any centre."""
    radius, center_u, center_v = _spread_out(points, 3)
    radius = 0.1 + 0.25 * radius
    center_u, center_v = (radius + (1 - 2 * radius) * center for center in (center_u, center_v))

    def function(u: np.ndarray, v: np.ndarray, index: np.ndarray) -> np.ndarray:
        inside = np.hypot(u - center_u[index], v - center_v[index]) < radius[index]
        return inside.astype(float)

    features = np.stack([radius, center_u, center_v], axis=-1)
    return Family("disks", function, math.pi * radius**2, features)


def bump_family(points: int) -> Family:
    """Gaussian bumps of height 1, deviation 0.08 to 0.3, and any centre in the square."""
    deviation, center_u, center_v = _spread_out(points, 3)
    deviation = 0.08 + 0.22 * deviation

    def function(u: np.ndarray, v: np.ndarray, index: np.ndarray) -> np.ndarray:
        squared = (u - center_u[index]) ** 2 + (v - center_v[index]) ** 2
        return np.exp(-0.5 * squared / deviation[index] ** 2)

    integrals = 2 * math.pi * deviation**2 * _inside(center_u, deviation) * _inside(center_v, deviation)
    return Family("bumps", function, integrals, np.stack([deviation, center_u, center_v], axis=-1))


FAMILIES = {"disks": disk_family, "bumps": bump_family}


def _spread_out(points: int, axes: int) -> np.ndarray:
    """The Halton sequence, float64 (axes, points)."""
    return qmc.Halton(axes, scramble=False).random(points).T
