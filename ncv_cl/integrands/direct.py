"""Direct light: from lights, from surfaces that emit, and from outside of the scene."""

from __future__ import annotations

import numpy as np

from ..points.points import ShadingPoints
from ..scene.geometry import SMALLEST_ROUGHNESS
from ..scene.load import Scene
from . import tuning
from .base import Integrand, IntegrandError
from .environment import environment_dark, environment_seen, has_environment
from .light_sources import emissions, hidden_materials, light_sources
from .lights import LIGHT_FILES, emitted_by_lights, light_defines, light_records

# Pieces of surfaces that emit, at most, with which lobes have a strip of the square: each direction of a
# lobe is held against every light. With 320 that pays, with 1280 no more:
# python bench/bench_mesh_lights.py lobes.
MOST_MET = 512


class DirectLight(Integrand):
    """F(p) = ∫ f_r L_e G V dA over all lights and surfaces that emit, and ∫ f_r L V cos dω outside, RGB.

    (u, v) is a point on a light as it is seen from p (lights.cl), or a direction of the environment
    (environment.cl). Several lights share the unit square
    as strips in u, see `lights.light_rows`, so the integral stays two-dimensional.
    """

    name = "direct"
    files = ("bsdf", "bounce", *LIGHT_FILES, "environment", "lobe", "direct")
    channels = 3
    inputs = ("position", "normal", "outgoing", "albedo", "roughness")
    demodulated = True
    emitters_active = False
    to_lights = True
    along_lines = True
    _part = False

    def data(self, scene: Scene) -> np.ndarray:
        self._check_lights(scene)
        return light_records(scene)

    def defines(self, scene: Scene) -> dict[str, int | str]:
        self._check_lights(scene)
        return {
            "CHANNELS": self.channels,
            "LOBE_SHARE_COUNT": len(tuning.LOBE_SHARES),
            "LOBE_GAIN": f"{tuning.LOBE_GAIN!r}f",
            "LOBE_NEED": f"{tuning.LOBE_NEED!r}f",
            "LOBE_SHARES": ",".join(f"{share!r}f" for share in tuning.LOBE_SHARES),
            **light_defines(scene),
            **scattering_defines(scene),
        }

    def point_kernel(self, scene: Scene) -> str | None:
        few = len(light_sources(scene).lights.strip) - len(scene.lights) <= MOST_MET
        return "find_lobe_shares" if few and scattering_defines(scene)["HAS_SPECULAR"] else None

    def dark(self, scene: Scene, points: ShadingPoints) -> np.ndarray:
        # Cosines times distances are affine on a light, so their signs at its corners decide. They are
        # taken as n.y - n.x: four numbers a light instead of four vectors a point.
        position, *normals = (
            points.rows(name)[:, : points.active].astype(np.float64)
            for name in ("position", "normal", "geometric_normal")
        )
        heights = [(normal * position).sum(axis=0) for normal in normals]
        # Most points are lit by the first lights, and need not be asked about the others.
        dark = np.arange(position.shape[1])
        lights = light_sources(scene).lights.bounds()
        corners = lights.corners
        for light in range(lights.strips):
            below = np.zeros(len(dark), bool)
            for normal, height in zip(normals, heights, strict=True):
                highest = (corners[:, light] @ normal[:, dark]).max(axis=0) + lights.reach[light]
                below |= highest <= height[dark]
            if not lights.two_sided[light]:
                side = lights.normal[light]
                below |= side @ position[:, dark] <= side @ lights.corner[light]
            dark = dark[below]
        if has_environment(scene):
            unlit = [environment_dark(scene, normal[:, dark]) for normal in normals]
            dark = dark[unlit[0] | unlit[1]]
        return np.isin(np.arange(position.shape[1]), dark)

    def background(self, scene: Scene, directions: np.ndarray) -> np.ndarray | None:
        return environment_seen(scene, directions)

    def emitted(self, scene: Scene, light: np.ndarray, outgoing: np.ndarray) -> np.ndarray:
        return emitted_by_lights(scene, light, outgoing)

    def glow(self, scene: Scene, material: np.ndarray) -> np.ndarray:
        return emissions(scene)[material]

    def unseen(self, scene: Scene, material: np.ndarray) -> str | None:
        seen = np.unique(material)
        names = [scene.materials[one].name for one in seen if scene.materials[one].is_glass]
        if not names:
            return None
        return (
            f"{scene.name}: direct light shows of glass only the lights that it reflects, it is black "
            f"otherwise ({', '.join(names)}); what is seen through it needs integrand gi"
        )

    def _check_lights(self, scene: Scene) -> None:
        hidden = np.flatnonzero(hidden_materials(scene))
        if len(hidden) and not self._part:
            raise IntegrandError(
                f"{scene.name}: the emission of material {scene.materials[hidden[0]].name!r} has a "
                "texture or holes, so only paths find it: render integrand gi, or leave it out "
                '(lights = "ignore", if a mesh file has it)'
            )
        if not len(light_sources(scene).lights.strip) and not has_environment(scene):
            raise IntegrandError(
                f"{scene.name} has no light, so direct light is zero everywhere: add a [[lights]] entry "
                "or an [environment] to the scene or give a material an emission, or render ambient "
                "occlusion"
            )


class DirectPart(DirectLight):
    """Direct light as a part of global illumination; paths may find more."""

    _part = True


def scattering_defines(scene: Scene) -> dict[str, int | str]:
    """The `-D` constants of bsdf.cl and bounce.cl."""
    return {
        "HAS_SPECULAR": int(any(material.has_lobe for material in scene.materials)),
        "HAS_GLASS": int(scene.has_glass),
        # What is smooth is not rough by a rounding.
        "SMOOTH_GLASS": f"{SMALLEST_ROUGHNESS * (1 + 1e-6)!r}f",
    }
