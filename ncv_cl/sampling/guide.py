"""Densities that guide bounces behind the first: from where light arrives, in each cell of the scene."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from ..opencl.layout import Record
from ..scene.load import Scene
from . import tuning
from .warp import DENSITY_BINS, pack_records

# A cell for each of the six directions of normals in each box.
GUIDE_CELLS = 6 * tuning.GUIDE_SIDE**3
BINS = DENSITY_BINS**2


# The scene's box: its lower corner, and how many boxes there are to a unit of length.
GUIDE_FRAME = Record("GUIDE_FRAME", {"corner": 3, "cells": 3})


def guide_frame(scene: Scene) -> np.ndarray:
    """What guide.cl reads of the scene's box, float32 (GUIDE_FRAME.size,)."""
    lower, upper = scene.bounds.astype(np.float64)
    extent = np.maximum(upper - lower, 1e-6 * (upper - lower).max())
    return GUIDE_FRAME.pack(corner=lower, cells=tuning.GUIDE_SIDE / extent)


def guide_defines() -> dict[str, int]:
    """The `-D` constants of guide.cl, beside those of warp.cl."""
    return {"GUIDE_SIDE": tuning.GUIDE_SIDE, "GUIDE_CHANNELS": 3, **GUIDE_FRAME.defines()}


class Guide(NamedTuple):
    """Densities that guide bounces, and mean radiances.

    Attributes
    ----------
    densities : ndarray
        uint32 (GUIDE_CELLS, DENSITY_WORDS), records of warp.cl.
    means : ndarray
        float32 (GUIDE_CELLS, 3), mean radiance that arrives over the square.
    """

    densities: np.ndarray
    means: np.ndarray


@dataclass
class GuideRecorder:
    """Sums of what training paths found, by cell and by part of the square.

    Attributes
    ----------
    count, second : ndarray
        float64 (GUIDE_CELLS * BINS,): samples, and the sum of their squared radiances.
    first : ndarray
        float64 (3, GUIDE_CELLS), sums of radiances.
    """

    count: np.ndarray = field(default_factory=lambda: np.zeros(GUIDE_CELLS * BINS))
    second: np.ndarray = field(default_factory=lambda: np.zeros(GUIDE_CELLS * BINS))
    first: np.ndarray = field(default_factory=lambda: np.zeros((3, GUIDE_CELLS)))

    def add(self, place: np.ndarray, radiance: np.ndarray) -> None:
        """Samples in cell place // BINS, part place % BINS of its square; radiance (3, samples)."""
        self.count += np.bincount(place, minlength=len(self.count))
        square = np.mean(radiance, axis=0) ** 2
        self.second += np.bincount(place, square, minlength=len(self.second))
        for total, channel in zip(self.first, radiance, strict=True):
            total += np.bincount(place // BINS, channel, minlength=GUIDE_CELLS)

    def guide(self) -> Guide:
        """Densities as the root mean square of the radiance, and means.

        A part of the square with few samples is averaged with its cell's mean, and a cell with few
        samples with the mean of all cells.
        """
        prior, uniform = tuning.GUIDE_PRIOR_SAMPLES, tuning.GUIDE_UNIFORM_SHARE
        count, second = self.count.reshape(GUIDE_CELLS, BINS), self.second.reshape(GUIDE_CELLS, BINS)
        cells = count.sum(1)
        overall = self.first.sum(1, keepdims=True) / max(cells.sum(), 1.0)
        means = (self.first + prior * overall) / (cells + prior)
        everywhere = second.sum() / max(count.sum(), 1.0)
        cell = (second.sum(1) + prior * everywhere) / (count.sum(1) + prior)
        mean = (second + prior * cell[:, None]) / (count + prior)
        magnitude = np.sqrt(mean)
        total = magnitude.sum(1, keepdims=True)
        learned = np.divide(magnitude, total, out=np.full_like(magnitude, 1 / BINS), where=total > 0)
        densities = pack_records((1 - uniform) * learned + uniform / BINS)
        return Guide(densities, means.T.astype(np.float32))
