"""Textures and colours of Mitsuba's objects as a scene file's."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from ..meshes.common import FALLBACK_ALBEDO, Notes
from ..meshes.files import find_file
from ..meshes.textures import MISSING, mean_colour
from ..textures.image_file import ImageFiles
from .mitsuba_xml import Plugin

FLOATS = np.float64
_WRAPS = {"repeat": "repeat", "mirror": "mirror", "clamp": "clamp"}
# Textures without images: the keys of their colours, with Mitsuba's defaults.
_PATTERNS = {
    "checkerboard": (("color0", 0.4), ("color1", 0.2)),
    "gridtexture": (("color0", 0.2), ("color1", 0.4)),
}
_COLOURS = ("rgb", "srgb", "uniform", "d65", "irregular", "regular")


class Textures:
    """Reads textures of a file in `folder`.

    Attributes
    ----------
    folder : Path
    downwards : bool
        Whether the surfaces' v is Mitsuba's, 0 at an image's upper side; else ours, 0 at its lower side.
    """

    def __init__(self, folder: Path, images: ImageFiles, notes: Notes) -> None:
        self.downwards = False
        self.folder = folder
        self._images = images
        self._notes = notes

    def file(self, name: object) -> str | None:
        """A file's path from the scene's folder; None if it does not exist."""
        found = find_file(self.folder, str(name), self._images.reach)
        if found is None:
            return None
        return Path(os.path.relpath(found, self.folder)).as_posix()

    def table(self, texture: Plugin, encoding: str) -> dict[str, Any] | None:
        """An image as a material's value; None, and noted, where it cannot be read.

        Parameters
        ----------
        encoding : str
            Of an image that is not `raw`.
        """
        file = self.file(texture.values.get("filename", ""))
        if file is None or self._images.texels(self.folder / file) is None:
            kind = MISSING.format(f"{FALLBACK_ALBEDO:g}")
            self._notes.look(kind, str(texture.values.get("filename", texture.name)))
            return None
        found: dict[str, Any] = {"file": file}
        wrap = texture.values.get("wrap_mode", "repeat")
        if wrap not in _WRAPS:
            self._notes.look("ways of going on beyond an image that are not known", str(wrap))
        elif wrap != "repeat":
            found["wrap"] = wrap
        if texture.values.get("filter_type") == "nearest":
            found["filter"] = "nearest"
        encoding = "linear" if texture.values.get("raw", False) else encoding
        if encoding != "auto":
            found["encoding"] = encoding
        return found | self._placement(texture)

    def mean(self, value: object) -> Any:
        """A number, or a colour (tuple of three); of a texture its mean, which is noted."""
        if isinstance(value, (int, float)):
            return float(value)
        if isinstance(value, (tuple, np.ndarray)):
            return tuple(float(x) for x in value)
        if not isinstance(value, Plugin):
            raise ValueError(f"{value!r} is no number, colour or texture")
        if value.kind == "bitmap":
            file = self.file(value.values.get("filename", ""))
            mean = None if file is None else mean_colour(self._images, self.folder / file)
            return FALLBACK_ALBEDO if mean is None else mean
        if value.kind in _COLOURS:
            return self._constant(value)
        if value.kind in _PATTERNS:
            self._notes.look("patterns are not read, their mean colour stands for them", value.kind)
            colours = [
                np.broadcast_to(self.mean(value.values.get(k, d)), 3) for k, d in _PATTERNS[value.kind]
            ]
            return tuple(np.mean(colours, axis=0).tolist())
        kind = f"textures that are not read, in whose place {FALLBACK_ALBEDO:g} stands"
        self._notes.look(kind, value.kind)
        return FALLBACK_ALBEDO

    def _constant(self, value: Plugin) -> Any:
        for key in ("color", "value", "scale"):
            found = value.values.get(key)
            if isinstance(found, (int, float, tuple)):
                return self.mean(found)
        if value.kind not in ("uniform", "d65"):
            self._notes.look("spectra that are not read are taken for white", value.kind)
        return 1.0

    def metal(self, name: str, part: str) -> np.ndarray:
        """The "eta" or "k" of one of Mitsuba's metals as a colour (3,).

        Raises
        ------
        ValueError
            If there is no such metal.
        """
        import mitsuba.scalar_rgb as rgb

        folder = Path(rgb.__file__).parent / "data" / "ior"
        file = folder / f"{Path(name).name}.{part}.spd"
        if not file.is_file():
            raise ValueError(f"Mitsuba has no metal {name!r}")
        rows = [row.split() for row in file.read_text().splitlines() if row.strip() and row[0] != "#"]
        wavelengths, values = np.array([row[:2] for row in rows], dtype=FLOATS).T.tolist()
        return np.array(rgb.spectrum_list_to_srgb(wavelengths, values, False, False), dtype=FLOATS)

    def _placement(self, texture: Plugin) -> dict[str, Any]:
        """Scale and offset of an image, by `to_uv` for Mitsuba's v, which goes downwards."""
        matrix = texture.values.get("to_uv")
        matrix = np.eye(4) if matrix is None else np.asarray(matrix)
        # Of two coordinates, in whatever size the parser has it: the translation is in the last column.
        (su, shear1), (shear2, sv) = matrix[0, :2], matrix[1, :2]
        ou, ov = matrix[0, -1], matrix[1, -1]
        if abs(shear1) + abs(shear2) > 1e-6 * (abs(su) + abs(sv)) or not su * sv:
            self._notes.look("images that are turned or sheared, which are not", texture.name)
            su, sv = np.hypot(su, shear2) or 1.0, np.hypot(sv, shear1) or 1.0
        # v' = sv v + ov from above is 1 − v' from below, of a v that is from above or below itself.
        scale, offset = ([su, -sv], [ou, 1.0 - ov]) if self.downwards else ([su, sv], [ou, 1 - sv - ov])
        found: dict[str, Any] = {}
        if scale != [1.0, 1.0]:
            found["scale"] = [float(x) for x in scale]
        if np.abs(offset).max() > 0.0:
            found["offset"] = [float(x) for x in offset]
        return found
