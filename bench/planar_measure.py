"""Measurements for bench_planar.py: validation, equal training samples, equal time."""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from peers.interface import ControlVariate, Estimator, Method, Samples
from planar import Family
from scipy import stats

# Chance that a sound method fails its validation.
FALSE_ALARM = 1e-6
# Fewer samples than these are no estimate, fewer errors no mean square.
FEWEST_SAMPLES, FEWEST_ERRORS = 4, 8
# Midpoints an axis for the integral of g, and the difference allowed in units of f's root mean square.
QUADRATURE_CELLS = 512
QUADRATURE_TOLERANCE = 2e-3


@dataclass(frozen=True)
class Sizes:
    """How much is measured.

    Attributes
    ----------
    training, samples : int
        Samples of each integral, for training and for the estimate.
    repeats : int
        Estimates with one fit.
    fits : int
        Fits, each with training samples of its own; medians are over these.
    seconds : float, optional
        Limit for the schedules of methods that take long to train.
    largest : int
        Samples up to which the error under well spread samples is measured for equal time.
    """

    training: int
    samples: int
    repeats: int
    fits: int
    seconds: float | None
    largest: int


@dataclass
class Record:
    """What was measured of one method under one sampler, one entry a fit."""

    fit_seconds: list[float] = field(default_factory=list)
    nanoseconds: list[float] = field(default_factory=list)
    mean_square: list[float] = field(default_factory=list)
    errors: list[np.ndarray] = field(default_factory=list)


def bias_score(errors: np.ndarray) -> tuple[float, float]:
    """Student's t of the mean error, and the largest that passes."""
    errors = errors.ravel()
    deviation = max(float(errors.std(ddof=1)) / errors.size**0.5, 1e-7)
    return float(errors.mean()) / deviation, float(stats.t.isf(FALSE_ALARM / 2, errors.size - 1))


def integral_error(variate: ControlVariate, rms: float, cells: int = QUADRATURE_CELLS) -> float:
    """Largest difference between G and midpoint sums of g over `rms`, for at most 4 integrals."""
    side = ((np.arange(cells) + 0.5) / cells).astype(np.float32)
    u, v = (axis.ravel() for axis in np.meshgrid(side, side))
    count = len(variate.integral)
    worst = 0.0
    for index in np.unique(np.linspace(0, count - 1, min(count, 4)).astype(int)):
        g = variate.evaluate(u, v, np.full(u.size, index))
        worst = max(worst, abs(float(g.mean(dtype=np.float64)) - float(variate.integral[index])) / rms)
    return worst


def validate(method: Method, family: Family, sizes: Sizes) -> dict:
    """Whether the method's estimates are unbiased, and G is the integral of g; also a warm-up."""
    training = Samples.draw(family.function, family.features, sizes.training, seed=1000)
    accumulator = method.fit(training, 1000, sizes.seconds)
    found: dict[str, object] = {"method": method.name, "integrand": family.name, "valid": True}
    for sampler in method.samplers:
        estimates = accumulator.estimate(family.function, sizes.samples, sizes.repeats, 1001, sampler)
        score, limit = bias_score(estimates - family.integrals)
        found[f"t, {sampler}"] = score
        found["valid"] &= abs(score) < limit
    if isinstance(accumulator, ControlVariate):
        rms = float(np.sqrt(np.mean(training.values.astype(np.float64) ** 2)))
        found["integral_error"] = integral_error(accumulator, rms)
        found["valid"] &= found["integral_error"] < QUADRATURE_TOLERANCE
    return found


def timed_estimate(
    accumulator: Estimator, family: Family, samples: int, repeats: int, seed: int, sampler: str
) -> tuple[np.ndarray, float]:
    """Errors (repeats, points), and seconds without training."""
    begun = time.perf_counter()
    estimates = accumulator.estimate(family.function, samples, repeats, seed, sampler)
    seconds = time.perf_counter() - begun - sum(accumulator.trainings)
    return estimates - family.integrals, seconds


def equal_samples(
    methods: Iterable[Method], family: Family, sizes: Sizes
) -> tuple[list[dict], dict[Method, Estimator]]:
    """One row for each method and sampler: error at equal samples, cost of training and of a sample.

    Methods take turns, so that what disturbs the machine disturbs all of them. Also returns what each
    has learned at last.
    """
    records: dict[tuple[Method, str], Record] = {}
    fitted: dict[Method, Estimator] = {}
    for fit in range(sizes.fits):
        training = Samples.draw(family.function, family.features, sizes.training, seed=fit)
        for method in methods:
            begun = time.perf_counter()
            accumulator = fitted[method] = method.fit(training, fit, sizes.seconds)
            fit_seconds = time.perf_counter() - begun
            for sampler in method.samplers:
                errors, seconds = timed_estimate(
                    accumulator, family, sizes.samples, sizes.repeats, 1000 + fit, sampler
                )
                record = records.setdefault((method, sampler), Record())
                record.fit_seconds.append(fit_seconds + [0.0, *accumulator.trainings][-1])
                record.nanoseconds.append(seconds / (errors.size * sizes.samples) * 1e9)
                record.mean_square.append(float(np.mean(errors**2)))
                record.errors.append(errors)
    plain = float(family.spread().mean()) / sizes.samples
    return [_row(family, *key, sizes, plain, record) for key, record in records.items()], fitted


