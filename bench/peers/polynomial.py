"""Polynomials fitted by least squares, whose integrals are their constant coefficients.

Salaün, Gruson, Hua, Hachisuka and Singh, *Regression-based Monte Carlo Integration*, ACM TOG 41(4),
2022.
They fit each integral's own samples and use these for the residual too; here the fit has samples of its
own, as those of the other methods have, so that the estimate is unbiased.
"""

from __future__ import annotations

import numpy as np

from .interface import ControlVariate, Method, Samples

# Total degrees that are tried; the one with the least error on samples held back is taken.
DEGREES = (0, 1, 2, 3, 4, 6, 8, 10, 12, 16)
# Samples that a coefficient must have at least.
SAMPLES_A_COEFFICIENT = 3
# Ridge, relative to the number of samples: for well-posed systems of few samples.
RIDGE = 1e-6
HELD_BACK = 0.25
# Samples evaluated at a time: what they need fits the cache.
CHUNK = 1 << 13


def legendre_terms(u: np.ndarray, v: np.ndarray, degree: int) -> np.ndarray:
    """Products of shifted Legendre polynomials up to a total degree, float64 (..., terms).

    They are orthonormal over the unit square; the first is 1 and all others integrate to zero.
    """
    legendre_u, legendre_v = _legendre(u, degree), _legendre(v, degree)
    return np.stack(
        [legendre_u[i] * legendre_v[k - i] for k in range(degree + 1) for i in range(k + 1)], axis=-1
    )


def _legendre(x: np.ndarray, degree: int) -> np.ndarray:
    """Orthonormal on [0, 1], float64 (degree + 1, ...), by Bonnet's recursion."""
    t = 2 * np.asarray(x, np.float64) - 1
    rows = [np.ones_like(t), t]
    for k in range(1, degree):
        rows.append(((2 * k + 1) * t * rows[k] - k * rows[k - 1]) / (k + 1))
    return np.stack([np.sqrt(2 * k + 1) * row for k, row in enumerate(rows[: degree + 1])])


class Polynomial(ControlVariate):
    """One polynomial for each integrand.

    Parameters
    ----------
    coefficients : ndarray
        float64 (points, terms), as `legendre_terms` orders them.
    degree : int
    """

    def __init__(self, coefficients: np.ndarray, degree: int) -> None:
        self.coefficients, self.degree = coefficients, degree
        self.integral = coefficients[:, 0]
        # Of the first polynomial: row i, column j belongs to the product of degrees i and j.
        self._matrix = np.zeros((degree + 1, degree + 1))
        pairs = [(i, k - i) for k in range(degree + 1) for i in range(k + 1)]
        self._matrix[tuple(np.transpose(pairs))] = coefficients[0]

    def evaluate(self, u: np.ndarray, v: np.ndarray, index: np.ndarray) -> np.ndarray:
        found = np.empty(len(u))
        for first in range(0, len(u), CHUNK):
            some = slice(first, first + CHUNK)
            if len(self.coefficients) > 1:
                terms = legendre_terms(u[some], v[some], self.degree)
                np.einsum("nk,nk->n", terms, self.coefficients[index[some]], out=found[some])
            else:
                legendre_u, legendre_v = _legendre(u[some], self.degree), _legendre(v[some], self.degree)
                found[some] = np.einsum("in,in->n", legendre_u, self._matrix @ legendre_v)
        return found


class PolynomialRegression(Method):
    """Least squares for each integrand by itself; the degree is chosen on samples held back."""

    name = "polynomial regression"
    source = "Salaün et al. 2022"

    def fit(self, training: Samples, seed: int, seconds: float | None = None) -> Polynomial:
        kept = max(1, round(training.samples * (1 - HELD_BACK)))
        errors = {}
        for degree in DEGREES:
            terms = (degree + 1) * (degree + 2) // 2
            if terms == 1 or terms * SAMPLES_A_COEFFICIENT <= training.samples:
                coefficients = _solve(training, slice(0, kept), degree)
                rest = legendre_terms(training.u[:, kept:], training.v[:, kept:], degree)
                predicted = np.einsum("pnk,pk->pn", rest, coefficients)
                errors[degree] = np.mean((training.values[:, kept:] - predicted) ** 2)
        best = min(errors, key=errors.get)
        return Polynomial(_solve(training, slice(None), best), best)


def _solve(training: Samples, chosen: slice, degree: int) -> np.ndarray:
    """Coefficients (points, terms) of the normal equations, which orthonormal terms keep well posed."""
    terms = legendre_terms(training.u[:, chosen], training.v[:, chosen], degree)
    values = training.values[:, chosen].astype(np.float64)
    gram = np.einsum("pni,pnj->pij", terms, terms, optimize=True)
    gram += RIDGE * values.shape[1] * np.eye(gram.shape[-1])
    return np.linalg.solve(gram, np.einsum("pni,pn->pi", terms, values)[..., None])[..., 0]
