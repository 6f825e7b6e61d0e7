"""What the readers of scene files return."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from ..meshes import FileMeshes


@dataclass(eq=False)
class Found:
    """A scene file's content.

    Attributes
    ----------
    tables : dict
        As a TOML file has them. Meshes may also be given by arrays, as `build_scene` takes them.
    said : list of str
        What the file has that `tables` do not, one sentence a kind.
    mesh : FileMeshes, optional
        The only mesh file of `tables`, as it stands there, where that has been read before.
    """

    tables: dict[str, Any]
    said: list[str] = field(default_factory=list)
    mesh: FileMeshes | None = None