def _row(
    family: Family, method: Method, sampler: str, sizes: Sizes, plain: float, record: Record
) -> dict:
    # What float32 leaves of an estimate is no error of the method.
    floor = (1e-7 * float(np.abs(family.integrals).mean())) ** 2
    mean_square = np.maximum(record.mean_square, floor)
    return {
        "integrand": family.name,
        "points": family.points,
        "method": method.name,
        "source": method.source,
        "sampler": sampler,
        "training_samples": sizes.training if method.learns else 0,
        "samples": sizes.samples,
        "estimates": sizes.repeats * sizes.fits * family.points,
        "mean_square_error": float(np.median(mean_square)),
        "variance_reduction": float(np.median(plain / mean_square)),
        "variance_reduction_range": [
            float((plain / mean_square).min()),
            float((plain / mean_square).max()),
        ],
        "bias_t": bias_score(np.stack(record.errors))[0],
        "training_seconds": float(np.median(record.fit_seconds)) if method.learns else 0.0,
        "training_seconds_range": [min(record.fit_seconds), max(record.fit_seconds)],
        "ns_a_sample": float(np.median(record.nanoseconds)),
        "ns_a_sample_range": [min(record.nanoseconds), max(record.nanoseconds)],
    }


def equal_time(
    fitted: dict[Method, Estimator],
    family: Family,
    sizes: Sizes,
    rows: list[dict],
    budgets: tuple[float, ...],
    costs: tuple[float, ...],
) -> list[dict]:
    """Variance of plain Monte Carlo over the mean square error in the same seconds, training included.

    Seconds are for all integrals of the family together. The test integrands cost next to nothing, so
    `costs` (ns) are added to the clock, not waited for, for each of their values. Samples: what the
    measured cost of one leaves room for, in the seconds left by training; a method that trains for more
    than half of the budget learns anew in that half. Under independent samples the error goes exactly as
    one over their number; under others it is measured at the largest power of two that has room, up to
    `sizes.largest`, and beyond goes on as 1 / n: where they do better, the figure is a lower bound
    ("at_least").
    """
    by_key = {(row["method"], row["sampler"]): row for row in rows}
    plain_ns = by_key["Monte Carlo", "independent"]["ns_a_sample"]
    variance = float(family.spread().mean())
    floor = (1e-7 * float(np.abs(family.integrals).mean())) ** 2
    sized = {method: SizedErrors(accumulator, family, sizes) for method, accumulator in fitted.items()}
    for method, errors in sized.items():
        # Over all fits, which is better known than of the last one alone.
        row = by_key[method.name, "independent"]
        errors.measured[sizes.samples, "independent"] = row["mean_square_error"]
    found = []
    for budget in budgets:
        for method, errors in sized.items():
            fit_seconds = by_key[method.name, method.samplers[0]]["training_seconds"]
            if fit_seconds > budget / 2:
                training = Samples.draw(family.function, family.features, sizes.training, seed=0)
                begun = time.perf_counter()
                errors = SizedErrors(method.fit(training, 0, budget / 2), family, sizes)
                fit_seconds = time.perf_counter() - begun
            for sampler, cost in itertools.product(method.samplers, costs):
                row = by_key[method.name, sampler]
                drawn = row["training_samples"] * (plain_ns + cost)
                left = (budget - fit_seconds) * 1e9 / family.points - drawn
                count = left / (row["ns_a_sample"] + cost)
                result = {
                    "integrand": family.name,
                    "method": method.name,
                    "sampler": sampler,
                    "seconds": budget,
                    "ns_a_value": cost,
                    "training_seconds": fit_seconds,
                    "samples": max(0, int(count)),
                    "variance_reduction": None,
                    "at_least": False,
                }
                if count >= FEWEST_SAMPLES:
                    plain_count = budget * 1e9 / family.points / (plain_ns + cost)
                    error = max(errors.at(int(count), sampler), floor)
                    result["variance_reduction"] = variance / plain_count / error
                    result["at_least"] = sampler != "independent" and count > 2 * sizes.largest
                found.append(result)
    return found


class SizedErrors:
    """Mean square errors of one accumulator by (samples, sampler), measured when first asked for."""

    def __init__(self, accumulator: Estimator, family: Family, sizes: Sizes) -> None:
        self._estimator, self._family, self._sizes = accumulator, family, sizes
        self.measured: dict[tuple[int, str], float] = {}

    def at(self, count: int, sampler: str) -> float:
        """At `count` samples, from the nearest size that is measured."""
        sizes = self._sizes
        size = sizes.samples
        if sampler != "independent":
            size = 1 << (min(count, sizes.largest).bit_length() - 1)
        if (size, sampler) not in self.measured:
            fewest = max(1, FEWEST_ERRORS // self._family.points)
            repeats = min(max(fewest, sizes.repeats * sizes.samples // size), sizes.repeats)
            errors, _ = timed_estimate(self._estimator, self._family, size, repeats, 2000, sampler)
            self.measured[size, sampler] = float(np.mean(errors**2))
        return self.measured[size, sampler] * size / count
