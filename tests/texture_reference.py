"""Textures in plain Python, one point at a time, and images for tests."""

from __future__ import annotations

import math

import numpy as np


def decoded(value: float) -> float:
    """The sRGB curve (IEC 61966-2-1)."""
    return value / 12.92 if value <= 0.04045 else ((value + 0.055) / 1.055) ** 2.4


def texel(index: int, size: int, wrap: str) -> int:
    """Which of an image's texels a texel of the plane around it is."""
    if wrap == "clamp":
        return min(max(index, 0), size - 1)
    if wrap == "repeat" or (index // size) % 2 == 0:
        return index % size
    return size - 1 - index % size


def looked_up(image: np.ndarray, u: float, v: float, wrap: tuple[str, str], nearest: bool) -> np.ndarray:
    """An image (height, width, channels), the uppermost row first, at one point."""
    height, width = image.shape[:2]
    x, y = u * width - 0.5, v * height - 0.5
    if nearest:
        x, y = math.floor(x + 0.5), math.floor(y + 0.5)
    total = np.zeros(image.shape[2])
    for i, share in ((math.floor(x), 1 - x % 1), (math.floor(x) + 1, x % 1)):
        for j, other in ((math.floor(y), 1 - y % 1), (math.floor(y) + 1, y % 1)):
            row = height - 1 - texel(j, height, wrap[1])
            total += share * other * image[row, texel(i, width, wrap[0])]
    return total


def halves(shape: tuple[int, ...], seed: int = 0) -> np.ndarray:
    """Random numbers that half precision holds."""
    return np.random.default_rng(seed).random(shape).astype(np.float16).astype(np.float64)
