"""Monte Carlo without a control variate, by any of the samplers."""

from __future__ import annotations

import numpy as np

from .interface import Estimator, FamilyFunction, Method, Samples
from .sampling import SAMPLERS, blocks


class PlainEstimator(Estimator):
    """The mean of f."""

    def __init__(self, points: int) -> None:
        self._points = points

    def estimate(
        self, function: FamilyFunction, samples: int, repeats: int, seed: int, sampler: str
    ) -> np.ndarray:
        sums = np.zeros(repeats * self._points)
        for rows, u, v in blocks(sampler, len(sums), samples, seed):
            index = np.arange(rows.start, rows.stop)[:, None] % self._points
            sums[rows] += function(u, v, index).sum(axis=1, dtype=np.float64)
        return sums.reshape(repeats, self._points) / samples


class Plain(Method):
    """Plain Monte Carlo: independent, stratified, or scrambled Sobol points."""

    name = "Monte Carlo"
    source = "scipy.stats.qmc for Sobol points"
    samplers = SAMPLERS
    learns = False

    def fit(self, training: Samples, seed: int, seconds: float | None = None) -> PlainEstimator:
        return PlainEstimator(training.points)
