"""Scene files of Mitsuba (0.5 to 3) as a tree of plugins, by Mitsuba's own parser.

The parser substitutes parameters, composes transforms, resolves references and brings old dialects up to
date; it loads no plugin and no other file. Before it sees the text, that is read by `defusedxml`, which
refuses document types and with them entities. Files that are included are put in here, so that none is
read from beyond the scene's folder, and what the parser does not take of old dialects is rewritten.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any
from xml.etree.ElementTree import Element, ParseError, tostring

import numpy as np

from ..meshes.common import Notes
from ..meshes.files import find_file
from ..textures.image_file import ImageFiles
from ..textures.texture import linear_from_srgb

INSTALL = "reading Mitsuba's scene files takes Mitsuba's parser: pip install 'ncv_cl[mitsuba]'"
# Nested deeper, and larger, no scene file is; meshes and images are files of their own.
_DEEPEST, _LARGEST_FILE, _MOST_ELEMENTS = 64, 1 << 26, 1 << 20
_RENAMED = {"lookAt": "lookat", "luminaire": "emitter", "camera": "sensor", "srgb": "rgb"}
_HEX = re.compile(r"#[0-9a-fA-F]{6}")
_PLACE = re.compile(r"^.*?Error while loading .*?\(line \d+, col \d+\): ", re.DOTALL)


@dataclass(eq=False)
class Plugin:
    """An object of a scene.

    Attributes
    ----------
    category : str
        Such as "shape", "bsdf", "emitter".
    kind : str
        The plugin's name, such as "rectangle".
    name : str
        Its id; empty if it has none.
    values : dict
        Numbers, texts, colours (tuples of three), vectors and transforms (arrays), plugins.
    children : list of Plugin
        Those without a name of their own, in their order.
    """

    category: str
    kind: str
    name: str
    values: dict[str, Any] = field(default_factory=dict)
    children: list[Plugin] = field(default_factory=list)

    def parts(self, category: str) -> list[Plugin]:
        """Plugins of a category among children and values."""
        named = [value for value in self.values.values() if isinstance(value, Plugin)]
        return [one for one in (*self.children, *named) if one.category == category]


def read_xml(path: Path, images: ImageFiles, notes: Notes) -> Plugin:
    """The scene of a file.

    Raises
    ------
    ValueError
        If the file or one that it includes cannot be read, is no scene or has a document type.
    ImportError
        If Mitsuba is not installed.
    """
    mitsuba = _import_mitsuba()
    root = _included(path, images, notes, 0)
    if root.tag != "scene":
        raise ValueError(f"cannot be read as a Mitsuba scene: its root is <{root.tag}>, not <scene>")
    root.attrib.setdefault("version", "3.0.0")
    config = _config(mitsuba)
    try:
        state = mitsuba.parser.parse_string(config, tostring(root, encoding="unicode"))
        return plugins(mitsuba, config, state)
    except RuntimeError as error:
        raise ValueError(f"cannot be read as a Mitsuba scene: {_PLACE.sub('', str(error))}") from error


def read_dict(scene: dict[str, Any]) -> Plugin:
    """The same of what `mitsuba.load_dict` takes, if it holds dictionaries and numbers only."""
    mitsuba = _import_mitsuba()
    config = _config(mitsuba)
    return plugins(mitsuba, config, mitsuba.parser.parse_dict(config, scene))


def _import_mitsuba() -> ModuleType:
    try:
        import defusedxml.ElementTree  # noqa: F401
        import mitsuba
        import mitsuba.parser

        # Its types of colours; the variant that others have set stays.
        import mitsuba.scalar_rgb
    except ImportError as error:
        raise ImportError(INSTALL) from error
    return mitsuba


def _config(mitsuba: ModuleType) -> Any:
    config = mitsuba.parser.ParserConfig("scalar_rgb")
    config.unused_parameters = mitsuba.LogLevel.Debug
    return config


# ---- text -----------------------------------------------------------------------------------------


def _included(path: Path, images: ImageFiles, notes: Notes, depth: int) -> Element:
    """The root of a file, its includes put in and rewritten."""
    from defusedxml.common import DefusedXmlException
    from defusedxml.ElementTree import fromstring

    images.reach.checked(path)
    try:
        if path.stat().st_size > _LARGEST_FILE:
            raise ValueError(f"{path.name} is too large: {_LARGEST_FILE:,} bytes are read")
        root = fromstring(path.read_bytes(), forbid_dtd=True)
    except OSError as error:
        raise ValueError(f"cannot read the scene file: {error.strerror}") from error
    except DefusedXmlException as error:
        raise ValueError(f"{path.name} has a document type or an entity, and none is read") from error
    except (ParseError, LookupError) as error:
        raise ValueError(f"cannot be read as XML: {error}") from error
    _check_size(root)
    for parent in [one for one in root.iter() if one.tag not in ("transform", "animation")]:
        children: list[Element] = []
        for child in parent:
            if child.tag == "include":
                children += _of_include(child, path, images, notes, depth)
            elif child.tag == "path":
                notes.shape("search paths are not read", child.get("value", ""))
            elif child.tag == "blackbody":
                notes.look("spectra of black bodies are taken for white", parent.get("type", parent.tag))
                children.append(Element("rgb", {"name": child.get("name", ""), "value": "1"}))
            else:
                children.append(child)
        parent[:] = children
    for one in root.iter():
        _rewrite(one)
    return root


def _check_size(root: Element) -> None:
    layer, count = [root], 0
    for _ in range(_DEEPEST):
        count += len(layer)
        layer = [child for one in layer for child in one]
        if count > _MOST_ELEMENTS:
            raise ValueError(f"the file has more than {_MOST_ELEMENTS:,} elements")
    if layer:
        raise ValueError(f"the file is nested deeper than {_DEEPEST} elements")


def _of_include(
    element: Element, path: Path, images: ImageFiles, notes: Notes, depth: int
) -> Iterator[Element]:
    name = element.get("filename", "")
    if depth > 8:
        raise ValueError(f"{path.name} includes {name!r}, nine files deep: do they include each other?")
    file = find_file(path.parent, name, images.reach)
    if file is None:
        raise ValueError(f"{path.name} includes {name!r}, which does not exist")
    root = _included(file, images, notes, depth + 1)
    return iter(root) if root.tag == "scene" else iter([root])


def _rewrite(element: Element) -> None:
    """What the parser does not take as older dialects have it."""
    encoded = element.tag == "srgb"
    element.tag = _RENAMED.get(element.tag, element.tag)
    if element.tag in ("rgb", "spectrum"):
        element.attrib.pop("intent", None)
        value = element.get("value", "").strip()
        numbers = _numbers(value)
        if _HEX.fullmatch(value):
            numbers, encoded = [int(value[i : i + 2], 16) / 255 for i in (1, 3, 5)], True
        if len(numbers) in (1, 3) and (encoded or len(numbers) == 3 or element.tag == "rgb"):
            if encoded:
                numbers = linear_from_srgb(np.clip(numbers, 0.0, 1.0)).tolist()
            element.tag = "rgb"
            element.set("value", ", ".join(map(repr, map(float, numbers))))
    elif element.tag == "boolean":
        element.set("value", element.get("value", "").strip().lower())


def _numbers(text: str) -> list[float]:
    try:
        return [float(word) for word in text.replace(",", " ").split()]
    except ValueError:
        return []


# ---- nodes ----------------------------------------------------------------------------------------


def plugins(mitsuba: ModuleType, config: Any, state: Any) -> Plugin:
    """The tree of a parser's state, brought up to date, with references resolved."""
    mitsuba.parser.transform_upgrade(config, state)
    mitsuba.parser.transform_resolve_references(config, state)
    found: dict[int, Plugin] = {}
    nodes = list(state.nodes)

    def convert(index: int, above: tuple[int, ...]) -> Plugin:
        if index in above or len(above) > 2 * _DEEPEST:
            raise ValueError("cannot be read as a Mitsuba scene: an object refers to itself")
        if index in found:
            return found[index]
        properties, category = nodes[index].props, str(nodes[index].type).rpartition(".")[2].lower()
        name = "" if properties.id().startswith("_") else properties.id()
        plugin = Plugin(category, properties.plugin_name(), name)
        for key in list(properties.keys()):
            value = _plain(mitsuba, properties[key])
            if isinstance(value, _Reference):
                value = convert(value.index, (*above, index))
            if key.startswith("_arg_") and isinstance(value, Plugin):
                plugin.children.append(value)
            else:
                plugin.values[key] = value
        found[index] = plugin
        return plugin

    return convert(0, ())


@dataclass(frozen=True)
class _Reference:
    index: int


def _plain(mitsuba: ModuleType, value: Any) -> Any:
    """A value of the parser's as one of Python's."""
    kind = type(value).__name__
    if isinstance(value, (bool, int, float, str)):
        return value
    if kind == "ResolvedReference":
        return _Reference(value.index())
    if kind.startswith("Color"):
        return tuple(float(x) for x in value)
    if kind.startswith("AffineTransform") or kind.startswith("Transform"):
        return np.array(value.matrix, dtype=np.float64)
    if kind == "Spectrum":
        return _rgb_of(mitsuba, value)
    if kind.startswith(("Point", "Vector", "Array")):
        return np.array([float(x) for x in value])
    return str(value)


def _rgb_of(mitsuba: ModuleType, spectrum: Any) -> tuple[float, ...] | float:
    """The colour of a reflectance given at wavelengths; a uniform one is a number."""
    values = [float(x) for x in spectrum.values]
    if spectrum.is_uniform():
        return values[0]
    wavelengths = [float(x) for x in spectrum.wavelengths]
    rgb = mitsuba.scalar_rgb.spectrum_list_to_srgb(wavelengths, values, False, False)
    return tuple(max(float(x), 0.0) for x in rgb)
