"""A scene of Mitsuba's as our tables."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..meshes.common import Notes, sentences
from ..textures.image_file import ImageFiles
from .found import Found
from .mesh_scene import chosen_camera
from .mitsuba_camera import read_sensor
from .mitsuba_emitters import Emitters
from .mitsuba_materials import Materials
from .mitsuba_shapes import Shapes
from .mitsuba_texture import Textures
from .mitsuba_xml import Plugin, read_xml

# They say how to render, not what.
_METHODS = ("integrator", "film", "sampler", "rfilter", "texture", "bsdf")


def mitsuba_scene(path: Path, images: ImageFiles, camera: str | None = None) -> Found:
    """The tables of a scene file of Mitsuba's.

    Raises
    ------
    ValueError
        If the file cannot be read, or has no camera, or none of that name.
    ImportError
        If Mitsuba is not installed.
    """
    notes = Notes()
    return tables_of(read_xml(path, images, notes), path, images, notes, camera)


def tables_of(
    root: Plugin, path: Path, images: ImageFiles, notes: Notes, camera: str | None = None
) -> Found:
    """The tables of a scene whose files are named from the folder of `path`."""
    textures = Textures(path.parent, images, notes)
    materials = Materials(textures, notes)
    shapes = Shapes(textures, materials, notes)
    emitters = Emitters(textures, notes)
    sensors: list[tuple[str, dict[str, Any] | str]] = []
    for child in _content(root):
        if child.category == "shape":
            shapes.add(child, np.eye(4))
        elif child.category == "emitter":
            emitters.add(child)
        elif child.category == "sensor":
            name = child.name or f"sensor {len(sensors) + 1}"
            sensors.append((name, read_sensor(child, name, notes)))
        elif child.category not in _METHODS:
            notes.shape(f"objects of the kind {child.category} are left out", child.kind)
    chosen = chosen_camera(sensors, camera)
    if chosen is None:
        raise ValueError("the scene has no camera (sensor)")
    tables: dict[str, Any] = {"name": path.stem, "camera": chosen, "materials": materials.tables}
    tables |= {key: entries for key, entries in shapes.tables.items() if entries}
    lights = shapes.lights + emitters.lights
    if lights:
        tables["lights"] = lights
    if emitters.environment is not None:
        tables["environment"] = emitters.environment
    return Found(tables, sentences(notes.geometry) + sentences(notes.looks))


def _content(root: Plugin) -> list[Plugin]:
    """All objects of a scene, those with a name of their own too."""
    named = [value for value in root.values.values() if isinstance(value, Plugin)]
    return [*root.children, *named]
