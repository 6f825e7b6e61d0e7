"""Ambient occlusion: cosine-weighted visibility of the hemisphere."""

from __future__ import annotations

import math

import numpy as np

from ..scene.load import Scene
from .base import Integrand, IntegrandError

MAPPINGS = ("height", "cosine")
# A picture of a smaller mean is black to the eye: on a screen a twentieth of white, by whose code 0.05
# is 63 of 255. It decides a warning only, and no pixel.
BLACK = 0.05


class AmbientOcclusion(Integrand):
    """F(p) = ∫ V(p, ω | radius) (n · ω) / π dω.

    Parameters
    ----------
    radius : float
        Farther occluders do not count, scene units; infinite by default.
    mapping : {"height", "cosine"}
        How (u, v) maps to the hemisphere: the slides' height and azimuth, or cosine-weighted.
    """

    name = "ao"
    files = ("ao",)
    channels = 1
    inputs = ("position", "normal")
    demodulated = False
    emitters_active = True
    sliced = True

    def __init__(self, radius: float = math.inf, mapping: str = "height") -> None:
        if not radius > 0:
            raise IntegrandError(f"ambient occlusion's radius must be positive, got {radius!r}")
        if mapping not in MAPPINGS:
            raise IntegrandError(f"mapping must be one of {', '.join(MAPPINGS)}, got {mapping!r}")
        self.radius = float(radius)
        self.mapping = mapping

    def data(self, scene: Scene) -> np.ndarray:
        return np.array([self.radius], np.float32)

    def remark(self, mean: float) -> str | None:
        if math.isfinite(self.radius) or not mean < BLACK:
            return None
        return (
            f"ambient occlusion came out nearly black, its mean is {100 * mean:.2g} %: in a closed room "
            "every ray meets a wall. Let only near ones count, by --radius or "
            "AmbientOcclusion(radius=...): a few tenths of the room's size"
        )

    def defines(self, scene: Scene) -> dict[str, int | str]:
        numbers = {f"HEMISPHERE_{name.upper()}": number for number, name in enumerate(MAPPINGS)}
        return {**numbers, "HEMISPHERE": MAPPINGS.index(self.mapping), "CHANNELS": self.channels}
