"""Material libraries of OBJ files (MTL) in the renderer's terms.

Nothing here raises: a property that cannot be rendered is noted, and the nearest value is taken.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import overload

import numpy as np

from ..textures.image_file import ImageFiles
from .common import (
    DIELECTRIC_REFLECTANCE,
    FALLBACK_ALBEDO,
    Colour,
    FileMaterial,
    Notes,
    metallic_model,
    three,
)
from .files import read_text
from .glass import TRANSPARENT, mtl_glass
from .mtl_texture import METAL_MAPS, ROUGHNESS_MAPS, TEXTURES, MaterialTextures
from .textures import MISSING

# Keys without an effect on what is rendered: ambient light.
_WITHOUT_EFFECT = {"ka", "sharpness", "map_ka", "map_aat"}
_LOBES = {"pc": "clear coat", "ps": "sheen", "aniso": "anisotropy"}
_READ = {"kd", "ks", "ke", "ns", "d", "tr", "illum", "tf", "ni", "pr", "pm", "pcr", "anisor"}
_METAL = {"pm", *METAL_MAPS}
# Models without highlights.
_DIFFUSE = (0, 1)
Statements = dict[str, str]


def read_library(path: Path, notes: Notes) -> dict[str, Statements]:
    """The materials of a file by name: each one's keys, in lower case, with the text behind them.

    The first of two materials of the same name counts, as with several libraries.
    """
    try:
        lines = read_text(path)
    except ValueError as error:
        notes.look("material libraries that cannot be read", f"{path.name}: {error}")
        return {}
    found: dict[str, Statements] = {}
    current: Statements = {}
    for line in lines:
        key, _, rest = line.partition(" ")
        key, rest = key.lower(), rest.strip()
        if key == "newmtl":
            current = {}
            found.setdefault(rest, current)
        elif key and not key.startswith("#"):
            current[key] = rest
    return found


class MaterialReader:
    """Turns the statements of one material into a `FileMaterial`."""

    def __init__(
        self, name: str, statements: Statements, folder: Path, notes: Notes, images: ImageFiles
    ) -> None:
        self._name = name
        self._statements = statements
        self._notes = notes
        self._numbers: dict[str, list[float]] = {}
        self._textures = MaterialTextures(name, statements, folder, notes, images)

    def material(self) -> FileMaterial:
        """The material; notes what it has that is not read."""
        maps = self._textures.maps()
        diffuse, specular = self._diffuse(maps is not None and maps.colour is not None), self._specular()
        emission = self._colour("ke", float("map_ke" in self._statements))
        emission = self._textures.times_mean_if_left_out("map_ke", emission, maps)
        exponent = self._number("ns", 0.0)
        # Blinn-Phong exponent to GGX: alpha = sqrt(2 / (Ns + 2)), roughness = sqrt(alpha).
        roughness = (2.0 / (max(exponent, 0.0) + 2.0)) ** 0.25
        has_surface = maps is not None and maps.surface is not None
        if has_surface and set(ROUGHNESS_MAPS) & set(self._statements):
            roughness = 1.0
        roughness = self._number("pr", roughness)
        glass = self._glass(FileMaterial(self._name, diffuse, specular, roughness, emission, maps))
        self._note_what_is_not_read(glass is None)
        if glass is not None:
            return glass
        if _METAL & set(self._statements):
            metallic = self._metallic(has_surface)
            if maps is None:
                diffuse, specular = metallic_model(diffuse, metallic)
            else:
                specular, maps = three(DIELECTRIC_REFLECTANCE), replace(maps, metallic=metallic)
        return FileMaterial(self._name, diffuse, specular, roughness, emission, maps)

    def _glass(self, material: FileMaterial) -> FileMaterial | None:
        """The material as glass, if it is that."""
        if self._model() not in TRANSPARENT:
            return None
        index, rough = (self._number(key, math.nan) for key in ("ni", "pr"))
        return mtl_glass(
            material,
            self._model(),
            self._colour("tf", 1.0),
            None if math.isnan(index) else index,
            self._opacity(),
            None if math.isnan(rough) else rough,
            self._notes,
        )

    def _opacity(self) -> float:
        return self._number("d", 1.0 - self._number("tr", 0.0))

    def _metallic(self, has_surface: bool) -> float:
        """Pm, or the factor of its texture; 0 under a texture that cannot be read."""
        if not set(self._statements) & set(METAL_MAPS):
            return min(max(self._number("pm", 0.0), 0.0), 1.0)
        return min(max(self._number("pm", 1.0), 0.0), 1.0) if has_surface else 0.0

    def _diffuse(self, is_read: bool) -> Colour:
        """Kd, the factor of its texture if that is read."""
        textured = "map_kd" in self._statements
        diffuse = self._colour("kd", 1.0 if textured else None)
        if diffuse is None:
            self._notes.look(f"materials without Kd, whose albedo is {FALLBACK_ALBEDO:g}", self._name)
            return three(FALLBACK_ALBEDO)
        if textured and not any(diffuse):
            # Many tools write a black colour with a texture; then the texture counts as if the colour
            # were white.
            self._notes.look(
                "materials with a black Kd beside a texture, which is taken for white", self._name
            )
            diffuse = three(1.0)
        if textured and not is_read:
            self._notes.look(MISSING.format(f"{FALLBACK_ALBEDO:g}"), self._textures.label("map_kd"))
            diffuse = three(np.multiply(diffuse, FALLBACK_ALBEDO))
        return diffuse

    def _specular(self) -> Colour:
        """Ks times the mean of its texture; none for a model without highlights."""
        if self._model() in _DIFFUSE:
            return three(0.0)
        factor = self._colour("ks", float("map_ks" in self._statements))
        return self._textures.times_mean("map_ks", factor)

    def _model(self) -> int:
        """The illumination model, `illum`; 2 (with highlights) if there is none."""
        return int(self._number("illum", 2.0))

    def _note_what_is_not_read(self, is_opaque: bool) -> None:
        look, name = self._notes.look, self._name
        if is_opaque and (self._opacity() < 1.0 or self._model() in TRANSPARENT):
            look("materials that let light through are drawn opaque", name)
        if self._model() == 0:
            look("materials of constant colour (illum 0) are lit as others are", name)
        self._textures.note_what_is_not_read()
        for key in self._statements:
            if key in TEXTURES:
                continue
            if key in _LOBES:
                if self._number(key, 0.0):
                    look(f"{_LOBES[key]} is not read", name)
            elif key not in _READ and key not in _WITHOUT_EFFECT:
                look("keys of materials that are not known", f"{key} of {name}")

    def _values(self, key: str) -> list[float]:
        """The finite numbers behind a key; empty, and noted, if it has none."""
        if key in self._numbers:
            return self._numbers[key]
        text = self._statements[key].split("#")[0].removeprefix("-halo").split()
        try:
            values = [float(word) for word in text]
        except ValueError:
            values = []
        if len(values) not in (1, 3) or not all(map(math.isfinite, values)):
            kind = "keys of materials whose values are no numbers, as if they were absent"
            self._notes.look(kind, f"{key} {' '.join(text)} of {self._name}")
            values = []
        self._numbers[key] = values
        return values

    def _number(self, key: str, default: float) -> float:
        values = self._values(key) if key in self._statements else []
        return values[0] if values else default

    @overload
    def _colour(self, key: str, default: float) -> Colour: ...

    @overload
    def _colour(self, key: str, default: float | None) -> Colour | None: ...

    def _colour(self, key: str, default: float | None) -> Colour | None:
        values = self._values(key) if key in self._statements else []
        if not values:
            return None if default is None else three(default)
        return three(values[0] if len(values) == 1 else values)
