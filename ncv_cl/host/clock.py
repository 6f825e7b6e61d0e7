"""Time: a limit and what is left of it, and a stopwatch."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

# Shares of a time limit by which training, and a pilot, must have ended.
TRAINING_SHARE = 0.5
FIRST_SHARE = 0.25
# Adam steps between two checks of the time limit.
CHECKED_STEPS = 32


class OutOfTime(Exception):
    """A stage whose partial result is of no use has reached its share of the time limit."""


class Clock:
    """A time limit, and what is left of it. Without a limit the clock is never asked.

    Parameters
    ----------
    limit : float, optional
        Seconds.
    started : float
        When they began, as `time.perf_counter` says.
    """

    def __init__(self, limit: float | None = None, started: float = 0.0) -> None:
        self.limit = limit
        self._started = started

    def left(self, share: float = 1.0) -> float:
        """Seconds until this share of the limit has passed; infinite without a limit."""
        if self.limit is None:
            return math.inf
        return self._started + share * self.limit - time.perf_counter()

    def over(self, share: float = 1.0) -> bool:
        """Whether this share of the limit has passed."""
        return self.left(share) <= 0.0

    def check(self, share: float = 1.0) -> None:
        """Raise `OutOfTime` if this share of the limit has passed."""
        if self.over(share):
            raise OutOfTime


# Without a limit.
UNLIMITED = Clock()
NO_TIME = "the time limit left none for a control variate; the image is rendered by plain Monte Carlo"


@dataclass
class Stopwatch:
    """Seconds per stage."""

    seconds: dict[str, float] = field(default_factory=dict)

    def add(self, stage: str, seconds: float) -> None:
        self.seconds[stage] = self.seconds.get(stage, 0.0) + seconds

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        started = time.perf_counter()
        yield
        self.add(stage, time.perf_counter() - started)


def never() -> bool:
    """Nobody asks for an end."""
    return False


@dataclass(frozen=True)
class Run:
    """What the stages of one render share beside their data.

    Attributes
    ----------
    watch : Stopwatch
    clock : Clock
    stop : callable
        Asked now and then; True ends the render with what there is.
    progress : bool
        Whether to draw progress bars on a terminal.
    """

    watch: Stopwatch = field(default_factory=Stopwatch)
    clock: Clock = UNLIMITED
    stop: Callable[[], bool] = never
    progress: bool = False
