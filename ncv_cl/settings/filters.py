"""Filters from sub-pixels to pixels: how much those about a pixel's middle count."""

from __future__ import annotations

import numpy as np

# Half the width of each along one axis, in pixels.
RADIUS = {"box": 0.5, "tent": 1.0, "blackman-harris": 1.5}
# Coefficients of the window of four terms (Harris 1978), whose side lobes are 92 dB down.
_WINDOW = (0.35875, 0.48829, 0.14128, 0.01168)


def weights(name: str, side: int) -> np.ndarray:
    """Weights along one axis of the sub-pixels about a pixel's middle, of sum 1, float64.

    Parameters
    ----------
    name : str
        Of `RADIUS`.
    side : int
        Sub-pixels of a pixel along an axis. As many weights as reach the filter's width lie on both
        sides of the pixel's middle.
    """
    radius = RADIUS[name]
    # Middles of sub-pixels lie at (i + 1/2) / side - 1/2 from the pixel's.
    count = side + 2 * int(np.ceil((radius - 0.5) * side))
    at = (np.arange(count) - (count - 1) / 2) / side
    return _shape(name, at / radius) / _shape(name, at / radius).sum()


def error_factor(name: str, side: int) -> float:
    """Mean square error of pixels over the mean variance of sub-pixels, whose errors are independent."""
    return float(np.sum(weights(name, side) ** 2)) ** 2


def _shape(name: str, x: np.ndarray) -> np.ndarray:
    """The filter at places from -1 to 1, its ends."""
    inside = np.abs(x) < 1
    if name == "box":
        return inside.astype(np.float64)
    if name == "tent":
        return np.maximum(1.0 - np.abs(x), 0.0)
    angle = np.pi * (x + 1.0)
    window = sum((-1) ** k * a * np.cos(k * angle) for k, a in enumerate(_WINDOW))
    return np.where(inside, window, 0.0)
