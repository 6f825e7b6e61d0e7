"""Checkpoints: the state of a render in a file, from which it can go on to the same bits."""

from __future__ import annotations

import itertools
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..estimation.image_estimate import ImageEstimate
from ..host.files import (
    ANY,
    array_of,
    json_of,
    read_arrays,
    record_of,
    save_arrays,
    whole_number,
    write_whole,
)
from ..learning.density import DensityNetwork
from ..network.network import Network
from ..sampling.accumulate import Estimate
from ..sampling.guide import GUIDE_CELLS, Guide
from ..sampling.warp import DENSITY_WORDS
from ..settings.options import MOST_SAMPLES

# The parts of a checkpoint that are kept as JSON.
ABOUT = ("identity", "method", "edges", "direct_edges")


class CheckpointError(ValueError):
    """A checkpoint that this render cannot resume: broken, or of another render."""


@dataclass(frozen=True)
class Progress:
    """An `ImageEstimate` between two passes.

    Attributes
    ----------
    edges : list of int
        Where the passes done began and ended, in samples a point on average: 0, ...
    states : list of (ndarray, ndarray)
        Each accumulator's state and its points' numbers of samples.
    parts : list of ndarray
        As `ImageEstimate` keeps them.
    ahead : ndarray, optional
        bool (points,), the points that have come of a step of passes, where others have not.
    ahead_to : int
        The pass that these are done to.
    """

    edges: list[int]
    states: list[tuple[np.ndarray, np.ndarray]]
    parts: list[np.ndarray]
    ahead: np.ndarray | None = None
    ahead_to: int = 0

    @classmethod
    def of(cls, estimate: ImageEstimate) -> Progress:
        """Of an estimate under way."""
        edges = [int(edge) for edge in estimate.passes.edges[: estimate.done + 1]]
        return cls(edges, estimate.states(), estimate.parts, estimate.ahead, estimate.ahead_to)

    def give_back(self, estimate: ImageEstimate) -> None:
        """Let an estimate that has not begun go on from here."""
        estimate.restore(self.states, self.parts, self.passes, self.ahead, self.ahead_to)

    @property
    def passes(self) -> int:
        """Passes done."""
        return len(self.edges) - 1

    def arrays(self, prefix: str) -> dict[str, np.ndarray]:
        """The arrays of a file, their names after `prefix`."""
        arrays = {f"{prefix}part{number}": part for number, part in enumerate(self.parts)}
        for number, (state, samples) in enumerate(self.states):
            arrays |= {f"{prefix}state{number}": state, f"{prefix}samples{number}": samples}
        if self.ahead is not None:
            arrays |= {
                f"{prefix}ahead": self.ahead,
                f"{prefix}ahead_to": np.array([self.ahead_to], np.int64),
            }
        return arrays

    @classmethod
    def of_arrays(cls, arrays: dict[str, np.ndarray], prefix: str, edges: object) -> Progress:
        """What `arrays` gave; ValueError if one is missing or wrong."""
        states = [
            _state(arrays, prefix, number)
            for number in (0, 1)
            if number == 0 or f"{prefix}state1" in arrays
        ]
        names = [f"{prefix}part{number}" for number in (0, 1)]
        parts = [array_of(arrays, name, np.float64, (ANY, ANY, ANY)) for name in names if name in arrays]
        if f"{prefix}ahead" not in arrays:
            return cls(_edges(edges), states, parts)
        ahead = array_of(arrays, f"{prefix}ahead", np.bool_, (len(states[0][1]),))
        (ahead_to,) = array_of(arrays, f"{prefix}ahead_to", np.int64, (1,)).tolist()
        return cls(_edges(edges), states, parts, ahead, ahead_to)


