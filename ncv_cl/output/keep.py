"""Files that a render writes beside its picture: checkpoints, and the trained network."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ..estimation.allocate import Allocation
from ..estimation.control_variate import ControlVariate
from ..estimation.direct import DirectEstimate
from ..estimation.image_estimate import ImageEstimate
from ..network.network import Network
from ..sampling.accumulate import Estimate
from ..sampling.guide import Guide
from .checkpoint import Checkpoint, Progress, guide_arrays


@dataclass
class Keep:
    """Which files to write, the render's identity, and the checkpoint to resume.

    A file that cannot be written does not end the render: there is one warning, and a note in
    `not_written`.

    Attributes
    ----------
    checkpoint, network : str or Path, optional
    identity : dict
        All that decides the image's bits.
    resumed : Checkpoint, optional
    not_written : dict
        The error by path.
    """

    checkpoint: str | Path | None = None
    network: str | Path | None = None
    identity: dict[str, object] = field(default_factory=dict)
    resumed: Checkpoint | None = None
    not_written: dict[str, str] = field(default_factory=dict)

    def save_network(
        self, network: Network, companions: dict[str, np.ndarray], guide: Guide | None = None
    ) -> None:
        """Write the trained network, if it is wanted, and what was learned with it."""
        path = self.network
        if path is not None:
            more = companions if guide is None else companions | guide_arrays(guide)
            self._attempt(path, lambda: network.save(path, **more))

    def note_no_network(self) -> None:
        """Note that there is no network to write."""
        if self.network is not None:
            self._failed(self.network, "no network was trained")

    def write(
        self,
        image_estimate: ImageEstimate,
        before: Estimate | None,
        variate: ControlVariate | None,
        guide: Guide | None,
        direct: DirectEstimate | None = None,
        allocation: Allocation | None = None,
    ) -> None:
        """Write a checkpoint, if it is wanted; with an `allocation` that must not be made again."""
        path = self.checkpoint
        if path is None:
            return
        counts = None
        if allocation is not None:
            counts = np.empty_like(allocation.counts)
            counts[allocation.chosen] = allocation.counts
        found = Checkpoint(
            identity=self.identity,
            method="mc" if variate is None else "ncv",
            image=Progress.of(image_estimate),
            direct=Progress.of(direct.image_estimate) if direct is not None else None,
            before=before,
            network=variate.folded.network if variate else None,
            density_network=variate.density_network if variate else None,
            alpha=variate.alpha if variate else None,
            guide=guide,
            counts=counts,
        )
        self._attempt(path, lambda: found.save(path))

    def _attempt(self, path: str | Path, write: Callable[[], None]) -> None:
        try:
            write()
        except (OSError, MemoryError) as error:
            self._failed(path, str(error) or "not enough memory")
        else:
            self.not_written.pop(str(path), None)

    def _failed(self, path: str | Path, why: str) -> None:
        if str(path) not in self.not_written:
            warnings.warn(f"{path} is not written: {why}", stacklevel=6)
        self.not_written[str(path)] = why
