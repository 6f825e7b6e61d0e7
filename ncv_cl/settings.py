"""What a render is asked for, checked, and the stopwatch it carries."""

from __future__ import annotations

import math
import numbers
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

from .integrands import Integrand
from .presets import PRESETS
from .sampler import SAMPLERS

METHODS = ("ncv", "mc")


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


@dataclass(frozen=True)
class RenderSettings:
    """What to render and how; see `render` for the meaning of each."""

    integrand: Integrand
    method: str
    sampler: str
    spp: int
    train_spp: float | str
    size: tuple[int, int]
    supersample: int
    seed: int
    preset: str

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise ValueError(f"method must be one of {', '.join(METHODS)}, got {self.method!r}")
        if self.sampler not in SAMPLERS:
            raise ValueError(f"sampler must be one of {', '.join(SAMPLERS)}, got {self.sampler!r}")
        counts = {
            "spp": self.spp,
            "size[0]": self.size[0],
            "size[1]": self.size[1],
            "supersample": self.supersample,
        }
        if self.preset not in PRESETS:
            raise ValueError(f"preset must be one of {', '.join(PRESETS)}, got {self.preset!r}")
        if self.train_spp != "auto" and not (
            isinstance(self.train_spp, numbers.Real) and 0 < self.train_spp < math.inf
        ):
            raise ValueError(f"train_spp must be a positive number or 'auto', got {self.train_spp!r}")
        for name, value in counts.items():
            if int(value) != value or value < 1:
                raise ValueError(f"{name} must be a whole number of at least 1, got {value!r}")
