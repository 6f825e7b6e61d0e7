"""Points of the unit square: independent, stratified and scrambled Sobol, in blocks of fixed memory."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.stats import qmc

SAMPLERS = ("independent", "stratified", "sobol")
# Samples drawn at a time.
BLOCK = 1 << 18
SOBOL_BITS = 30
# Rows that have so many Sobol points together share the scrambling matrices, which take time to make.
SAMPLES_A_SCRAMBLE = 1 << 14
# The largest float32 below 1.
BELOW_ONE = np.float32(1 - 2**-24)


def blocks(
    sampler: str, rows: int, samples: int, seed: int
) -> Iterator[tuple[slice, np.ndarray, np.ndarray]]:
    """Draw `samples` points for each of `rows` estimates, which are independent of each other.

    Yields
    ------
    rows : slice
    u, v : ndarray
        float32 (rows of the slice, some of the samples), uniform on [0, 1)². All methods see the same
        rounding. Several blocks of one slice follow each other where `samples` do not fit one.

    Notes
    -----
    Stratified: one point in each cell of the most nearly square grid of `samples` cells. Sobol: scipy's
    scrambled sequence; some rows share its matrices and differ by a random digital shift, under which
    errors are uncorrelated, each row being unbiased given the matrices.
    """
    draw = {"independent": _independent, "stratified": _stratified, "sobol": _sobol}[sampler]
    step = max(1, BLOCK // samples)
    generator = np.random.Generator(np.random.Philox(seed))
    for first in range(0, rows, step):
        some = slice(first, min(first + step, rows))
        for u, v in draw(some.stop - some.start, samples, generator):
            yield some, _rounded(u), _rounded(v)


def _rounded(x: np.ndarray) -> np.ndarray:
    return np.minimum(x.astype(np.float32), BELOW_ONE)


def _parts(samples: int) -> Iterator[range]:
    for first in range(0, samples, BLOCK):
        yield range(first, min(first + BLOCK, samples))


def _independent(
    rows: int, samples: int, generator: np.random.Generator
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    for part in _parts(samples):
        yield tuple(generator.random((2, rows, len(part)), np.float32))


def _stratified(
    rows: int, samples: int, generator: np.random.Generator
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    across = next(k for k in range(int(samples**0.5), 0, -1) if samples % k == 0)
    for part in _parts(samples):
        jitter_u, jitter_v = generator.random((2, rows, len(part)))
        cell = np.arange(part.start, part.stop)
        yield (cell % across + jitter_u) / across, (cell // across + jitter_v) / (samples // across)


def _sobol(
    rows: int, samples: int, generator: np.random.Generator
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    group = max(1, SAMPLES_A_SCRAMBLE // samples)
    engines = [
        qmc.Sobol(2, scramble=True, bits=SOBOL_BITS, rng=generator) for _ in range(0, rows, group)
    ]
    shift = generator.integers(0, 1 << SOBOL_BITS, (2, rows, 1), np.int64)
    for part in _parts(samples):
        # Powers of two at a time, as the sequence wants them, but for a last part.
        points = np.stack([engine.random(len(part)).T for engine in engines], axis=1)
        whole = (points * 2.0**SOBOL_BITS).astype(np.int64)
        shifted = whole[:, np.arange(rows) // group] ^ shift
        yield tuple((shifted + 0.5) * 2.0**-SOBOL_BITS)
