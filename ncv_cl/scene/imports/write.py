"""A scene file of another kind, written as ours with its files beside it."""

from __future__ import annotations

import io
import shutil
from pathlib import Path
from typing import Any

import numpy as np
from plyfile import PlyData, PlyElement

from ...host.files import check_paths, write_whole
from ..table import SceneError
from .toml_text import toml_text

_ARRAYS = ("vertices", "triangles", "normals", "uv")


def write_scene(
    tables: dict[str, Any], source: Path, read: set[Path], target: Path, origin: str
) -> list[Path]:
    """Write tables as a TOML file; returns the paths of all files that it takes.

    Files of the source's folder are copied to the same places in the target's. Meshes given by arrays
    become PLY files in double precision. Files that lie elsewhere stay there, named by their whole path.

    Parameters
    ----------
    tables : dict
    source : Path
        The scene file that they are from.
    read : set of Path
        The files that it takes.
    target : Path
        The TOML file.
    origin : str
        What the file's first line says.

    Raises
    ------
    SceneError
        If another file is in the place of a copy.
    OSError
        If a file cannot be written.
    """
    check_paths({"the scene": target}, {"the source": source})
    tables = dict(tables)
    written = []
    if "meshes" in tables:
        tables["meshes"] = [dict(entry) for entry in tables["meshes"]]
        arrays = [entry for entry in tables["meshes"] if "vertices" in entry]
        for number, entry in enumerate(arrays, 1):
            path = target.with_name(f"{target.stem}_{number}.ply")
            mesh = {key: entry.pop(key) for key in _ARRAYS if key in entry}
            _write(path, ply_bytes(**mesh))
            entry["file"] = path.name
            written.append(path)
    # What Mitsuba's own files say is in the tables.
    copied = {file for file in read if file.suffix.lower() not in (".xml", ".serialized")}
    copies = _copies(source.parent, copied, target.parent)
    _name_what_stays(tables, source.parent)
    for file, copy in copies.items():
        _copy(file, copy)
    text = f"# {' '.join(origin.split())}\n\n{toml_text(tables)}"
    _write(target, text.encode())
    return [target, *written, *copies.values()]


def _write(path: Path, content: bytes) -> None:
    write_whole(path, lambda file: file.write(content))


def _copies(folder: Path, read: set[Path], target: Path) -> dict[Path, Path]:
    """Where files of a folder are copied to; those elsewhere, and those in place, are left out."""
    folder, target = folder.resolve(), target.resolve()
    inside = [file for file in sorted(read) if file.is_relative_to(folder)]
    places = {file: target / file.relative_to(folder) for file in inside}
    return {file: place for file, place in places.items() if file != place}


def _copy(file: Path, place: Path) -> None:
    if place.exists():
        if place.is_file() and place.read_bytes() == file.read_bytes():
            return
        raise SceneError(f"{place} is in the place of a copy of {file}; choose another folder")
    place.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(file, place)


def _name_what_stays(value: Any, folder: Path) -> None:
    """Give files outside of a folder their whole path, in place."""
    for one in value.values() if isinstance(value, dict) else value:
        if isinstance(one, (dict, list)):
            _name_what_stays(one, folder)
    if isinstance(value, dict) and isinstance(value.get("file"), str):
        path = (folder / value["file"]).resolve()
        if path.exists() and not path.is_relative_to(folder.resolve()):
            value["file"] = path.as_posix()


def ply_bytes(
    vertices: np.ndarray,
    triangles: np.ndarray,
    normals: np.ndarray | None = None,
    uv: np.ndarray | None = None,
) -> bytes:
    """A mesh as a binary PLY file in double precision."""
    columns = dict(zip("xyz", np.transpose(vertices), strict=True))
    if normals is not None:
        columns |= dict(zip(("nx", "ny", "nz"), np.transpose(normals), strict=True))
    if uv is not None:
        columns |= dict(zip("uv", np.transpose(uv), strict=True))
    rows = np.zeros(len(vertices), [(name, "<f8") for name in columns])
    for name, column in columns.items():
        rows[name] = column
    faces = np.zeros(len(triangles), [("vertex_indices", "<i4", (3,))])
    faces["vertex_indices"] = triangles
    buffer = io.BytesIO()
    elements = [PlyElement.describe(rows, "vertex"), PlyElement.describe(faces, "face")]
    PlyData(elements, byte_order="<").write(buffer)
    return buffer.getvalue()
