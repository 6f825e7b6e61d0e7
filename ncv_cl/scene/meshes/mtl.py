"""Material libraries of OBJ files (MTL) in the renderer's terms.

Nothing here raises: a property that cannot be rendered is noted, and the nearest value is taken.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from ..textures.image_file import ImageFiles
from ..textures.texture import Maps, Texture
from .common import (
    DIELECTRIC_REFLECTANCE,
    FALLBACK_ALBEDO,
    Colour,
    FileMaterial,
    Notes,
    metallic_model,
    three,
)
from .files import find_file, read_text
from .mtl_texture import read_texture_statement
from .textures import (
    HALF_OPAQUE,
    MEAN_OF_OTHERS,
    MEANS,
    MISSING,
    NO_METAL,
    NO_OPACITY,
    NOT_PLACED_ALIKE,
    colour_texture,
    mean_colour,
    surface_texture,
)

# Keys without an effect on what is rendered: ambient light, refraction of opaque surfaces.
_WITHOUT_EFFECT = {"ka", "ni", "tf", "sharpness", "map_ka", "map_aat"}
_TEXTURES = {
    "map_kd", "map_ks", "map_ke", "map_ns", "map_d", "map_tr", "map_bump", "bump", "map_disp", "disp",
    "decal", "map_decal", "refl", "map_refl", "norm", "map_norm", "map_kn", "map_pr", "map_pm",
    "map_ps", "map_pc", "map_rma", "map_orm", "map_emissive",
}  # fmt: skip
_LOBES = {"pc": "clear coat", "ps": "sheen", "aniso": "anisotropy"}
_READ = {"kd", "ks", "ke", "ns", "d", "tr", "illum", "pr", "pm", "pcr", "anisor"}
_METAL = {"pm", "map_pm", "map_rma", "map_orm"}
# Textures of roughness and of metal, and which channel of each counts.
_ROUGHNESS_MAPS = {"map_pr": 0, "map_rma": 0, "map_orm": 1}
_METAL_MAPS = {"map_pm": 0, "map_rma": 1, "map_orm": 2}
_READ_TEXTURES = {"map_kd", "map_ks", "map_ke", "map_d", *_ROUGHNESS_MAPS, *_METAL_MAPS}
# Where all of a material's textures lie is said by the first of these that it has.
_PLACED = ("map_kd", *_ROUGHNESS_MAPS, *_METAL_MAPS, "map_ke", "map_d")
# Models without highlights, and those that let light through.
_DIFFUSE, _TRANSPARENT = (0, 1), (4, 6, 7, 9)
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
        self._folder = folder
        self._notes = notes
        self._images = images
        self._numbers: dict[str, list[float]] = {}
        self._textures = {
            key: read_texture_statement(text) for key, text in statements.items() if key in _TEXTURES
        }

    def material(self) -> FileMaterial:
        """The material; notes what it has that is not read."""
        colour = self._base_texture()
        surface = self._surface_texture()
        diffuse = self._diffuse(colour)
        specular = self._specular()
        emission, glow = self._emission()
        exponent = self._number("ns", 0.0)
        # Blinn-Phong exponent to GGX: alpha = sqrt(2 / (Ns + 2)), roughness = sqrt(alpha).
        roughness = (2.0 / (max(exponent, 0.0) + 2.0)) ** 0.25
        if surface is not None and set(_ROUGHNESS_MAPS) & set(self._textures):
            roughness = 1.0
        roughness = self._number("pr", roughness)
        self._note_what_is_not_read()
        metallic = self._metallic(surface) if _METAL & set(self._statements) else None
        textures = (colour, surface, glow, self._opacity())
        if metallic is not None and colour is None and surface is None:
            diffuse, specular = metallic_model(diffuse, metallic)
            metallic = 0.0
        elif metallic is not None:
            specular = three(DIELECTRIC_REFLECTANCE)
        maps = None
        if any(one is not None for one in textures):
            placement = self._textures[self._first_key()].placement
            maps = Maps(*textures, metallic or 0.0, placement=placement)
        return FileMaterial(self._name, diffuse, specular, roughness, emission, maps)

    def _opacity(self) -> Texture | None:
        """The texture whose alpha, or grey, makes holes."""
        if "map_d" not in self._textures:
            return None
        statement, label = self._textures["map_d"], self._label("map_d")
        image = find_file(self._folder, statement.file)
        texels = None if image is None else self._images.opacity(image)
        if texels is None or not self._lies_with_the_first("map_d"):
            self._notes.look(NO_OPACITY, label)
            return None
        self._notes.look(HALF_OPAQUE, label)
        return Texture(texels, (statement.wrap,) * 2)

    def _first_key(self) -> str:
        """The statement of the texture where all others have to lie."""
        return next(key for key in _PLACED if key in self._textures)

    def _lies_with_the_first(self, *keys: str) -> bool:
        first = self._textures[self._first_key()].placed
        return all(self._textures[key].placed == first for key in keys)

    def _emission(self) -> tuple[Colour, Texture | None]:
        """Ke, and the texture that multiplies it."""
        factor = self._colour("ke", float("map_ke" in self._statements))
        if "map_ke" not in self._textures:
            return factor, None
        statement = self._textures["map_ke"]
        image = find_file(self._folder, statement.file)
        texture = None if image is None else self._images.texture(image, "auto", (statement.wrap,) * 2)
        if texture is not None and self._lies_with_the_first("map_ke"):
            return factor, texture
        self._notes.look(
            MISSING.format("0") if texture is None else MEAN_OF_OTHERS, self._label("map_ke")
        )
        mean = mean_colour(self._images, image) or three(0.0)
        return three(np.multiply(factor, mean)), None

    def _metallic(self, surface: Texture | None) -> float:
        """Pm, or the factor of its texture; 0 under a texture that cannot be read."""
        if not set(self._statements) & set(_METAL_MAPS):
            return min(max(self._number("pm", 0.0), 0.0), 1.0)
        return 0.0 if surface is None else min(max(self._number("pm", 1.0), 0.0), 1.0)

    def _diffuse(self, texture: Texture | None) -> Colour:
        """Kd, the factor of its texture."""
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
        if textured and texture is None:
            self._notes.look(MISSING.format(f"{FALLBACK_ALBEDO:g}"), self._label("map_kd"))
            diffuse = three(np.multiply(diffuse, FALLBACK_ALBEDO))
        return diffuse

    def _specular(self) -> Colour:
        """Ks times the mean of its texture; none for a model without highlights."""
        if self._model() in _DIFFUSE:
            return three(0.0)
        return self._times_mean("map_ks", self._colour("ks", float("map_ks" in self._statements)))

    def _base_texture(self) -> Texture | None:
        """The texture of Kd, if it can be read."""
        if "map_kd" not in self._textures:
            return None
        statement = self._textures["map_kd"]
        image = find_file(self._folder, statement.file)
        label = self._label("map_kd")
        if statement.left_out:
            self._notes.look("options of textures that are not read", f"{statement.left_out} of {label}")
        return colour_texture(self._images, image, label, self._notes, (statement.wrap,) * 2)

    def _surface_texture(self) -> Texture | None:
        """The texture of roughness and metal, where all its parts can be read and are placed alike."""
        wanted = [
            next((key for key in maps if key in self._textures), None)
            for maps in (_ROUGHNESS_MAPS, _METAL_MAPS)
        ]
        keys = [key for key in wanted if key is not None]
        if not keys:
            return None
        labels = ", ".join(self._label(key) for key in keys)
        if not self._lies_with_the_first(*keys):
            self._notes.look(NOT_PLACED_ALIKE, labels)
            return None
        parts = [None if key is None else self._linear(key) for key in wanted]
        if any(key is not None and part is None for key, part in zip(wanted, parts, strict=True)):
            self._notes.look(NO_METAL, labels)
            return None
        channels = tuple(
            0 if key is None else maps[key]
            for key, maps in zip(wanted, (_ROUGHNESS_MAPS, _METAL_MAPS), strict=True)
        )
        return surface_texture(parts[0], parts[1], (channels[0], channels[1]))

    def _linear(self, key: str) -> Texture | None:
        statement = self._textures[key]
        image = find_file(self._folder, statement.file)
        wrap = (statement.wrap, statement.wrap)
        return None if image is None else self._images.texture(image, "linear", wrap)

    def _times_mean(self, key: str, factor: Colour) -> Colour:
        """A colour times the mean of its texture, if it has one."""
        if key not in self._textures:
            return factor
        mean = mean_colour(self._images, find_file(self._folder, self._textures[key].file))
        self._notes.look(MISSING.format("0") if mean is None else MEANS, self._label(key))
        return three(np.multiply(factor, 0.0 if mean is None else mean))

    def _label(self, key: str) -> str:
        return f"{_LABELS[key]} {self._textures[key].file} of {self._name}"

    def _model(self) -> int:
        """The illumination model, `illum`; 2 (with highlights) if there is none."""
        return int(self._number("illum", 2.0))

    def _note_what_is_not_read(self) -> None:
        look, name = self._notes.look, self._name
        opacity = self._number("d", 1.0 - self._number("tr", 0.0))
        if opacity < 1.0 or self._model() in _TRANSPARENT:
            look("materials that let light through are drawn opaque", name)
        if self._model() == 0:
            look("materials of constant colour (illum 0) are lit as others are", name)
        for key in self._statements:
            if key in _READ_TEXTURES:
                continue
            if key in _TEXTURES:
                look("textures are not read, the surface is as without them", self._label(key))
            elif key in _LOBES:
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

    def _colour(self, key: str, default: float | None) -> Colour | None:
        values = self._values(key) if key in self._statements else []
        if not values:
            return None if default is None else three(default)
        return three(values[0] if len(values) == 1 else values)


_LABELS = {key: key for key in _TEXTURES} | {"map_kd": "map_Kd", "map_ks": "map_Ks", "map_ke": "map_Ke"}
