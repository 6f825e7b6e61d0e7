"""From curves of error against samples and seconds: what an error costs, and from where a method pays.

A curve is one method's measured points in the order of their samples. Error is interpolated in
logarithms of error and samples, seconds linearly in samples: a render takes fixed seconds and a cost
per sample. A point that is worse than one with fewer samples, or slower than one with more, is noise and
is left out.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np

# Stages whose seconds do not grow with the samples, but with training, whose size depends on both.
SETUP_STAGES = ("train", "integration")
# Errors at which two curves are compared, evenly in the logarithm, from the largest to the smallest
# that both reach.
GRID = 2001


@dataclass(frozen=True)
class Curve:
    """One method's points, fewest samples first; all arrays are (points,) float64.

    Attributes
    ----------
    samples, seconds, errors
        Samples a shading point, total seconds, mean square error.
    setup
        Seconds of training and integration, in `seconds` as well.
    """

    samples: np.ndarray
    seconds: np.ndarray
    errors: np.ndarray
    setup: np.ndarray

    @classmethod
    def of(cls, points: list[dict]) -> Curve:
        """From rows with `spp`, `seconds`, `mse` and `stages`, less those that others outdo.

        Raises
        ------
        ValueError
            If no point has a positive error.
        """
        rows = sorted(
            (
                p["spp"],
                p["seconds"],
                p["mse"],
                sum(p["stages"].get(stage, 0.0) for stage in SETUP_STAGES),
            )
            for p in points
            if p["mse"] > 0
        )
        kept: list[tuple[float, ...]] = []
        for row in rows:
            if not kept or row[2] < kept[-1][2]:
                kept.append(row)
        if not kept:
            raise ValueError("a curve needs a point with a positive error")
        found = np.array(kept, dtype=np.float64)
        soonest = np.minimum.accumulate(found[::-1, 1])[::-1]
        return cls(*found[found[:, 1] <= soonest].T)

    def samples_to(self, error: float | np.ndarray) -> np.ndarray:
        """Samples that reach an error; beyond the last point along the last two points' line."""
        asked = np.log(np.atleast_1d(np.asarray(error, dtype=np.float64)))
        log_errors, log_samples = np.log(self.errors), np.log(self.samples)
        found = np.interp(asked, log_errors[::-1], log_samples[::-1])
        if len(self.errors) > 1:
            slope = np.diff(log_samples[-2:])[0] / np.diff(log_errors[-2:])[0]
            beyond = asked < log_errors[-1]
            found[beyond] = log_samples[-1] + slope * (asked[beyond] - log_errors[-1])
        return np.exp(found)

    def seconds_to(self, error: float | np.ndarray) -> np.ndarray:
        """Seconds that reach an error or a smaller one; the first point's for all larger errors."""
        samples = self.samples_to(error)
        found = np.interp(samples, self.samples, self.seconds)
        beyond = samples > self.samples[-1]
        _, cost = self.cost(self.samples[-1])
        found[beyond] += cost * (samples[beyond] - self.samples[-1])
        return found

    def cost(self, samples: float) -> tuple[float, float]:
        """Seconds of setup, and seconds per sample of all else, at a number of samples."""
        setup = float(np.interp(samples, self.samples, self.setup))
        return setup, (float(np.interp(samples, self.samples, self.seconds)) - setup) / samples


@dataclass(frozen=True)
class Crossover:
    """Where one method begins to be faster than another to the same error, and why.

    Attributes
    ----------
    status : {"at", "always", "never"}
        "always" and "never" speak of what was measured: to the smallest error that both reached.
    plain_samples, our_samples, seconds, error : float or None
        At the crossing.
    end_error, end_plain_samples, end_gain : float
        The smallest error that both reached, the other method's samples there, and its seconds over
        ours.
    fixed_seconds : float
        Our training and integration at `end_error`, less the other's.
    plain_cost, our_cost : float
        Seconds per sample a point of all else, there.
    samples_ratio : float
        The other's samples over ours at `end_error`.
    """

    status: str
    plain_samples: float | None
    our_samples: float | None
    seconds: float | None
    error: float | None
    end_error: float
    end_plain_samples: float
    end_gain: float
    fixed_seconds: float
    plain_cost: float
    our_cost: float
    samples_ratio: float

    @property
    def cost_ratio(self) -> float:
        """What a sample of ours costs, in samples of the other."""
        return self.our_cost / self.plain_cost

    @property
    def rate_gain(self) -> float:
        """How much faster ours is where fixed seconds no longer count, if the ratio of samples stays."""
        return self.samples_ratio / self.cost_ratio

    @property
    def predicted(self) -> float | None:
        """Samples of the other from which ours would pay at these rates; None where it never would."""
        saved = self.plain_cost - self.our_cost / self.samples_ratio
        return max(0.0, self.fixed_seconds / saved) if saved > 0 else None

    def as_dict(self) -> dict[str, object]:
        return asdict(self)


def crossover(plain: Curve, ours: Curve) -> Crossover:
    """From which error on `ours` stays the faster one."""
    end = max(plain.errors[-1], ours.errors[-1])
    start = max(plain.errors[0], ours.errors[0])
    grid = np.geomspace(start, end, GRID)
    # The ends exactly: rounding must not lead outside of what was measured.
    grid[0], grid[-1] = start, end
    gain = np.log(plain.seconds_to(grid) / ours.seconds_to(grid))
    slower = np.flatnonzero(gain < 0)
    found: tuple[float | None, ...] = (None,) * 4
    if not len(slower):
        status = "always"
    elif slower[-1] == GRID - 1:
        status = "never"
    else:
        status = "at"
        last = slower[-1]
        share = gain[last] / (gain[last] - gain[last + 1])
        error = float(np.exp(np.interp(share, [0, 1], np.log(grid[last : last + 2]))))
        found = (
            float(plain.samples_to(error)[0]),
            float(ours.samples_to(error)[0]),
            float(ours.seconds_to(error)[0]),
            error,
        )
    end_plain, end_ours = float(plain.samples_to(end)[0]), float(ours.samples_to(end)[0])
    (plain_fixed, plain_cost), (our_fixed, our_cost) = plain.cost(end_plain), ours.cost(end_ours)
    return Crossover(
        status,
        *found,
        end_error=float(end),
        end_plain_samples=end_plain,
        end_gain=float(np.exp(gain[-1])),
        fixed_seconds=our_fixed - plain_fixed,
        plain_cost=plain_cost,
        our_cost=our_cost,
        samples_ratio=end_plain / end_ours,
    )


def against_the_better(points: list[dict], others: dict[str, Curve]) -> list[dict]:
    """How a method that chooses fared: at each of its points, the better of others over its seconds.

    Returns
    -------
    list of dict
        `spp`, `better` (the name of the curve that reaches the point's error sooner), `ratio` (its
        seconds over the point's: 1 and more is as good), `ratios`, the same of each curve, `method`,
        what was chosen, and `spread`, the longest of the point's runs over the shortest.
    """
    rows = []
    for point in points:
        if point["mse"] <= 0:
            continue
        needed = {name: float(curve.seconds_to(point["mse"])[0]) for name, curve in others.items()}
        better = min(needed, key=needed.__getitem__)
        ratios = {name: seconds / point["seconds"] for name, seconds in needed.items()}
        shortest, longest = point["seconds_range"]
        row = {"spp": point["spp"], "method": point["method"], "better": better}
        rows.append(row | {"ratio": ratios[better], "ratios": ratios, "spread": longest / shortest})
    return rows
