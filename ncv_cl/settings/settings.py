"""What a render is asked for, checked, and the stopwatch it carries."""

from __future__ import annotations

import math
import numbers
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np

from ..integrands import Integrand
from ..points.sampler import SAMPLERS, HostStream, host_generator, seed_words
from .presets import PRESETS

METHODS = ("auto", "ncv", "mc")
DENSITIES = ("table", "subdivision", "none")
VISIBILITIES = ("auto", "lines", "embree")
ALLOCATIONS = ("magnitude", "pilot", "uniform")
# What the kernels' indices of 32 bits can count.
MOST_SAMPLES = 1 << 31
MOST_CELLS = (1 << 31) - 1


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
    density: str | None = None
    allocation: str | None = None
    target_mse: float | None = None
    time_limit: float | None = None
    skip_dark: bool = True
    visibility: str = "auto"

    def __post_init__(self) -> None:
        self._check_accumulator()
        if self.method not in METHODS:
            raise ValueError(f"method must be one of {', '.join(METHODS)}, got {self.method!r}")
        if self.sampler not in SAMPLERS:
            raise ValueError(f"sampler must be one of {', '.join(SAMPLERS)}, got {self.sampler!r}")
        if self.visibility not in VISIBILITIES:
            raise ValueError(
                f"visibility must be one of {', '.join(VISIBILITIES)}, got {self.visibility!r}"
            )
        if self.preset not in PRESETS:
            raise ValueError(f"preset must be one of {', '.join(PRESETS)}, got {self.preset!r}")
        if self.train_spp != "auto":
            _check_real("train_spp", self.train_spp, MOST_SAMPLES, " or 'auto'")
        _check_whole("spp", self.spp, MOST_SAMPLES)
        if not isinstance(self.size, (tuple, list)) or len(self.size) != 2:
            raise ValueError(f"size must be a width and a height, got {self.size!r}")
        for name, value in (("size[0]", self.size[0]), ("size[1]", self.size[1])):
            _check_whole(name, value, MOST_CELLS)
        _check_whole("supersample", self.supersample, MOST_CELLS)
        if self.size[0] * self.size[1] * self.supersample**2 > MOST_CELLS:
            raise ValueError(
                f"size {self.size[0]} x {self.size[1]} with supersample {self.supersample} makes more "
                f"than {MOST_CELLS} sub-pixels"
            )
        seed_words(self.seed)

    def _check_accumulator(self) -> None:
        if self.density not in (None, *DENSITIES):
            raise ValueError(f"density must be one of {', '.join(DENSITIES)}, got {self.density!r}")
        if self.allocation not in (None, *ALLOCATIONS):
            raise ValueError(
                f"allocation must be one of {', '.join(ALLOCATIONS)}, got {self.allocation!r}"
            )
        learned = self.density not in (None, "none")
        if self.method == "mc" and (learned or self.allocation == "magnitude"):
            raise ValueError(
                "plain Monte Carlo learns no residual: densities 'table' and 'subdivision', and "
                "allocation 'magnitude', need method 'ncv' (allocation 'pilot' suits 'mc')"
            )
        if self.method != "mc" and self.allocation == "pilot":
            raise ValueError("allocation 'pilot' is for method 'mc'; the others take 'magnitude'")
        for name, value in (("target_mse", self.target_mse), ("time_limit", self.time_limit)):
            if value is not None:
                _check_real(name, value, math.inf)

    @property
    def residual_density(self) -> str:
        """One of `DENSITIES`: what the residual is sampled by."""
        if self.method == "mc":
            return "none"
        return self.density or ("table" if PRESETS[self.preset].density else "none")

    @property
    def uses_density(self) -> bool:
        """Whether the residual is sampled by its learned density."""
        return self.residual_density != "none"

    @property
    def allocates(self) -> bool:
        """Whether points get samples by the magnitude of their residual."""
        chosen = self.allocation or ("magnitude" if PRESETS[self.preset].density else "uniform")
        return self.method != "mc" and chosen == "magnitude"

    @property
    def guides(self) -> bool:
        """Whether training also learns where light comes from, for paths behind the first bounce."""
        integrand = self.integrand
        return integrand.nested and integrand.guided and PRESETS[self.preset].density

    def training_points(
        self, active: int, samples_a_point: int, auto_samples: int
    ) -> tuple[np.ndarray, int]:
        """Which of `active` points get training samples, uint32, and how many each.

        Parameters
        ----------
        samples_a_point : int
            Where fewer are asked for on average, so many are drawn at fewer points.
        auto_samples : int
            Samples in all for `train_spp` "auto".
        """
        spp = self.train_spp
        if spp == "auto":
            spp = min(auto_samples / active, max(self.spp / 4, 1.0))
        if not PRESETS[self.preset].subset or spp >= samples_a_point:
            return np.arange(active, dtype=np.uint32), max(1, round(spp))
        count = min(active, max(1, round(active * spp / samples_a_point)))
        # One point at random of each of `count` runs: spread over the image, without a pattern.
        # Runs of whole points: of two that shared one both might pick it, and count its samples twice.
        edges = np.linspace(0, active, count + 1).astype(np.int64)
        generator = host_generator(self.seed, HostStream.TRAINING_POINTS)
        picks = edges[:-1] + (generator.uniform(size=count) * np.diff(edges)).astype(np.int64)
        samples = samples_a_point if active * spp >= samples_a_point else max(1, round(active * spp))
        return picks.astype(np.uint32), samples


def _check_whole(name: str, value: object, most: int) -> None:
    is_number = isinstance(value, numbers.Real) and not isinstance(value, bool)
    if not is_number or not 1 <= value <= most or int(value) != value:
        raise ValueError(
            f"{name} must be a whole number of at least 1 and at most {most}, got {value!r}"
        )


def _check_real(name: str, value: object, most: float, other: str = "") -> None:
    is_number = isinstance(value, numbers.Real) and not isinstance(value, bool)
    if not is_number or not 0 < value <= most or value == math.inf:
        raise ValueError(f"{name} must be a positive number{other}, got {value!r}")
