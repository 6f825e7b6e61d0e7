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
# A cell's mean is not known better than to this share of the light's root mean square.
LEAST_DEVIATION = 0.1


# The scene's box: its lower corner, and how many boxes there are to a unit of length.
GUIDE_FRAME = Record("GUIDE_FRAME", {"corner": 3, "cells": 3})


# What roulette knows of a cell: the mean radiance that arrives, and how far from it a sample is.
KNOWN = Record("KNOWN", {"mean": 3, "need": 1})


def guide_frame(scene: Scene) -> np.ndarray:
    """What guide.cl reads of the scene's box, float32 (GUIDE_FRAME.size,)."""
    lower, upper = scene.bounds.astype(np.float64)
    extent = np.maximum(upper - lower, 1e-6 * (upper - lower).max())
    return GUIDE_FRAME.pack(corner=lower, cells=tuning.GUIDE_SIDE / extent)


def guide_defines() -> dict[str, int]:
    """The `-D` constants of guide.cl, beside those of warp.cl."""
    return {"GUIDE_SIDE": tuning.GUIDE_SIDE, **KNOWN.defines(), **GUIDE_FRAME.defines()}


class Guide(NamedTuple):
    """Densities that guide bounces, and what roulette knows of the light that they bring.

    Attributes
    ----------
    densities : ndarray
        uint32 (GUIDE_CELLS, DENSITY_WORDS), records of warp.cl.
    means : ndarray
        float32 (GUIDE_CELLS, 3), mean radiance that arrives over the square.
    needs : ndarray
        float32 (GUIDE_CELLS,): deviation of a guided sample of it from that mean, over the root mean
        square of what paths bring behind their first two edges.
    """

    densities: np.ndarray
    means: np.ndarray
    needs: np.ndarray

    def known(self) -> np.ndarray:
        """What roulette reads of each cell, float32 (GUIDE_CELLS, KNOWN.size)."""
        return KNOWN.pack(mean=self.means, need=self.needs)


@dataclass
class GuideRecorder:
    """Sums of what training paths found, by cell and by part of the square.

    Attributes
    ----------
    count, second : ndarray
        float64 (GUIDE_CELLS * BINS,): samples, and the sum of their squared radiances.
    first : ndarray
        float64 (3, GUIDE_CELLS), sums of radiances.
    brought : float
        Sum of the squares of what the samples' paths brought.
    """

    count: np.ndarray = field(default_factory=lambda: np.zeros(GUIDE_CELLS * BINS))
    second: np.ndarray = field(default_factory=lambda: np.zeros(GUIDE_CELLS * BINS))
    first: np.ndarray = field(default_factory=lambda: np.zeros((3, GUIDE_CELLS)))
    brought: float = 0.0

    def add(self, place: np.ndarray, radiance: np.ndarray, throughput: np.ndarray) -> None:
        """Samples in cell place // BINS, part place % BINS of its square.

        Radiances, and throughputs of the rays that found them, are (3, samples).
        """
        self.count += np.bincount(place, minlength=len(self.count))
        square = np.mean(radiance, axis=0) ** 2
        self.second += np.bincount(place, square, minlength=len(self.second))
        self.brought += float(np.sum(np.mean(throughput * radiance, axis=0) ** 2))
        for total, channel in zip(self.first, radiance, strict=True):
            total += np.bincount(place // BINS, channel, minlength=GUIDE_CELLS)

    def guide(self) -> Guide:
        """Densities as the root mean square of the radiance, means, and deviations from them.

        What few samples tell of a cell, or of a part of its square, is completed by what is known of
        eight cells together, of these by eight times as many, up to all of one direction.
        """
        uniform = tuning.GUIDE_UNIFORM_SHARE
        count, second = (sums.reshape(-1, 6, BINS) for sums in (self.count, self.second))
        means = _means(count.sum(2), self.first.T.reshape(-1, 6, 3)).reshape(-1, 3)
        squares = _squares(count, second).reshape(-1, BINS)
        magnitude = np.sqrt(squares)
        density = (1 - uniform) * _shares(magnitude) + uniform / BINS
        # A sample at a density d counts 1 / d: the expectation of its square, and of its deviation's.
        guided = np.sum(squares / density, axis=1) / BINS**2
        deviation = np.sqrt(np.maximum(guided - means.mean(axis=1) ** 2, LEAST_DEVIATION**2 * guided))
        usual = np.sqrt(self.brought / max(self.count.sum(), 1.0))
        needs = deviation / usual if usual > 0 else np.ones(GUIDE_CELLS)
        return Guide(pack_records(density), means.astype(np.float32), needs.astype(np.float32))


def _shares(parts: np.ndarray) -> np.ndarray:
    """`parts` over their sums along the last axis; all alike where that is zero."""
    total = parts.sum(axis=-1, keepdims=True)
    return np.divide(parts, total, out=np.full_like(parts, 1 / parts.shape[-1]), where=total > 0)


def _coarser(boxes: np.ndarray) -> np.ndarray:
    """Sums over eight boxes each, (side**3, ...)."""
    half = round(len(boxes) ** (1 / 3)) // 2
    eights = boxes.reshape(half, 2, half, 2, half, 2, *boxes.shape[1:])
    return eights.sum(axis=(1, 3, 5)).reshape(half**3, *boxes.shape[1:])


def _finer(boxes: np.ndarray) -> np.ndarray:
    """The value of each box for the eight that it is made of."""
    side = round(len(boxes) ** (1 / 3))
    cube = boxes.reshape(side, side, side, *boxes.shape[1:])
    for axis in range(3):
        cube = cube.repeat(2, axis=axis)
    return cube.reshape(8 * side**3, *boxes.shape[1:])


def _means(count: np.ndarray, sums: np.ndarray) -> np.ndarray:
    """Means of cells, (boxes, 6, 3), those of coarser boxes counting GUIDE_PRIOR_SAMPLES samples."""
    if len(count) == 1:
        above = sums.sum(axis=(0, 1)) / max(count.sum(), 1.0)
    else:
        above = _finer(_means(_coarser(count), _coarser(sums)))
    prior = tuning.GUIDE_PRIOR_SAMPLES
    return (sums + prior * above) / (count + prior)[..., None]


def _squares(count: np.ndarray, sums: np.ndarray) -> np.ndarray:
    """Mean squares of cells' parts, (boxes, 6, BINS).

    Of coarser boxes the shares of the parts are taken over, at the level of a cell's own mean.
    """
    prior = tuning.GUIDE_PRIOR_SAMPLES
    if len(count) == 1:
        above = np.full(count.shape, sums.sum() / max(count.sum(), 1.0))
    else:
        above = _finer(_squares(_coarser(count), _coarser(sums)))
    own = (sums.sum(axis=2) + prior * above.mean(axis=2)) / (count.sum(axis=2) + prior)
    expected = BINS * own[..., None] * _shares(above)
    return (sums + prior * expected) / (count + prior)
