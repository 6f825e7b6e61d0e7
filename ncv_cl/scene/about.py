"""What a scene or a mesh file holds, in words, and a scene file for a mesh."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..host.reach import Reach
from . import meshes
from .imports import read_tables
from .imports.suggest import view_of
from .imports.toml_text import toml_text
from .lights.kinds import SphereLight, SpotLight
from .load import read_scene, scene_from
from .model import Camera, Light, Material, QuadLight, Scene
from .table import SceneError
from .textures.image_file import ImageFiles
from .textures.texture import Texture

# So many materials and lights are listed.
LISTED = 20
# What of `Maps` is an image, and what that says.
_IMAGES = {"colour": "colour", "surface": "roughness and metal"} | {
    name: name for name in ("emission", "opacity", "normal")
}


def describe(path: str | Path, camera: str | None = None, allow_outside: bool = False) -> str:
    """Bounds, triangles, materials, lights, camera and what is not supported, in some lines.

    Arguments, and errors, are those of `load_scene`.
    """
    scene = read_scene(Path(path), camera, allow_outside)
    surfaces = scene.triangle_light < 0
    seen = scene.vertices[scene.triangles[surfaces] if surfaces.any() else scene.triangles]
    low, high = (end(axis=(0, 1)) + scene.origin for end in (seen.min, seen.max))
    lines = [
        f"{path}: {np.count_nonzero(surfaces)} triangles",
        f"bounds    {_row(low)} to {_row(high)}, size {_row(high - low)}",
    ]
    lines += _materials(scene, surfaces)
    lines += _lights(scene) + _environment(scene)
    own = scene.camera
    place, target = own.position + scene.origin, own.target + scene.origin
    lines += [f"camera    at {_row(place)}, to {_row(target)}, {own.vertical_fov:g}° high"]
    said = [_short(warning, path) for warning in scene.warnings]
    lines += ["as the file has it, but for:", *(f"  {one}" for one in said)] if said else []
    lines += [
        "a camera that sees all of it from outside:",
        "",
        camera_toml(view_of(np.stack([low, high]))),
    ]
    return "\n".join(lines)


def mesh_toml(path: str | Path, camera: str | None = None, allow_outside: bool = False) -> str:
    """A scene file that shows a mesh file: to be saved beside it.

    Arguments, and errors, are those of `load_scene`; it is an error as well if the file is no mesh.
    """
    path = Path(path)
    if path.suffix.lower() not in meshes.KINDS:
        raise SceneError(f"{path}: --toml is for mesh files: {', '.join(meshes.KINDS)}")
    images = ImageFiles(Reach(None if allow_outside else path.parent))
    found = read_tables(path, images, camera)
    scene_from(found, path, images)
    return toml_text(found.tables).rstrip("\n")


def camera_toml(camera: Camera) -> str:
    """A scene file's table ``camera``."""
    vectors = {"position": camera.position, "target": camera.target, "up": camera.up}
    rounded = {key: [float(f"{x:.10g}") for x in vector] for key, vector in vectors.items()}
    return toml_text({"camera": rounded | {"vertical_fov": camera.vertical_fov}}).rstrip("\n")


def _materials(scene: Scene, surfaces: NDArray[np.bool_]) -> list[str]:
    counts = np.bincount(scene.triangle_material[surfaces], minlength=len(scene.materials))
    used = [i for i in np.argsort(-counts, kind="stable") if counts[i]]
    lines = [f"materials {len(used)}"]
    lines += [f"  {_material(scene.materials[i])}, on {counts[i]} triangles" for i in used[:LISTED]]
    return lines + ([f"  {len(used) - LISTED} more"] if len(used) > LISTED else [])


def _material(material: Material) -> str:
    parts = [f"albedo {_row(material.albedo)}"]
    if material.is_glass:
        kind = "thin glass" if material.thin else "glass"
        parts = [f"{kind}, transmission {_row(material.transmission)}, ior {material.ior:.4g}"]
        parts += [f"roughness {material.roughness:.3g}"] if not material.thin else []
    if material.reflectance.any():
        parts.append(f"reflectance {_row(material.reflectance)}, roughness {material.roughness:.3g}")
    if material.emission.any():
        parts.append(f"emits {_row(material.emission)}")
    if material.maps is not None:
        parts += [_image(what, getattr(material.maps, name)) for name, what in _IMAGES.items()]
        parts = [part for part in parts if part]
    return f"{material.name or 'unnamed'}: {', '.join(parts)}"


def _image(what: str, texture: Texture | None) -> str:
    """What a material has of an image; empty where there is none."""
    if texture is None:
        return ""
    height, width = texture.texels.shape[:2]
    return f"{what} by an image of {width} × {height}"


def _lights(scene: Scene) -> list[str]:
    lines = [f"lights    {len(scene.lights)}"]
    lines += [f"  {_light(light, scene.origin)}" for light in scene.lights[:LISTED]]
    return lines + ([f"  {len(scene.lights) - LISTED} more"] if len(scene.lights) > LISTED else [])


def _light(light: Light, origin: NDArray[np.float64]) -> str:
    radiance = f"radiance {_row(light.radiance)}"
    if isinstance(light, SphereLight):
        return f"sphere of radius {light.radius:.3g} at {_row(light.centre + origin)}, {radiance}"
    if isinstance(light, SpotLight):
        beam = f"towards {_row(light.direction)} within {light.outer_angle:.3g} degrees"
        return f"spot at {_row(light.position + origin)}, intensity {_row(light.intensity)}, {beam}"
    place = light.corner if isinstance(light, QuadLight) else light.centre
    sides = "both sides" if light.two_sided else f"towards {_row(light.normal)}"
    return f"area {light.area:.3g} at {_row(place + origin)}, {radiance}, {sides}"


def _environment(scene: Scene) -> list[str]:
    """Nothing where there is none."""
    if scene.environment is None:
        return []
    texels, suns = scene.environment.texels, scene.environment.suns
    height, width = texels.shape[:2]
    what = f"an image of {width} × {height}, " if texels.size > 3 else ""
    mean = texels.astype(np.float64).mean(axis=(0, 1)).astype(np.float32)
    lines = [f"outside   {what}radiance {_row(mean)}{' on average' if what else ''}"]
    for sun in suns:
        size = f"{sun.angular_diameter:.4g}° wide"
        lines.append(f"  sun {size} towards {_row(sun.towards)}, irradiance {_row(sun.irradiance)}")
    return lines


def _short(warning: str, path: str | Path) -> str:
    return warning.removeprefix(f"{Path(path)}: ")


def _row(vector: NDArray) -> str:
    """Three numbers as they are read; one where they are alike."""
    texts = [f"{x:.4g}" for x in np.asarray(vector, dtype=np.float64) + 0.0]
    return (
        texts[0]
        if len(set(texts)) == 1 and np.asarray(vector).dtype == np.float32
        else f"({', '.join(texts)})"
    )
