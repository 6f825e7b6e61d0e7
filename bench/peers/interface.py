"""What every method has in common: training samples in, an estimator out, estimates of integrals."""

from __future__ import annotations

import abc
import importlib.util
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from .sampling import blocks

FamilyFunction = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Samples:
    """Training samples of a family of integrands.

    Attributes
    ----------
    u, v, values : ndarray
        float32 (points, samples).
    features : ndarray
        float32 (points, k), what tells the integrands apart, scaled to [0, 1]; k may be 0.
    """

    u: np.ndarray
    v: np.ndarray
    values: np.ndarray
    features: np.ndarray

    @classmethod
    def draw(cls, function: FamilyFunction, features: np.ndarray, samples: int, seed: int) -> Samples:
        """Independent uniform samples, `samples` of each integrand."""
        points = len(features)
        generator = np.random.Generator(np.random.Philox([seed, 1]))
        u, v = generator.random((2, points, samples), np.float32)
        values = function(u, v, np.arange(points)[:, None]).astype(np.float32)
        lower, upper = (features.min(axis=0), features.max(axis=0)) if features.size else (0.0, 1.0)
        scaled = (features - lower) / np.where(upper > lower, upper - lower, 1)
        return cls(u, v, values, scaled.astype(np.float32))

    @property
    def points(self) -> int:
        return self.u.shape[0]

    @property
    def samples(self) -> int:
        return self.u.shape[1]

    def rows(self) -> tuple[np.ndarray, np.ndarray]:
        """All samples one below the other: inputs (n, 2 + k) of u, v and features, and values (n,)."""
        features = np.repeat(self.features, self.samples, axis=0)
        inputs = np.column_stack([self.u.ravel(), self.v.ravel(), features])
        return inputs, self.values.ravel()


class Estimator(abc.ABC):
    """Estimates integrals, with whatever was learned before.

    Attributes
    ----------
    trainings : list of float
        Seconds of each training in the last call of `estimate`, where a method trains only then.
    """

    trainings: Sequence[float] = ()

    @abc.abstractmethod
    def estimate(
        self, function: FamilyFunction, samples: int, repeats: int, seed: int, sampler: str
    ) -> np.ndarray:
        """Independent estimates of all integrals, float64 (repeats, points).

        Parameters
        ----------
        function : callable
            f(u, v, index), as in `planar.Family`.
        samples : int
            Values of f for each estimate (of a family: on average).
        sampler : str
            One of `sampling.SAMPLERS` that the method knows.
        """


class ControlVariate(Estimator):
    """Estimates by G + <f - g>, for a function g with a known integral G.

    Attributes
    ----------
    integral : ndarray
        float64 (points,), G.
    """

    integral: np.ndarray

    @abc.abstractmethod
    def evaluate(self, u: np.ndarray, v: np.ndarray, index: np.ndarray) -> np.ndarray:
        """g, float (n,), of float32 (n,), float32 (n,) and int (n,) arrays."""

    def estimate(
        self, function: FamilyFunction, samples: int, repeats: int, seed: int, sampler: str
    ) -> np.ndarray:
        points = len(self.integral)
        sums = np.zeros(repeats * points)
        for rows, u, v in blocks(sampler, repeats * points, samples, seed):
            index = np.arange(rows.start, rows.stop)[:, None] % points
            g = self.evaluate(u.ravel(), v.ravel(), np.broadcast_to(index, u.shape).ravel())
            sums[rows] += (function(u, v, index) - g.reshape(u.shape)).sum(axis=1, dtype=np.float64)
        return self.integral + sums.reshape(repeats, points) / samples


class Method(abc.ABC):
    """A way to estimate integrals.

    Attributes
    ----------
    name, source : str
        The latter says where the method was published.
    modules : tuple of str
        Optional packages that it needs.
    samplers : tuple of str
        What `Estimator.estimate` takes.
    learns : bool
        Whether it takes training samples.
    """

    name: str
    source: str
    modules: tuple[str, ...] = ()
    samplers: tuple[str, ...] = ("independent", "sobol")
    learns = True

    @property
    def missing(self) -> list[str]:
        """Packages that are not installed."""
        return [module for module in self.modules if importlib.util.find_spec(module) is None]

    @abc.abstractmethod
    def fit(self, training: Samples, seed: int, seconds: float | None = None) -> Estimator:
        """Learn from training samples.

        Parameters
        ----------
        seconds : float, optional
            End the schedule by then, where the method has one that takes long enough to matter.
        """
