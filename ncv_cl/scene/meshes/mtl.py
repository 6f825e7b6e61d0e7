"""Material libraries of OBJ files (MTL) in the renderer's terms.

Nothing here raises: a property that cannot be rendered is noted, and the nearest value is taken.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from .common import FALLBACK_ALBEDO, Colour, FileMaterial, Notes, metallic_model, three
from .files import find_file, read_text
from .textures import mean_colour

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
# Models without highlights, and those that let light through.
_DIFFUSE, _TRANSPARENT = (0, 1), (4, 6, 7, 9)
# Arguments of a texture's options; -o, -s and -t have up to three.
_OPTIONS = {"-mm": 2, "-o": 3, "-s": 3, "-t": 3}

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

    def __init__(self, name: str, statements: Statements, folder: Path, notes: Notes) -> None:
        self._name = name
        self._statements = statements
        self._folder = folder
        self._notes = notes
        self._numbers: dict[str, list[float]] = {}

    def material(self) -> FileMaterial:
        """The material; notes what it has that is not read."""
        diffuse, specular, emission = self._colours()
        exponent = self._number("ns", 0.0)
        # Blinn-Phong exponent to GGX: alpha = sqrt(2 / (Ns + 2)), roughness = sqrt(alpha).
        roughness = (2.0 / (max(exponent, 0.0) + 2.0)) ** 0.25
        roughness = self._number("pr", roughness)
        if _METAL & set(self._statements):
            diffuse, specular = metallic_model(diffuse, self._metallic())
        self._note_what_is_not_read()
        return FileMaterial(self._name, diffuse, specular, roughness, emission)

    def _metallic(self) -> float:
        """Pm; 0 under a texture that is not read."""
        if set(self._statements) & _METAL - {"pm"}:
            return 0.0
        return min(max(self._number("pm", 0.0), 0.0), 1.0)

    def _colours(self) -> tuple[Colour, Colour, Colour]:
        """Kd, Ks and Ke, each times the mean of its texture."""
        textured = "map_kd" in self._statements
        diffuse = self._colour("kd", 1.0 if textured else None)
        if diffuse is None:
            self._notes.look(f"materials without Kd, whose albedo is {FALLBACK_ALBEDO:g}", self._name)
            diffuse = three(FALLBACK_ALBEDO)
        elif textured and not any(diffuse):
            # Many tools write a black colour with a texture; then the texture counts as if the colour
            # were white.
            self._notes.look(
                "materials with a black Kd beside a texture, which is taken for white", self._name
            )
            diffuse = three(1.0)
        specular = self._colour("ks", 1.0 if "map_ks" in self._statements else 0.0)
        emission = self._colour("ke", 1.0 if "map_ke" in self._statements else 0.0)
        highlights = self._model() not in _DIFFUSE
        specular = self._textured("map_ks", specular, 0.0) if highlights else three(0.0)
        return (
            self._textured("map_kd", diffuse, FALLBACK_ALBEDO),
            specular,
            self._textured("map_ke", emission, 0.0),
        )

    def _textured(self, key: str, factor: Colour, fallback: float) -> Colour:
        if key not in self._statements:
            return factor
        name = _texture_name(self._statements[key])
        mean = mean_colour(find_file(self._folder, name))
        label = f"{_LABELS[key]} {name} of {self._name}"
        if mean is None:
            kind = f"textures that are missing or cannot be read, in whose place {fallback:g} stands"
            self._notes.look(kind, label)
            mean = three(fallback)
        else:
            self._notes.look("textures are not read, their mean colour stands for them", label)
        return three(np.multiply(factor, mean))

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
        for key, text in self._statements.items():
            if key in ("map_kd", "map_ks", "map_ke"):
                continue
            if key in _TEXTURES:
                label = f"{_LABELS.get(key, key)} {_texture_name(text)} of {name}"
                look("textures are not read, the surface is as without them", label)
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


def _texture_name(text: str) -> str:
    """The file of a texture statement, behind its options."""
    words = text.split()
    while len(words) > 1 and words[0].startswith("-"):
        limit = _OPTIONS.get(words.pop(0), 1)
        fewest = 1 if limit == 3 else limit
        for i in range(limit):
            if len(words) > 1 and (i < fewest or _is_number(words[0])):
                words.pop(0)
            else:
                break
    return " ".join(words)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