@dataclass(frozen=True)
class Checkpoint:
    """A render between two passes.

    Attributes
    ----------
    identity : dict
        All that decides the image's bits, by name.
    method : {"mc", "ncv"}
        What was chosen.
    image : Progress
    direct : Progress, optional
        The same of direct light, where that is estimated apart.
    before : Estimate, optional
        Of f, from the training samples or the pilot.
    network, density_network : optional
        The control variate's network, and the one of its density.
    alpha : ndarray, optional
        The control variate's coefficients.
    guide : Guide, optional
        Densities that guide bounces.
    counts : ndarray, optional
        int64 (points,), samples that each point is to get, where that is not what the arrays above say.
    """

    identity: dict[str, object]
    method: str
    image: Progress
    direct: Progress | None
    before: Estimate | None
    network: Network | None
    density_network: DensityNetwork | None
    alpha: np.ndarray | None
    guide: Guide | None
    counts: np.ndarray | None = None

    def save(self, path: str | Path) -> None:
        """Replace `path` in one step: whenever the process is killed, there is an old or a new file."""
        arrays = self.image.arrays("")
        if self.direct is not None:
            arrays |= self.direct.arrays("direct_")
        if self.counts is not None:
            arrays["counts"] = self.counts
        if self.before is not None:
            arrays |= {
                "before_mean": self.before.mean,
                "before_variance": self.before.variance,
                "before_samples": self.before.samples,
            }
        if self.alpha is not None:
            arrays["alpha"] = self.alpha
        if self.guide is not None:
            arrays |= guide_arrays(self.guide)
        direct_edges = None if self.direct is None else self.direct.edges
        edges = (self.image.edges, direct_edges)
        about = dict(zip(ABOUT, (self.identity, self.method, *edges), strict=True))
        arrays["checkpoint"] = np.array(json.dumps(about))
        network = self.network
        if network is None:
            write_whole(path, lambda file: save_arrays(file, arrays))
            return
        arrays |= self.density_network.arrays() if self.density_network is not None else {}
        write_whole(path, lambda file: network.write(file, **arrays))

    @classmethod
    def load(cls, path: str | Path) -> Checkpoint:
        """Read what `save` wrote.

        Raises
        ------
        CheckpointError
            If the file is not a checkpoint.
        """
        try:
            return cls._of_arrays(read_arrays(path))
        except ValueError as error:
            raise CheckpointError(f"{path} is not a checkpoint of ncv_cl: {error}") from error

    @classmethod
    def _of_arrays(cls, arrays: dict[str, np.ndarray]) -> Checkpoint:
        """The checkpoint that `save` wrote as these arrays; ValueError if one is missing or wrong."""
        about = record_of(json_of(arrays, "checkpoint"), "checkpoint", ABOUT)
        if about["method"] not in ("mc", "ncv") or not isinstance(about["identity"], dict):
            raise ValueError("its method or identity is not one")
        network = density = None
        if about["method"] == "ncv":
            network = Network.of_arrays(arrays)
            density = DensityNetwork.of_arrays(arrays, network.description)
        direct = None
        if about["direct_edges"] is not None:
            direct = Progress.of_arrays(arrays, "direct_", about["direct_edges"])
        return cls(
            about["identity"],
            about["method"],
            Progress.of_arrays(arrays, "", about["edges"]),
            direct,
            _before(arrays) if "before_mean" in arrays else None,
            network,
            density,
            array_of(arrays, "alpha", np.float32, (ANY, ANY)) if "alpha" in arrays else None,
            guide_of(arrays),
            _counts(arrays) if "counts" in arrays else None,
        )

    @property
    def is_between_tasks(self) -> bool:
        """Whether some points are ahead of others."""
        return any(one is not None and one.ahead is not None for one in (self.image, self.direct))

    def check_arrays(self, channels: int, points: int, with_density: bool) -> None:
        """Refuse arrays of another number of points, beyond whose end kernels would read.

        Raises
        ------
        CheckpointError
            Naming what does not fit.
        """
        expected = (channels, points)
        alike = {"alpha": self.alpha, "before_mean": None if self.before is None else self.before.mean}
        for name, array in alike.items():
            if array is not None and array.shape != expected:
                raise CheckpointError(f"the checkpoint's {name} must be {expected}, is {array.shape}")
        if self.counts is not None and self.counts.shape != (points,):
            raise CheckpointError(f"the checkpoint's counts must be ({points},), is {self.counts.shape}")
        if self.method == "ncv" and with_density and self.density_network is None:
            raise CheckpointError("the checkpoint lacks the density of its network")

    def check(self, identity: dict[str, object]) -> None:
        """Refuse a checkpoint of a render that differs in anything that decides bits.

        Raises
        ------
        CheckpointError
            Naming what differs.
        """
        # JSON turns tuples into lists.
        asked = json.loads(json.dumps(identity))
        names = [name for name in (self.identity | asked) if self.identity.get(name) != asked.get(name)]
        if names:
            differences = ", ".join(
                f"{name} is {asked.get(name)!r}, was {self.identity.get(name)!r}" for name in names
            )
            raise CheckpointError(f"the checkpoint is of another render: {differences}")


def guide_arrays(guide: Guide) -> dict[str, np.ndarray]:
    """The arrays of a file that hold a guide."""
    return {f"guide_{name}": array for name, array in guide._asdict().items()}


def guide_of(arrays: dict[str, np.ndarray]) -> Guide | None:
    """The guide among the arrays of a file, if there is one; ValueError if it is not well formed."""
    if "guide_means" not in arrays:
        return None
    densities = array_of(arrays, "guide_densities", np.uint32, (GUIDE_CELLS, DENSITY_WORDS))
    means = array_of(arrays, "guide_means", np.float32, (GUIDE_CELLS, 3))
    return Guide(densities, means, array_of(arrays, "guide_needs", np.float32, (GUIDE_CELLS,)))


def _edges(found: object) -> list[int]:
    if not isinstance(found, list) or not found or found[0] != 0:
        raise ValueError("its passes do not begin at 0")
    edges = [whole_number("a pass's end", one, 0, 1 << 62) for one in found]
    if any(one >= following for one, following in itertools.pairwise(edges)):
        raise ValueError("its passes are not one after another")
    return edges


def _numbers_of_samples(arrays: dict[str, np.ndarray], name: str) -> np.ndarray:
    samples = array_of(arrays, name, np.float64, (ANY,))
    if (samples < 0).any() or (samples % 1 != 0).any():
        raise ValueError(f"{name!r} must hold whole numbers")
    return samples


def _state(arrays: dict[str, np.ndarray], prefix: str, number: int) -> tuple[np.ndarray, np.ndarray]:
    samples = _numbers_of_samples(arrays, f"{prefix}samples{number}")
    return array_of(arrays, f"{prefix}state{number}", np.float32, (ANY, len(samples))), samples


def _counts(arrays: dict[str, np.ndarray]) -> np.ndarray:
    counts = array_of(arrays, "counts", np.int64, (ANY,))
    if (counts < 1).any() or (counts > MOST_SAMPLES).any():
        raise ValueError(f"'counts' must hold numbers from 1 to {MOST_SAMPLES}")
    return counts


def _before(arrays: dict[str, np.ndarray]) -> Estimate:
    samples = _numbers_of_samples(arrays, "before_samples")
    mean = array_of(arrays, "before_mean", np.float64, (ANY, len(samples)))
    # NaN where there are fewer than two samples.
    variance = array_of(arrays, "before_variance", np.float64, mean.shape, nan_allowed=True)
    if (variance < 0).any():
        raise ValueError("'before_variance' holds negative values")
    return Estimate(mean, variance, samples)
