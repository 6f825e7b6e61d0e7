"""What a scene's materials say of textures: a table in a scene file, a `Texture` in Python."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..table import Table
from .image_file import ENCODINGS, ImageFiles
from .texture import AS_IT_IS, WRAPS, Maps, Placement, Texture

_KEYS = ("file", "factor", "scale", "offset", "wrap", "filter", "encoding")
# What may be a texture.
_TEXTURED = ("albedo", "roughness", "emission", "opacity", "normal")
_FILTERS = ("linear", "nearest")


def read_maps(table: Table, images: ImageFiles) -> tuple[Maps | None, Table]:
    """The textures of a material's table, and that table with factors in their place.

    Files are relative to the scene file's folder.

    Raises
    ------
    SceneError
        If a texture's table has an unknown or wrong key, its file cannot be read, is too large or holds
        colours beyond 1, or two textures of the material are placed differently.
    """
    if "maps" in table:
        # Of a scene that was built before.
        maps = table.raw("maps")
        if not isinstance(maps, Maps):
            raise table.error(
                "maps", "unknown key; textures are values of albedo, roughness and emission"
            )
        return maps, table
    found: dict[str, Texture] = {}
    placements: dict[str, Placement] = {}
    factors: dict[str, object] = {}
    for key in _TEXTURED:
        value = table.raw(key) if key in table else None
        if isinstance(value, Texture):
            found[key], placements[key], factors[key] = value, AS_IT_IS, 1.0
        elif isinstance(value, dict):
            own = Table(table.source, f"{table.where}.{key}", value, _KEYS)
            for unused in ("factor", "encoding"):
                if key == "opacity" and unused in own:
                    raise own.error(unused, "opacity has none: below a half there is a hole")
            # Others are no colours: their integers are not encoded as those of colours.
            default = "auto" if key in ("albedo", "emission") else "linear"
            found[key] = _read_texture(own, images, default, key == "opacity")
            placements[key] = _placement(own)
            factors[key] = own.raw("factor") if "factor" in own else 1.0
        if key in found and key != "emission" and not _in_range(found[key]):
            raise table.error(key, "the image holds values outside [0, 1]")
        if key in ("opacity", "normal") and key in table and key not in found:
            raise table.error(key, "expected a table { file = ... }")
    if not found:
        return None, table
    first = next(iter(placements))
    for key, placement in placements.items():
        if placement != placements[first]:
            raise table.error(key, f"its scale and offset must be those of {first}'s texture")
    scale = Table(table.source, table.where, factors, _TEXTURED).number("normal", 1.0)
    maps = Maps(
        found.get("albedo"),
        found.get("roughness"),
        found.get("emission"),
        found.get("opacity"),
        found.get("normal"),
        normal_scale=scale,
        placement=placements[first],
    )
    return maps, table.replaced(factors)


def _read_texture(table: Table, images: ImageFiles, encoding: str, of_opacity: bool) -> Texture:
    wraps = table.raw("wrap") if "wrap" in table else "repeat"
    wraps = [wraps, wraps] if isinstance(wraps, str) else wraps
    if not (isinstance(wraps, list) and len(wraps) == 2 and all(one in WRAPS for one in wraps)):
        raise table.error("wrap", f"expected one of {', '.join(WRAPS)}, or two of them, got {wraps!r}")
    nearest = table.choice("filter", _FILTERS, "linear") == "nearest"
    encoding = table.choice("encoding", ENCODINGS, encoding)
    file = Path(table.source).parent / table.text("file")
    if not file.is_file():
        raise table.error("file", f"the image {file.name} does not exist")
    try:
        texels = images.opacity(file) if of_opacity else images.texels(file, encoding)
    except (ValueError, OSError) as error:
        raise table.error("file", f"{file.name}: {error}") from error
    if texels is None:
        raise table.error("file", f"{file.name} cannot be read as an image")
    return Texture(texels, (wraps[0], wraps[1]), nearest)


def _placement(table: Table) -> Placement:
    (su, sv), (ou, ov) = (table.pair(key, default) for key, default in (("scale", 1.0), ("offset", 0.0)))
    if not (su and sv):
        raise table.error("scale", "is zero: the image would be one colour")
    return (su, 0.0, ou, 0.0, sv, ov)


def _in_range(texture: Texture) -> bool:
    colours = texture.texels[:, :, :3]
    return bool(np.min(colours) >= 0 and np.max(colours) <= 1)
