"""Densities that guide bounces behind the first: from where light arrives, in each cell of the scene."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from ..scene.load import Scene
from .warp import DENSITY_BINS, pack_records

# Boxes along each axis of the scene; each has a cell for the six directions of normals.
SIDE = 8
CELLS = 6 * SIDE**3
BINS = DENSITY_BINS**2
# Part of every density that is uniform.
UNIFORM_SHARE = 0.3
# Samples that what is known of a cell, and of all cells, counts for.
PRIOR_SAMPLES = 8.0


def guide_frame(scene: Scene) -> np.ndarray:
    """What guide.cl reads of the scene's box: lower corner, cells a unit of length; float32 (6,)."""
    lower, upper = scene.bounds.astype(np.float64)
    extent = np.maximum(upper - lower, 1e-6 * (upper - lower).max())
    return np.concatenate([lower, SIDE / extent]).astype(np.float32)


def guide_defines() -> dict[str, int]:
    """The `-D` constants of guide.cl, beside those of warp.cl."""
    return {"GUIDE_SIDE": SIDE, "GUIDE_CHANNELS": 3}


class Guide(NamedTuple):
    """Densities that guide bounces, and mean radiances.

    Attributes
    ----------
    densities : ndarray
        uint32 (CELLS, DENSITY_WORDS), records of warp.cl.
    means : ndarray
        float32 (CELLS, 3), mean radiance that arrives over the square.
    """

    densities: np.ndarray
    means: np.ndarray


@dataclass
class GuideRecorder:
    """Sums of what training paths found, by cell and by part of the square.

    Attributes
    ----------
    count, second : ndarray
        float64 (CELLS * BINS,): samples, and the sum of their squared radiances.
    first : ndarray
        float64 (3, CELLS), sums of radiances.
    """

    count: np.ndarray = field(default_factory=lambda: np.zeros(CELLS * BINS))
    second: np.ndarray = field(default_factory=lambda: np.zeros(CELLS * BINS))
    first: np.ndarray = field(default_factory=lambda: np.zeros((3, CELLS)))

    def add(self, place: np.ndarray, radiance: np.ndarray) -> None:
        """Samples in cell place // BINS, part place % BINS of its square; radiance (3, samples)."""
        self.count += np.bincount(place, minlength=len(self.count))
        square = np.mean(radiance, axis=0) ** 2
        self.second += np.bincount(place, square, minlength=len(self.second))
        for total, channel in zip(self.first, radiance, strict=True):
            total += np.bincount(place // BINS, channel, minlength=CELLS)

    def guide(self) -> Guide:
        """Densities as the root mean square of the radiance, and means.

        A part of the square with few samples is averaged with its cell's mean, and a cell with few
        samples with the mean of all cells.
        """
        count, second = self.count.reshape(CELLS, BINS), self.second.reshape(CELLS, BINS)
        cells = count.sum(1)
        overall = self.first.sum(1, keepdims=True) / max(cells.sum(), 1.0)
        means = (self.first + PRIOR_SAMPLES * overall) / (cells + PRIOR_SAMPLES)
        everywhere = second.sum() / max(count.sum(), 1.0)
        cell = (second.sum(1) + PRIOR_SAMPLES * everywhere) / (count.sum(1) + PRIOR_SAMPLES)
        mean = (second + PRIOR_SAMPLES * cell[:, None]) / (count + PRIOR_SAMPLES)
        magnitude = np.sqrt(mean)
        total = magnitude.sum(1, keepdims=True)
        learned = np.divide(magnitude, total, out=np.full_like(magnitude, 1 / BINS), where=total > 0)
        densities = pack_records((1 - UNIFORM_SHARE) * learned + UNIFORM_SHARE / BINS)
        return Guide(densities, means.T.astype(np.float32))
