"""All settings of a render, checked."""

from __future__ import annotations

import dataclasses
import numbers
from dataclasses import dataclass, field

import numpy as np

from ..integrands import Integrand
from ..network.network import Network
from ..points.sampler import HostStream, host_generator, seed_words
from .options import (
    MOST_CELLS,
    MOST_SAMPLES,
    Files,
    Sampling,
    Stopping,
    Training,
    changed,
    checked_whole,
)
from .presets import PRESETS, Preset

METHODS = ("auto", "ncv", "mc")
# Allocations by what is predicted of the residual.
BY_RESIDUAL = ("magnitude", "relative")


@dataclass(frozen=True)
class Settings:
    """What to render and how; see `render` and the groups of options for the meaning of each.

    Attributes
    ----------
    method : {"auto", "ncv", "mc"}
        Once the render is planned, "ncv" or "mc".
    """

    integrand: Integrand
    method: str
    spp: int
    size: tuple[int, int]
    seed: int
    sampling: Sampling = field(default_factory=Sampling)
    training: Training = field(default_factory=Training)
    stopping: Stopping = field(default_factory=Stopping)

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise ValueError(f"method must be one of {', '.join(METHODS)}, got {self.method!r}")
        object.__setattr__(self, "spp", checked_whole("spp", self.spp, MOST_SAMPLES))
        if not isinstance(self.size, (tuple, list, np.ndarray)) or len(self.size) != 2:
            raise ValueError(f"size must be a width and a height, got {self.size!r}")
        size = tuple(checked_whole(f"size[{k}]", self.size[k], MOST_CELLS) for k in (0, 1))
        object.__setattr__(self, "size", size)
        if self.columns * self.rows > MOST_CELLS:
            raise ValueError(
                f"size {self.size[0]} x {self.size[1]} with supersample {self.sampling.supersample} "
                f"makes more than {MOST_CELLS} sub-pixels"
            )
        seed_words(self.seed)
        object.__setattr__(self, "seed", int(self.seed))
        self._check_method()
        if self.sampling.split_direct != "auto" and not self.integrand.splits:
            raise ValueError(
                "split_direct is for integrand gi with its direct light: leave it out for "
                f"{self.integrand.name}"
            )
        by_lines = self.integrand.promises("along_lines") or self.integrand.promises("sliced")
        if self.sampling.visibility == "lines" and not by_lines:
            raise ValueError(
                f"visibility 'lines' is for integrands direct and ao: {self.integrand.name} has no "
                "lines on lights; take 'auto'"
            )

    def _check_method(self) -> None:
        """Raise for options that have no effect with this method."""
        allocation, training = self.sampling.allocation, self.training
        if training.network is not None and training.train_spp != "auto":
            raise ValueError("train_spp has no effect where a network is given: leave one of them out")
        if self.method != "mc":
            if allocation == "pilot":
                raise ValueError("allocation 'pilot' is for method 'mc'; the others take 'magnitude'")
            return
        if allocation in BY_RESIDUAL:
            raise ValueError(
                f"plain Monte Carlo learns no residual: allocation {allocation!r} needs method 'ncv' "
                "(allocation 'pilot' suits 'mc')"
            )
        unused = [
            name
            for name in changed(self.training)
            if (name, self.training.density) != ("density", "none")
        ]
        if unused:
            raise ValueError(
                f"plain Monte Carlo trains and uses no network: {', '.join(unused)} "
                "would have no effect; leave it out, or take method 'ncv' or 'auto'"
            )

    def check_files(self, files: Files) -> None:
        """Raise for a file that this method cannot write."""
        if self.method == "mc" and files.save_network is not None:
            raise ValueError("plain Monte Carlo has no network to save: take method 'ncv' or 'auto'")

    def planned(self, method: str) -> Settings:
        """The same with the method that "auto" stands for."""
        if method == "ncv":
            return dataclasses.replace(self, method=method)
        # Options of a network have no effect then.
        allocation = self.sampling.allocation
        allocation = None if allocation in BY_RESIDUAL else allocation
        sampling = dataclasses.replace(self.sampling, allocation=allocation)
        return dataclasses.replace(self, method=method, sampling=sampling, training=Training())

    @property
    def preset(self) -> Preset:
        """The network and its schedule."""
        return PRESETS[self.training.preset]

    @property
    def columns(self) -> int:
        """Sub-pixels of a row."""
        return int(self.size[0]) * int(self.sampling.supersample)

    @property
    def rows(self) -> int:
        """Sub-pixels of a column."""
        return int(self.size[1]) * int(self.sampling.supersample)

    @property
    def residual_density(self) -> str:
        """Sampling density of the residual: "table", "subdivision" or "none"."""
        if self.method == "mc":
            return "none"
        return self.training.density or ("table" if self.preset.density else "none")

    @property
    def uses_density(self) -> bool:
        """Whether the residual's samples follow a learned density."""
        return self.residual_density != "none"

    @property
    def allocation(self) -> str:
        """How samples are spread over the image: "magnitude", "relative", "pilot" or "uniform"."""
        # Paths' noise is nearly everywhere, so there is little to gain: less mean square error by some
        # hundredths, for relative errors half as large again.
        follows = self.method != "mc" and self.preset.density and not self.integrand.nested
        return self.sampling.allocation or ("magnitude" if follows else "uniform")

    @property
    def needs_magnitude(self) -> bool:
        """Whether the residual's magnitude is learned, for the density or for the allocation."""
        return self.method != "mc" and (self.uses_density or self.allocation in BY_RESIDUAL)

    @property
    def guides(self) -> bool:
        """Whether training also learns densities that guide bounces behind the first."""
        integrand = self.integrand
        return integrand.nested and integrand.guided and self.preset.density

    def training_points(
        self, active: int, samples_a_point: int, auto_spp: float
    ) -> tuple[np.ndarray, int]:
        """Which of `active` points get training samples, uint32, and how many each.

        Parameters
        ----------
        samples_a_point : int
            Where fewer are asked for on average, so many are drawn at fewer points.
        auto_spp : float
            Samples a point on average for `train_spp` "auto".
        """
        spp = self.training.train_spp
        if spp == "auto":
            spp = auto_spp
        if not self.preset.subset or spp >= samples_a_point:
            return np.arange(active, dtype=np.uint32), max(1, round(spp))
        count = min(active, max(1, round(active * spp / samples_a_point)))
        # The points are cut into `count` runs, and one is taken at random from each: spread over the
        # image, without a pattern. Runs share no point, or two runs might both take it and count its
        # samples twice.
        edges = np.linspace(0, active, count + 1).astype(np.int64)
        generator = host_generator(self.seed, HostStream.TRAINING_POINTS)
        picks = edges[:-1] + (generator.uniform(size=count) * np.diff(edges)).astype(np.int64)
        samples = samples_a_point if active * spp >= samples_a_point else max(1, round(active * spp))
        return picks.astype(np.uint32), samples

    def options(self, *groups: str) -> dict[str, object]:
        """The options of some groups, as JSON can hold them; a network by its digest."""
        found: dict[str, object] = {}
        for name in groups:
            group = getattr(self, name)
            for one in dataclasses.fields(group):
                value = getattr(group, one.name)
                if isinstance(value, Network):
                    value = value.digest
                if value is None or isinstance(value, (str, numbers.Real)):
                    found[one.name] = value
        return found
