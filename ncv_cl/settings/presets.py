"""Named choices of network and training schedule."""

from __future__ import annotations

from dataclasses import dataclass, replace

from ..integrands import Integrand
from ..network.encode import Encoding
from ..network.network import WEIGHT_GROUPS, NetworkDescription
from . import tuning
from .schedule import Schedule

# More than any image has points: the whole frame is one minibatch.
_WHOLE_FRAME = 1 << 31


@dataclass(frozen=True)
class Preset:
    """A network and how it is trained.

    Attributes
    ----------
    hidden, modulated, demodulates
        As in `NetworkDescription`; `demodulates` takes effect where the integrand asks for it.
    grid_levels, grid_features, grid_base, grid_entries
        As in `Encoding`.
    schedule : Schedule
    subset : bool
        Whether training may draw its samples at some of the points, when there are many.
    density : bool
        Whether samples follow the learned magnitude of the residual, over the square and over the image.
    """

    hidden: tuple[int, int]
    modulated: tuple[str, ...]
    demodulates: bool
    grid_levels: int
    grid_features: int
    grid_base: int
    grid_entries: int
    schedule: Schedule
    subset: bool
    density: bool

    def description(self, integrand: Integrand, inputs: tuple[str, ...]) -> NetworkDescription:
        """The network for an integrand of which `inputs` vary."""
        encoding = Encoding(
            inputs, self.grid_levels, self.grid_features, self.grid_base, self.grid_entries
        )
        demodulated = self.demodulates and integrand.demodulated
        return NetworkDescription(encoding, integrand.channels, self.hidden, self.modulated, demodulated)


# Little capacity in (u, v), much in φ, many small steps.
_WIDE = Preset(
    hidden=tuning.WIDE_HIDDEN,
    modulated=WEIGHT_GROUPS,
    demodulates=True,
    grid_levels=tuning.GRID_LEVELS,
    grid_features=tuning.GRID_FEATURES,
    grid_base=tuning.GRID_BASE,
    grid_entries=tuning.GRID_ENTRIES,
    schedule=Schedule(),
    subset=True,
    density=True,
)

PRESETS = {
    # Where the density says where the residual is, its last tenth hardly matters.
    "default": replace(_WIDE, hidden=tuning.HIDDEN),
    # The least residual variance, for few integrals of many samples each.
    "wide": _WIDE,
    # The slides' network and schedule: two layers of 32, φ in the first bias alone, one sample of
    # every point an iteration, one Adam step each.
    "slides": Preset(
        hidden=(32, 32),
        modulated=("B1",),
        demodulates=False,
        grid_levels=4,
        grid_features=2,
        grid_base=8,
        grid_entries=1 << 15,
        schedule=Schedule(
            batch=_WHOLE_FRAME,
            samples_a_step=1,
            epochs=1,
            final_rate=1e-2,
            table_rate=1.0,
            table_adam=True,
            weight_power=0.0,
        ),
        subset=False,
        density=False,
    ),
}
