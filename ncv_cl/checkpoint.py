"""What a render has so far, in a file: to go on after an interruption as if there had been none."""

from __future__ import annotations

import json
import os
import tempfile
from dataclasses import dataclass
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from .density import DensityNetwork
from .estimate import Estimate
from .guide import Guide
from .network import Network


class CheckpointError(ValueError):
    """A checkpoint that cannot be gone on from: broken, or of another render."""


@dataclass(frozen=True)
class Checkpoint:
    """A render between two passes.

    Attributes
    ----------
    identity : dict
        All that decides the image's bits, by name.
    method : {"mc", "ncv"}
        What was chosen.
    passes : int
        Passes done.
    states : list of (ndarray, ndarray)
        Each estimator's state and its points' numbers of samples.
    before : Estimate, optional
        Of what was sampled before the passes.
    network, density : optional
        The control variate and its density.
    prediction : dict, optional
        Of method "auto".
    alpha : ndarray, optional
        The control variate's coefficients.
    parts : list of ndarray
        As `Estimation` keeps them.
    guide : Guide, optional
        What guides paths.
    """

    identity: dict[str, object]
    method: str
    passes: int
    states: list[tuple[np.ndarray, np.ndarray]]
    before: Estimate | None
    network: Network | None
    density: DensityNetwork | None
    prediction: dict[str, object] | None
    alpha: np.ndarray | None
    parts: list[np.ndarray]
    guide: Guide | None

    def save(self, path: str | Path) -> None:
        """Replace `path` in one step: whenever the process is killed, there is an old or a new file."""
        path = Path(path)
        arrays: dict[str, np.ndarray] = {}
        for number, (state, samples) in enumerate(self.states):
            arrays |= {f"state{number}": state, f"samples{number}": samples}
        arrays |= {f"part{number}": part for number, part in enumerate(self.parts)}
        if self.before is not None:
            arrays |= {
                "before_mean": self.before.mean,
                "before_variance": self.before.variance,
                "before_samples": self.before.samples,
            }
        if self.alpha is not None:
            arrays["alpha"] = self.alpha
        if self.guide is not None:
            arrays |= {f"guide_{name}": array for name, array in self.guide._asdict().items()}
        about = {
            "identity": self.identity,
            "method": self.method,
            "passes": self.passes,
            "prediction": self.prediction,
        }
        arrays["checkpoint"] = np.array(json.dumps(about))
        with tempfile.NamedTemporaryFile(
            dir=path.parent, prefix=path.name, suffix=".part", delete=False
        ) as file:
            try:
                if self.network is None:
                    np.savez(file, **arrays)
                else:
                    companions = self.density.arrays() if self.density is not None else {}
                    self.network.write(file, **arrays, **companions)
                file.flush()
                os.fsync(file.fileno())
                os.replace(file.name, path)
            except BaseException:
                Path(file.name).unlink(missing_ok=True)
                raise

    @classmethod
    def load(cls, path: str | Path) -> Checkpoint:
        """Read what `save` wrote.

        Raises
        ------
        CheckpointError
            If the file is none of ours.
        """
        try:
            with np.load(path) as file:
                arrays = {name: file[name] for name in file.files}
            about = json.loads(str(arrays["checkpoint"]))
        except (OSError, ValueError, KeyError, EOFError, BadZipFile) as error:
            raise CheckpointError(f"{path} is not a checkpoint of ncv_cl: {error}") from error
        states = []
        while f"state{len(states)}" in arrays:
            states.append((arrays[f"state{len(states)}"], arrays[f"samples{len(states)}"]))
        before = None
        if "before_mean" in arrays:
            before = Estimate(*(arrays[f"before_{name}"] for name in ("mean", "variance", "samples")))
        has_network = "about" in arrays
        return cls(
            about["identity"],
            about["method"],
            about["passes"],
            states,
            before,
            Network.load(path) if has_network else None,
            DensityNetwork.load(path) if has_network else None,
            about["prediction"],
            arrays.get("alpha"),
            [arrays[name] for name in ("part0", "part1") if name in arrays],
            Guide(*(arrays[f"guide_{name}"] for name in Guide._fields))
            if "guide_means" in arrays
            else None,
        )

    def check(self, identity: dict[str, object]) -> None:
        """Refuse to go on with a render that would not be the same.

        Raises
        ------
        CheckpointError
            Naming what differs.
        """
        # As it comes back from the file: tuples are lists there.
        asked = json.loads(json.dumps(identity))
        names = [name for name in (self.identity | asked) if self.identity.get(name) != asked.get(name)]
        if names:
            differences = ", ".join(
                f"{name} is {asked.get(name)!r}, was {self.identity.get(name)!r}" for name in names
            )
            raise CheckpointError(f"the checkpoint is of another render: {differences}")
