"""What a scene or a mesh file holds, in words, and a scene file for a mesh."""

from __future__ import annotations

import json
import warnings
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from . import meshes
from .lights.kinds import SphereLight, SpotLight
from .load import load_scene, scene_from
from .model import Camera, Light, Material, QuadLight, Scene
from .table import SceneError
from .textures.texture import Texture

# So many materials and lights are listed.
LISTED = 20
# The suggested camera looks from in front, from the right and from above, at this angle.
_VIEW = np.array([0.5, 0.45, 1.0])
_FOV = 40.0
# What of `Maps` is an image, and what that says.
_IMAGES = {"colour": "colour", "surface": "roughness and metal"} | {
    name: name for name in ("emission", "opacity", "normal")
}
# The suggested light: how high above the mesh, and its side, in diagonals of the bounds.
_LIGHT_HEIGHT, _LIGHT_SIZE = 1.5, 1.0
# White, facing it, is then about as bright as a picture shows.
_LIGHT_RADIANCE = 8.0


def read_any(path: str | Path) -> tuple[Scene, bool]:
    """The scene of a file, and whether that is a scene file; a mesh file stands alone under a light.

    Raises
    ------
    SceneError
        As `load_scene` raises it.
    """
    path = Path(path)
    with warnings.catch_warnings():
        # They are part of what is said.
        warnings.simplefilter("ignore")
        if path.suffix.lower() in meshes.KINDS:
            return scene_from(_mesh_tables(path), path), False
        return load_scene(path), True


def describe(path: str | Path) -> str:
    """Bounds, triangles, materials, lights, camera and what is not supported, in some lines."""
    scene, is_scene = read_any(path)
    surfaces = scene.triangle_light < 0
    seen = scene.vertices[scene.triangles[surfaces] if surfaces.any() else scene.triangles]
    low, high = (end(axis=(0, 1)) + scene.origin for end in (seen.min, seen.max))
    lines = [
        f"{path}: {np.count_nonzero(surfaces)} triangles",
        f"bounds    {_row(low)} to {_row(high)}, size {_row(high - low)}",
    ]
    lines += _materials(scene, surfaces)
    lines += _lights(scene) if is_scene else ["lights    none: mesh files' lights are not read"]
    if is_scene:
        camera = scene.camera
        place, target = camera.position + scene.origin, camera.target + scene.origin
        lines += [f"camera    at {_row(place)}, to {_row(target)}, {camera.vertical_fov:g}° high"]
    said = [_short(warning, path) for warning in scene.warnings]
    lines += ["as the file has it, but for:", *(f"  {one}" for one in said)] if said else []
    lines += [
        "a camera that sees all of it from outside:",
        "",
        camera_toml(view_of(np.stack([low, high]))),
    ]
    return "\n".join(lines)


def mesh_toml(path: str | Path) -> str:
    """A scene file that shows a mesh file: to be saved beside it.

    Raises
    ------
    SceneError
        If the file is no mesh, or cannot be read.
    """
    path = Path(path)
    if path.suffix.lower() not in meshes.KINDS:
        raise SceneError(f"{path}: --toml is for mesh files: {', '.join(meshes.KINDS)}")
    tables = _mesh_tables(path)
    scene_from(tables, path)
    light, mesh = tables["lights"][0], tables["meshes"][0]
    camera = Camera(
        **{k: np.array(v) if isinstance(v, list) else v for k, v in tables["camera"].items()}
    )
    return "\n".join(
        [
            f"name = {_quoted(tables['name'])}",
            "",
            camera_toml(camera),
            "",
            "[[meshes]]",
            f"file = {_quoted(mesh['file'])}",
            "",
            "[[lights]]",
            *(f"{key} = {light[key]}" for key in ("corner", "edge1", "edge2", "radiance")),
        ]
    )


def view_of(bounds: NDArray[np.float64]) -> Camera:
    """A camera outside of bounds, float64 (2, 3), that sees all of them."""
    centre, radius = bounds.mean(axis=0), 0.5 * _diagonal(bounds)
    distance = 1.05 * radius / np.sin(np.radians(_FOV / 2))
    position = centre + distance * _VIEW / np.linalg.norm(_VIEW)
    step = 10.0 ** (np.floor(np.log10(radius)) - 2)
    return Camera(np.round(position / step) * step, np.round(centre / step) * step, _FOV)


def camera_toml(camera: Camera) -> str:
    """A scene file's table ``camera``."""
    vectors = {"position": camera.position, "target": camera.target, "up": camera.up}
    lines = [f"{key} = {_numbers(vector)}" for key, vector in vectors.items()]
    return "\n".join(["[camera]", *lines, f"vertical_fov = {camera.vertical_fov:g}"])


def _mesh_tables(path: Path) -> dict[str, object]:
    """What a scene file with a mesh, a camera and a light would hold."""
    try:
        found = meshes.read_meshes(path, np.eye(4), None)
    except ValueError as error:
        raise SceneError(f"{path}: {error}") from error
    used = [item.mesh.vertices[item.mesh.triangles].reshape(-1, 3) for item in found.meshes]
    points = np.concatenate(used)
    bounds = np.stack([points.min(axis=0), points.max(axis=0)])
    camera, size = view_of(bounds), _diagonal(bounds)
    centre = np.array([bounds[:, 0].mean(), bounds[1, 1], bounds[:, 2].mean()])
    side = _LIGHT_SIZE * size
    corner = centre + np.array([-side / 2, _LIGHT_HEIGHT * size, -side / 2])
    return {
        "name": path.stem,
        "camera": {
            "position": camera.position.tolist(),
            "target": camera.target.tolist(),
            "vertical_fov": camera.vertical_fov,
        },
        "meshes": [{"file": path.name}],
        "lights": [
            {
                "corner": [float(f"{x:.6g}") for x in corner],
                "edge1": [float(f"{side:.6g}"), 0.0, 0.0],
                "edge2": [0.0, 0.0, float(f"{side:.6g}")],
                "radiance": _LIGHT_RADIANCE,
            }
        ],
    }


def _materials(scene: Scene, surfaces: NDArray[np.bool_]) -> list[str]:
    counts = np.bincount(scene.triangle_material[surfaces], minlength=len(scene.materials))
    used = [i for i in np.argsort(-counts, kind="stable") if counts[i]]
    lines = [f"materials {len(used)}"]
    lines += [f"  {_material(scene.materials[i])}, on {counts[i]} triangles" for i in used[:LISTED]]
    return lines + ([f"  {len(used) - LISTED} more"] if len(used) > LISTED else [])


def _material(material: Material) -> str:
    parts = [f"albedo {_row(material.albedo)}"]
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


def _short(warning: str, path: str | Path) -> str:
    return warning.removeprefix(f"{Path(path)}: ")


def _diagonal(bounds: NDArray[np.float64]) -> float:
    # A point has none; scenes of nothing else are refused.
    return float(np.linalg.norm(bounds[1] - bounds[0])) or 1.0


def _row(vector: NDArray) -> str:
    """Three numbers as they are read; one where they are alike."""
    texts = [f"{x:.4g}" for x in np.asarray(vector, dtype=np.float64) + 0.0]
    return (
        texts[0]
        if len(set(texts)) == 1 and np.asarray(vector).dtype == np.float32
        else f"({', '.join(texts)})"
    )


def _numbers(vector: NDArray[np.float64]) -> str:
    return f"[{', '.join(f'{x + 0.0:.10g}' for x in vector)}]"


def _quoted(text: str) -> str:
    """A basic string of TOML, which is one of JSON."""
    return json.dumps(text, ensure_ascii=False)
