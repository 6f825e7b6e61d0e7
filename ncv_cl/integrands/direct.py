"""Direct light from quad area lights."""

from __future__ import annotations

import numpy as np

from ..points import RELATIVE_OFFSET, ShadingPoints
from ..scene import QuadLight, Scene
from .base import Integrand, IntegrandError

LIGHT_FLOATS = 20


class DirectLight(Integrand):
    """F(p) = ∫ f_r L_e G V dA over the surfaces of all area lights, RGB.

    (u, v) is a point on a light. Several lights share the unit square as strips in u, each as wide as
    its share of the emitted power, so the integral stays two-dimensional.
    """

    name = "direct"
    files = ("bsdf", "lights", "direct")
    channels = 3
    inputs = ("position", "normal", "outgoing", "albedo", "roughness")
    demodulated = True
    emitters_active = False
    to_lights = True

    def data(self, scene: Scene) -> np.ndarray:
        self._check(scene)
        return light_records(scene.lights)

    def defines(self, scene: Scene) -> dict[str, int]:
        self._check(scene)
        return {"CHANNELS": self.channels, **light_defines(scene), **scattering_defines(scene)}

    def dark(self, scene: Scene, points: ShadingPoints) -> np.ndarray:
        # Cosines times distances are affine on a light, so their signs at its corners decide. They are
        # taken as n.y - n.x: four numbers a light instead of four vectors a point.
        position, *normals = (
            points.rows(name)[:, : points.active].astype(np.float64)
            for name in ("position", "normal", "geometric_normal")
        )
        heights = [(normal * position).sum(axis=0) for normal in normals]
        dark = np.ones(position.shape[1], bool)
        for light in scene.lights:
            corners = _corners(light)
            below = np.zeros_like(dark)
            for normal, height in zip(normals, heights, strict=True):
                below |= (corners @ normal).max(axis=0) <= height
            if not light.two_sided:
                side = np.asarray(light.normal, np.float64)
                below |= side @ position <= side @ np.asarray(light.corner, np.float64)
            dark &= below
        return dark

    def emitted(self, scene: Scene, light: np.ndarray, outgoing: np.ndarray) -> np.ndarray:
        return emitted_by_lights(scene, light, outgoing)

    @staticmethod
    def _check(scene: Scene) -> None:
        if not scene.lights:
            raise IntegrandError(
                f"{scene.name} has no light, so direct light is zero everywhere: "
                "add a [[lights]] entry to the scene, or render ambient occlusion"
            )
        for material in scene.materials:
            if material.emission.any():
                raise IntegrandError(
                    f"{scene.name}: material {material.name!r} emits, but direct light is that of "
                    "[[lights]] only: render integrand gi, which finds it, or take its emission away "
                    "(if a mesh file has it: give the mesh a material of the scene)"
                )


def light_records(lights: tuple[QuadLight, ...]) -> np.ndarray:
    """What lights.cl reads of the lights, float32 (lights * LIGHT_FLOATS,)."""
    if not lights:
        return np.zeros(0, np.float32)
    widths = strip_widths(lights)
    firsts = np.concatenate([[0.0], np.cumsum(widths)[:-1]])
    return np.concatenate(
        [
            _light_record(light, first, width)
            for light, first, width in zip(lights, firsts, widths, strict=True)
        ]
    )


def light_defines(scene: Scene) -> dict[str, int]:
    """The `-D` constants of lights.cl."""
    return {"LIGHT_COUNT": len(scene.lights), "LIGHT_FLOATS": LIGHT_FLOATS}


def scattering_defines(scene: Scene) -> dict[str, int]:
    """The `-D` constants of bsdf.cl and bounce.cl."""
    return {"HAS_SPECULAR": int(any(np.any(m.reflectance > 0) for m in scene.materials))}


def emitted_by_lights(scene: Scene, light: np.ndarray, outgoing: np.ndarray) -> np.ndarray:
    """As `Integrand.emitted`, for area lights."""
    radiance = np.array([one.radiance for one in scene.lights], np.float32)
    normals = np.array([one.normal for one in scene.lights], np.float32)
    two_sided = np.array([one.two_sided for one in scene.lights])
    front = np.einsum("pi,ip->p", normals[light], outgoing) > 0
    return radiance[light] * (front | two_sided[light])[:, None]


def strip_widths(lights: tuple[QuadLight, ...]) -> np.ndarray:
    """Each light's share of the unit square's u axis: its share of the emitted power, float64."""
    power = np.array([light.area * np.mean(light.radiance) * (1 + light.two_sided) for light in lights])
    # Lights that are switched off keep a sliver, so that every strip has a width to divide by.
    power = np.maximum(power, 1e-6 * max(power.max(), 1e-30))
    return power / power.sum()


def _corners(light: QuadLight) -> np.ndarray:
    """float64 (4, 3)."""
    corner, edge1, edge2 = (np.asarray(a, np.float64) for a in (light.corner, light.edge1, light.edge2))
    return np.stack([corner, corner + edge1, corner + edge2, corner + edge1 + edge2])


def _light_record(light: QuadLight, first: float, width: float) -> np.ndarray:
    corners = np.abs(light.corner) + np.abs(light.edge1) + np.abs(light.edge2)
    radiance = np.asarray(light.radiance, float) * light.area / width
    offset = RELATIVE_OFFSET * corners.max()
    record = [
        *light.corner,
        *light.edge1,
        *light.edge2,
        *light.normal,
        *radiance,
        first,
        width,
        float(light.two_sided),
        offset,
        width / light.area,
    ]
    return np.array(record, np.float32)
