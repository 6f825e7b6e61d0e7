"""Global illumination: direct light and all that comes by way of other surfaces."""

from __future__ import annotations

import numpy as np

from ..scene.load import Scene
from .base import Integrand, IntegrandError
from .direct import DirectPart, scattering_defines
from .environment import environment_seen, has_environment
from .light_sources import emissions, hidden_materials, light_sources
from .lights import LIGHT_FILES, emitted_by_lights, light_defines, light_records


class GlobalIllumination(Integrand):
    """F(p) = ∫ f_r L_i cos dω over the upper hemisphere, L_i estimated by one path, RGB.

    (u, v) is the direction of the first bounce, and at once a point on a light, as for `DirectLight`.
    The light from that direction is a nested integral; each sample has one noisy estimate of it.

    Parameters
    ----------
    max_depth : int, optional
        Most edges of a path from the camera to a light, as Mitsuba's path integrator counts them: 2 is
        direct light alone, 3 adds one bounce. By default Russian roulette alone ends paths.
    direct : bool
        Whether light that reaches the shading points directly from lights, and from surfaces that are
        sampled as lights, is included.
    clamp : float, optional
        Upper limit of the largest channel of one path's radiance. It lowers noise, and makes the image
        too dark.
    guided : bool
        Whether training also learns densities that guide bounces behind the first; with preset "slides"
        it never does.
    """

    name = "gi"
    files = ("bsdf", "bounce", "dielectric", *LIGHT_FILES, "environment", "gi")
    channels = 3
    inputs = ("position", "normal", "outgoing", "albedo", "roughness")
    demodulated = False
    emitters_active = False
    nested = True

    def __init__(
        self,
        max_depth: int | None = None,
        direct: bool = True,
        clamp: float | None = None,
        guided: bool = True,
    ) -> None:
        if max_depth is not None and (int(max_depth) != max_depth or max_depth < 2):
            raise IntegrandError(f"max_depth must be a whole number of at least 2, got {max_depth!r}")
        if clamp is not None and not clamp > 0:
            raise IntegrandError(f"clamp must be positive, got {clamp!r}")
        self.max_depth = None if max_depth is None else int(max_depth)
        self.direct = bool(direct)
        self.clamp = None if clamp is None else float(clamp)
        self.guided = bool(guided)

    # Of other integrands the class decides these two.
    @property
    def splits(self) -> bool:  # type: ignore[override]
        """Whether direct light may be estimated apart from the rest."""
        return self.direct

    def apart(self, scene: Scene) -> tuple[Integrand, Integrand] | None:
        only_direct = self.max_depth == 2 and not hidden_materials(scene).any()
        lit = len(light_sources(scene).lights.strip) or has_environment(scene)
        if not self.direct or not lit or only_direct:
            return None
        rest = GlobalIllumination(self.max_depth, direct=False, clamp=self.clamp, guided=self.guided)
        return DirectPart(), rest

    @property
    def to_lights(self) -> bool:  # type: ignore[override]
        """Whether there are rays of the first bounce's light sampling; paths trace theirs elsewhere."""
        return self.direct

    def data(self, scene: Scene) -> np.ndarray:
        if not scene.lights and not emissions(scene).any() and not has_environment(scene):
            raise IntegrandError(
                f"{scene.name} has no light, so global illumination is zero everywhere: "
                "add a [[lights]] entry or an [environment] to the scene, or give a material an emission"
            )
        return light_records(scene)

    def defines(self, scene: Scene) -> dict[str, int | str]:
        return {
            "CHANNELS": self.channels,
            "DIRECT": int(self.direct),
            **light_defines(scene),
            **scattering_defines(scene),
        }

    def emitted(self, scene: Scene, light: np.ndarray, outgoing: np.ndarray) -> np.ndarray:
        if not self.direct:
            return np.zeros((len(light), 3), np.float32)
        return emitted_by_lights(scene, light, outgoing)

    def background(self, scene: Scene, directions: np.ndarray) -> np.ndarray | None:
        return environment_seen(scene, directions) if self.direct else None

    def glow(self, scene: Scene, material: np.ndarray) -> np.ndarray:
        return emissions(scene)[material]
