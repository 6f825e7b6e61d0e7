"""Direct light from quad area lights."""

from __future__ import annotations

import numpy as np

from ..points.points import ShadingPoints
from ..scene.geometry import SMALLEST_ROUGHNESS
from ..scene.load import QuadLight, Scene
from . import tuning
from .base import Integrand, IntegrandError
from .lights import emitted_by_lights, light_defines, light_records


class DirectLight(Integrand):
    """F(p) = ∫ f_r L_e G V dA over the surfaces of all area lights, RGB.

    (u, v) is a point on a light as it is seen from p (lights.cl). Several lights share the unit square
    as strips in u, see `lights.light_rows`, so the integral stays two-dimensional.
    """

    name = "direct"
    files = ("bsdf", "bounce", "lights", "lobe", "direct")
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
        return "find_lobe_shares" if scattering_defines(scene)["HAS_SPECULAR"] else None

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
        for light in scene.lights:
            corners = _corners(light)
            below = np.zeros(len(dark), bool)
            for normal, height in zip(normals, heights, strict=True):
                below |= (corners @ normal[:, dark]).max(axis=0) <= height[dark]
            if not light.two_sided:
                side = np.asarray(light.normal, np.float64)
                below |= side @ position[:, dark] <= side @ np.asarray(light.corner, np.float64)
            dark = dark[below]
        return np.isin(np.arange(position.shape[1]), dark)

    def emitted(self, scene: Scene, light: np.ndarray, outgoing: np.ndarray) -> np.ndarray:
        return emitted_by_lights(scene, light, outgoing)

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
        if not scene.lights:
            raise IntegrandError(
                f"{scene.name} has no light, so direct light is zero everywhere: "
                "add a [[lights]] entry to the scene, or render ambient occlusion"
            )
        for material in scene.materials:
            if material.emission.any() and not self._part:
                raise IntegrandError(
                    f"{scene.name}: material {material.name!r} emits, but direct light is that of "
                    "[[lights]] only: render integrand gi, which finds it, or take its emission away "
                    "(if a mesh file has it: give the mesh a material of the scene)"
                )


class DirectPart(DirectLight):
    """Direct light of area lights as a part of global illumination; surfaces may emit as well."""

    _part = True


def scattering_defines(scene: Scene) -> dict[str, int]:
    """The `-D` constants of bsdf.cl and bounce.cl."""
    return {
        "HAS_SPECULAR": int(any(material.has_lobe for material in scene.materials)),
        "HAS_GLASS": int(scene.has_glass),
        # What is smooth is not rough by a rounding.
        "SMOOTH_GLASS": f"{SMALLEST_ROUGHNESS * (1 + 1e-6)!r}f",
    }


def _corners(light: QuadLight) -> np.ndarray:
    """float64 (4, 3)."""
    corner, edge1, edge2 = (np.asarray(a, np.float64) for a in (light.corner, light.edge1, light.edge2))
    return np.stack([corner, corner + edge1, corner + edge2, corner + edge1 + edge2])
