"""Direct light: from lights, from surfaces that emit, and from outside of the scene."""

from __future__ import annotations

import numpy as np

from ..opencl.device import Device
from ..opencl.layout import Record
from ..opencl.memory import HostArray
from ..opencl.program import build
from ..points.points import ShadingPoints, surface_defines
from ..scene.geometry import SMALLEST_ROUGHNESS
from ..scene.load import Scene
from . import tuning
from .base import Integrand, IntegrandError
from .environment import environment_seen, has_environment, has_image, surroundings
from .light_sources import emissions, hidden_materials, light_sources
from .lights import LIGHT_FILES, emitted_by_lights, light_defines, light_records

# Pieces of surfaces that emit, at most, with which lobes have a strip of the square: each direction of a
# lobe is held against every light. With 320 that pays, with 1280 no more:
# python bench/bench_mesh_lights.py lobes.
MOST_MET = 512
# What tells whether a light reaches a point: its corners, the radius of what stands for a ball, and the
# plane beyond which it shines (of one that shines on both sides one that every point is beyond).
DARK_LIGHT = Record("DARK_LIGHT", {"corners": 12, "reach": 1, "side": 3, "level": 1}, np.float64)
# A sun is seen where the cosine about it is above `least`.
DARK_SUN = Record("DARK_SUN", {"towards": 3, "least": 1}, np.float64)
# What rounding may make of a product in float32, as a part of the sum of its terms: 16 errors.
DARK_MARGIN = 16 * 2.0**-24


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
        if has_image(scene):
            return np.zeros(points.active, bool)
        device = points.surface.device
        wide = np.float64 if device.has_float64 else np.float32
        lights, suns = (one.astype(wide) for one in dark_records(scene))
        dark = HostArray(device, points.active, np.uint8)
        build(device, ("common", "surface", "dark"), dark_defines(device)).kernel("find_dark")(
            points.active,
            point_count=points.active,
            total_points=points.total,
            light_count=len(lights),
            sun_count=len(suns),
            surface=points.surface,
            lights=HostArray.of(device, lights),
            suns=HostArray.of(device, suns),
            dark=dark,
        )
        return dark.read().astype(bool)

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


def dark_defines(device: Device) -> dict[str, int | str]:
    """The `-D` constants of dark.cl."""
    return {
        **surface_defines(),
        **DARK_LIGHT.defines(),
        **DARK_SUN.defines(),
        "WIDE_DOUBLE": int(device.has_float64),
        "MARGIN": f"{0.0 if device.has_float64 else DARK_MARGIN!r}f",
    }


def dark_records(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """What dark.cl reads of a scene whose environment is suns at most, float64.

    Returns
    -------
    lights : (strips, DARK_LIGHT.size)
        One light a strip, which lights whatever the strip's may.
    suns : (suns, DARK_SUN.size)
    """
    bounds = light_sources(scene).lights.bounds()
    one_sided = ~bounds.two_sided
    side = bounds.normal * one_sided[:, None]
    level = np.where(one_sided, np.sum(side * bounds.corner, axis=1), -1.0)
    corners = bounds.corners.transpose(1, 0, 2).reshape(-1, 12)
    lights = DARK_LIGHT.pack(corners=corners, reach=bounds.reach, side=side, level=level)
    suns = surroundings(scene).suns if has_environment(scene) else ()
    records = [DARK_SUN.pack(towards=sun.towards, least=-np.sin(sun.half_angle) - 1e-6) for sun in suns]
    return lights, np.array(records).reshape(-1, DARK_SUN.size)


def scattering_defines(scene: Scene) -> dict[str, int | str]:
    """The `-D` constants of bsdf.cl and bounce.cl."""
    return {
        "HAS_SPECULAR": int(any(material.has_lobe for material in scene.materials)),
        "HAS_GLASS": int(scene.has_glass),
        # What is smooth is not rough by a rounding.
        "SMOOTH_GLASS": f"{SMALLEST_ROUGHNESS * (1 + 1e-6)!r}f",
    }
