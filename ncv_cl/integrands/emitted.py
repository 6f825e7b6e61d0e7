"""Light that shading points emit themselves, beside what they scatter."""

from __future__ import annotations

import numpy as np

from ..points.points import ShadingPoints
from ..scene.load import Scene
from .base import Integrand


def emitted_light(scene: Scene, integrand: Integrand, points: ShadingPoints) -> np.ndarray:
    """Radiance towards the viewer that lights and materials emit, float32 (points.total, 3).

    Sensors, which are on no surface, emit nothing.
    """
    found = np.zeros((points.total, 3), np.float32)
    if points.material is None:
        return found
    lit = np.flatnonzero(points.light >= 0)
    if lit.size:
        # Most integrands have them last.
        outgoing = points.rows("outgoing", range(lit[0], points.total))[:, lit - lit[0]]
        found[lit] = integrand.emitted(scene, points.light[lit], outgoing)
    glow = integrand.glow(scene, points.material)
    if not glow.any():
        return found
    return found + (glow if points.emission_factor is None else glow * points.emission_factor)
