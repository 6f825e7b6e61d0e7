"""The standard skies of the CIE as images in latitude and longitude, black below the horizon."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

# Rows from zenith to nadir; twice as many columns where there is something to see in them.
ROWS = 512


def overcast_sky(zenith: ArrayLike) -> NDArray[np.float32]:
    """L = Lz (1 + 2 sin γ) / 3 at elevation γ, float32 (ROWS, 1, 3).

    Moon and Spencer, *Illumination from a Non-Uniform Sky*, 1942; CIE S 011 (ISO 15469:2004), 1.
    A horizontal surface receives 7/9 π Lz.
    """
    up = np.cos(_angles(ROWS))
    found = np.where(up > 0, (1 + 2 * up) / 3, 0.0)
    return _of_zenith(found[:, None], zenith)


def clear_sky(zenith: ArrayLike, sun: NDArray[np.float64]) -> NDArray[np.float32]:
    """The clear sky about a sun, float32 (ROWS, 2 * ROWS, 3).

    L / Lz = f(χ) φ(Z) / (f(Zs) φ(0)), f(χ) = 0.91 + 10 exp(-3 χ) + 0.45 cos² χ, φ(Z) = 1 - exp(-0.32 /
    cos Z), with χ the angle from the sun, Z that from the zenith, Zs the sun's. Kittler,
    *Standardisation of Outdoor Conditions*, 1967; CIE S 011, 12.

    Parameters
    ----------
    zenith : array_like
        Lz, RGB or one number.
    sun : ndarray
        float64 (3,), unit direction towards the sun in the image's axes, of which y is up.
    """
    down, across = _angles(ROWS)[:, None], (np.arange(2 * ROWS) + 0.5) * np.pi / ROWS
    up = np.cos(down)
    towards = np.sin(down) * (np.sin(across) * sun[0] - np.cos(across) * sun[2]) + up * sun[1]
    above = np.maximum(up, 1e-3)
    gradation = (1 - np.exp(-0.32 / above)) / (1 - np.exp(-0.32))
    found = np.where(up > 0, _indicatrix(towards) * gradation / _indicatrix(sun[1]), 0.0)
    return _of_zenith(found, zenith)


def _indicatrix(cosine: NDArray[np.float64] | float) -> NDArray[np.float64]:
    angle = np.arccos(np.clip(cosine, -1, 1))
    return 0.91 + 10 * np.exp(-3 * angle) + 0.45 * np.cos(angle) ** 2


def _angles(rows: int) -> NDArray[np.float64]:
    """From the zenith to the middle of each row."""
    return (np.arange(rows) + 0.5) * np.pi / rows


def _of_zenith(relative: NDArray[np.float64], zenith: ArrayLike) -> NDArray[np.float32]:
    colour = np.broadcast_to(np.asarray(zenith, np.float64), 3)
    return (relative[:, :, None] * colour).astype(np.float32)
