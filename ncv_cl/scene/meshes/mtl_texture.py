"""Textures of MTL files: their statements, and the images that these name."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ..textures.image_file import ImageFiles
from ..textures.texture import Maps, Texture
from .common import Colour, Notes, three
from .files import find_file
from .textures import (
    HALF_OPAQUE,
    MEAN_OF_OTHERS,
    MEANS,
    MISSING,
    NO_METAL,
    NO_NORMALS,
    NO_OPACITY,
    NOT_PLACED_ALIKE,
    colour_texture,
    mean_colour,
    surface_texture,
)

TEXTURES = {
    "map_kd", "map_ks", "map_ke", "map_ns", "map_d", "map_tr", "map_bump", "bump", "map_disp", "disp",
    "decal", "map_decal", "refl", "map_refl", "norm", "map_norm", "map_kn", "map_pr", "map_pm",
    "map_ps", "map_pc", "map_rma", "map_orm", "map_emissive",
}  # fmt: skip
# Textures of roughness and of metal, and which channel of each counts; and those of normals.
ROUGHNESS_MAPS = {"map_pr": 0, "map_rma": 0, "map_orm": 1}
METAL_MAPS = {"map_pm": 0, "map_rma": 1, "map_orm": 2}
_NORMAL_MAPS = ("norm", "map_kn", "map_norm")
# Where all of a material's textures lie is said by the first of these that it has.
_PLACED = ("map_kd", *ROUGHNESS_MAPS, *METAL_MAPS, "map_ke", "map_d", *_NORMAL_MAPS)
_READ = {*_PLACED, "map_ks"}
_LABELS = {key: key for key in TEXTURES} | {"map_kd": "map_Kd", "map_ks": "map_Ks", "map_ke": "map_Ke"}
# Arguments of options; -o, -s and -t have up to three.
_ARGUMENTS = {"-mm": 2, "-o": 3, "-s": 3, "-t": 3}
# Values of options that leave an image as it is. Bump maps have -bm, highlights -boost.
_WITHOUT_EFFECT = {
    "-mm": ["0", "1"], "-t": ["0", "0", "0"], "-cc": ["off"], "-blendu": None, "-blendv": None,
    "-bm": None, "-boost": None, "-texres": None, "-imfchan": None, "-type": None,
}  # fmt: skip


@dataclass
class TextureStatement:
    """What a statement says.

    Attributes
    ----------
    file : str
    scale, offset : list of float
        Along u and v.
    wrap : str
        As in `Texture`, along both axes.
    left_out : str
        Options that would change the image and are not read.
    """

    file: str = ""
    scale: list[float] = field(default_factory=lambda: [1.0, 1.0])
    offset: list[float] = field(default_factory=lambda: [0.0, 0.0])
    wrap: str = "repeat"
    left_out: str = ""

    @property
    def placement(self) -> tuple[float, float, float, float, float, float]:
        """As in `Maps`."""
        return (self.scale[0], 0.0, self.offset[0], 0.0, self.scale[1], self.offset[1])

    @property
    def placed(self) -> tuple[object, ...]:
        """What is alike for images that lie alike on a surface."""
        return (*self.placement, self.wrap)


def read_texture_statement(text: str) -> TextureStatement:
    """The options and the file of a texture statement."""
    found = TextureStatement()
    words, left_out = text.split(), []
    while len(words) > 1 and words[0].startswith("-"):
        option, values = words.pop(0).lower(), []
        limit = _ARGUMENTS.get(option, 1)
        fewest = 1 if limit == 3 else limit
        for i in range(limit):
            if len(words) > 1 and (i < fewest or _is_number(words[0])):
                values.append(words.pop(0))
            else:
                break
        if option in ("-s", "-o") and all(map(_is_number, values)):
            target = found.scale if option == "-s" else found.offset
            target[: len(values[:2])] = [float(value) for value in values[:2]]
        elif option == "-clamp":
            found.wrap = "clamp" if values == ["on"] else "repeat"
        elif not _has_no_effect(option, values):
            left_out.append(" ".join([option, *values]))
    found.file, found.left_out = " ".join(words), " ".join(left_out)
    return found


def _has_no_effect(option: str, values: list[str]) -> bool:
    if option not in _WITHOUT_EFFECT:
        return False
    expected = _WITHOUT_EFFECT[option]
    return expected is None or values == expected[: len(values)]


def _is_number(word: str) -> bool:
    try:
        return math.isfinite(float(word))
    except ValueError:
        return False


class MaterialTextures:
    """The textures of one material; notes those that cannot be shown."""

    def __init__(
        self, name: str, statements: Mapping[str, str], folder: Path, notes: Notes, images: ImageFiles
    ) -> None:
        self._name = name
        self._folder = folder
        self._notes = notes
        self._images = images
        self._found = {
            key: read_texture_statement(text) for key, text in statements.items() if key in TEXTURES
        }

    def maps(self) -> Maps | None:
        """All that can be shown; None if there are none."""
        found = (self._colour(), self._surface(), self._emission(), self._opacity(), self._normal())
        if all(one is None for one in found):
            return None
        return Maps(*found, placement=self._found[self._first_key()].placement)

    def label(self, key: str) -> str:
        """A texture's name in messages."""
        return f"{_LABELS[key]} {self._found[key].file} of {self._name}"

    def times_mean(self, key: str, factor: Colour) -> Colour:
        """A colour times the mean of a texture that is not shown, if it has one."""
        if key not in self._found:
            return factor
        mean = mean_colour(self._images, self._image(key))
        self._notes.look(MISSING.format("0") if mean is None else MEANS, self.label(key))
        return three(np.multiply(factor, 0.0 if mean is None else mean))

    def times_mean_if_left_out(self, key: str, factor: Colour, maps: Maps | None) -> Colour:
        """A colour of emission times the mean of its texture, where that is not among the maps."""
        if key not in self._found or (maps is not None and maps.emission is not None):
            return factor
        mean = mean_colour(self._images, self._image(key))
        self._notes.look(MISSING.format("0") if mean is None else MEAN_OF_OTHERS, self.label(key))
        return three(np.multiply(factor, 0.0 if mean is None else mean))

    def note_what_is_not_read(self) -> None:
        """Note textures of other kinds, and options that are left out."""
        for key, statement in self._found.items():
            if key not in _READ:
                kind = "textures are not read, the surface is as without them"
                self._notes.look(kind, self.label(key))
            elif statement.left_out:
                kind = "options of textures that are not read"
                self._notes.look(kind, f"{statement.left_out} of {self.label(key)}")

    def _image(self, key: str) -> Path | None:
        return find_file(self._folder, self._found[key].file, self._images.reach)

    def _first_key(self) -> str:
        """The statement of the texture where all others have to lie."""
        return next(key for key in _PLACED if key in self._found)

    def _lies_with_the_first(self, *keys: str) -> bool:
        first = self._found[self._first_key()].placed
        return all(self._found[key].placed == first for key in keys)

    def _wrap(self, key: str) -> tuple[str, str]:
        return self._found[key].wrap, self._found[key].wrap

    def _colour(self) -> Texture | None:
        if "map_kd" not in self._found:
            return None
        label = self.label("map_kd")
        return colour_texture(
            self._images, self._image("map_kd"), label, self._notes, self._wrap("map_kd")
        )

    def _surface(self) -> Texture | None:
        """The texture of roughness and metal, where all its parts can be read and are placed alike."""
        chosen = [
            next(((key, channel) for key, channel in maps.items() if key in self._found), None)
            for maps in (ROUGHNESS_MAPS, METAL_MAPS)
        ]
        keys = [one[0] for one in chosen if one is not None]
        if not keys:
            return None
        labels = ", ".join(self.label(key) for key in keys)
        if not self._lies_with_the_first(*keys):
            self._notes.look(NOT_PLACED_ALIKE, labels)
            return None
        parts = [None if one is None else self._texture(one[0], "linear") for one in chosen]
        if sum(part is not None for part in parts) < len(keys):
            self._notes.look(NO_METAL, labels)
            return None
        roughness, metal = (0 if one is None else one[1] for one in chosen)
        return surface_texture(parts[0], parts[1], (roughness, metal))

    def _emission(self) -> Texture | None:
        if "map_ke" not in self._found or not self._lies_with_the_first("map_ke"):
            return None
        return self._texture("map_ke", "auto")

    def _opacity(self) -> Texture | None:
        """The texture whose alpha, or grey, makes holes."""
        if "map_d" not in self._found:
            return None
        image, label = self._image("map_d"), self.label("map_d")
        texels = None if image is None else self._images.opacity(image)
        if texels is None or not self._lies_with_the_first("map_d"):
            self._notes.look(NO_OPACITY, label)
            return None
        self._notes.look(HALF_OPAQUE, label)
        return Texture(texels, self._wrap("map_d"))

    def _normal(self) -> Texture | None:
        key = next((key for key in _NORMAL_MAPS if key in self._found), None)
        if key is None:
            return None
        found = self._texture(key, "linear") if self._lies_with_the_first(key) else None
        if found is None:
            self._notes.look(NO_NORMALS, self.label(key))
        return found

    def _texture(self, key: str, encoding: str) -> Texture | None:
        image = self._image(key)
        return None if image is None else self._images.texture(image, encoding, self._wrap(key))
