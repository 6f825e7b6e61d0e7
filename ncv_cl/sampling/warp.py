"""Densities of the unit square that samples are drawn by, as warp.cl reads them."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ..opencl.layout import Record
from ..opencl.memory import HostArray

# Cells an axis of a density: the edges between eight are seven bytes, of two words.
DENSITY_BINS = 8
# A row of bins, of the strips or of one strip's cells, is two words.
ROW_WORDS = 2
DENSITY = Record("DENSITY", {"strips": ROW_WORDS, "cells": ROW_WORDS * DENSITY_BINS}, np.uint32)
DENSITY_WORDS = DENSITY.size
# What the probabilities of a row's bins are multiples of.
EDGE_UNITS = 256


def warp_defines() -> dict[str, int | str]:
    """The `-D` constants of warp.cl."""
    own = {"DENSITY_BINS": DENSITY_BINS, "EDGE_UNITS": EDGE_UNITS, "DENSITY_ROW": ROW_WORDS}
    return {**own, **DENSITY.defines()}


class Warp:
    """A density that samples are drawn by.

    Attributes
    ----------
    files : tuple of str
        Kernel files that define `warp_square`, DENSITY_WORDS and RECORD_NUMBER.
    defines : dict
        Their `-D` constants.
    most_points : int or None
        Points that a batch may have; None: any number.
    """

    files: tuple[str, ...]
    defines: dict[str, int | str]
    most_points: int | None = None

    def records(self, order: HostArray, points: range) -> HostArray:
        """What `warp_square` reads to draw samples of points order[i], i in `points`."""
        raise NotImplementedError


@dataclass(frozen=True)
class TableWarp(Warp):
    """Density constant on each of DENSITY_BINS x DENSITY_BINS cells.

    Attributes
    ----------
    table : HostArray
        uint32 (points.active, DENSITY_WORDS), as warp.cl reads it.
    """

    table: HostArray
    files: tuple[str, ...] = field(default=("warp",), init=False)
    defines: dict[str, int | str] = field(default_factory=warp_defines, init=False)

    def records(self, order: HostArray, points: range) -> HostArray:
        return self.table


def pack_records(probability: np.ndarray) -> np.ndarray:
    """Records of warp.cl, uint32 (records, DENSITY_WORDS).

    Parameters
    ----------
    probability : ndarray
        (records, DENSITY_BINS²), of the cells, those of one strip in u after another; positive. Rounded
        so that strips, and the cells of a strip, have multiples of 1 / EDGE_UNITS, none less than one.
    """
    cells = probability.reshape(-1, DENSITY_BINS, DENSITY_BINS)
    rows = np.concatenate([cells.sum(2)[:, None], cells], axis=1)
    sums = np.cumsum(rows, axis=2)
    edges = np.rint(sums / sums[..., -1:] * EDGE_UNITS).astype(np.int64)
    before = np.zeros(edges.shape[:2], np.int64)
    words = np.zeros((*edges.shape[:2], ROW_WORDS), np.uint32)
    for number in range(DENSITY_BINS - 1):
        last = EDGE_UNITS - DENSITY_BINS + 1 + number
        before = np.minimum(np.maximum(edges[..., number], before + 1), last)
        words[..., number // 4] |= before.astype(np.uint32) << np.uint32(8 * (number % 4))
    return DENSITY.pack(strips=words[:, 0], cells=words[:, 1:].reshape(len(words), -1))
