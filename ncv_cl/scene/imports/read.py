"""A scene file of any kind as tables."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from ..meshes import KINDS as MESH_KINDS
from ..table import SceneError
from ..textures.image_file import ImageFiles
from .found import Found
from .mesh_scene import mesh_scene
from .mitsuba_scene import mitsuba_scene

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

# Suffixes of the scene files that are read. Others are taken for TOML.
SCENE_KINDS = (".toml", *MESH_KINDS, ".xml")
# Of a file that lacks a part, has one of another type than its format says, or is nested too deeply.
_MALFORMED = (KeyError, TypeError, AttributeError, IndexError, ArithmeticError, RecursionError)


def read_tables(path: Path, images: ImageFiles, camera: str | None = None) -> Found:
    """The tables of a scene file, by its suffix.

    Parameters
    ----------
    path : Path
    images : ImageFiles
        Its `reach` says which files may be read.
    camera : str, optional
        The name of one of the file's cameras; the first by default.

    Raises
    ------
    SceneError
        If the file is missing or cannot be read, or has no such camera.
    """
    kind = path.suffix.lower()
    try:
        if kind in MESH_KINDS:
            return mesh_scene(path, images, camera)
        if kind == ".xml":
            return mitsuba_scene(path, images, camera)
    except (ValueError, ImportError) as error:
        raise SceneError(f"{path}: {error}") from error
    except _MALFORMED as error:
        raise SceneError(f"{path}: cannot be read, for it is malformed: {error!r}") from error
    if camera is not None:
        raise SceneError(f"{path}: a TOML file has one camera, and none is chosen by name ({camera!r})")
    return Found(_read_toml(path))


def _read_toml(path: Path) -> dict[str, Any]:
    try:
        # Notepad and others write a byte-order mark, which TOML does not know.
        return tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise SceneError(f"{path}: cannot read the scene file: {error.strerror}") from error
    except RecursionError as error:
        raise SceneError(f"{path}: not a TOML file: it is nested too deeply") from error
    except ValueError as error:  # TOML syntax, which carries its line, or text that is not UTF-8
        raise SceneError(f"{path}: not a TOML file: {error}") from error
