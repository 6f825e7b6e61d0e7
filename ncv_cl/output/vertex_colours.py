"""Meshes with a colour for every vertex, as files."""

from __future__ import annotations

from pathlib import Path
from typing import cast

import numpy as np
import trimesh

from ..host.files import write_whole
from ..scene.uv_mesh import Triangles, checked_triangles

COLOURED_MESHES = (".ply", ".glb")


def write_vertex_colours(path: str | Path, mesh: Triangles, values: np.ndarray) -> None:
    """Write a mesh with colours of eight bits: a PLY's have the sRGB curve, a GLB's are linear.

    Parameters
    ----------
    path : str or Path
        .ply or .glb.
    mesh
        With `vertices` and `triangles`.
    values : ndarray
        (vertices, 3), or (vertices,) or (vertices, 1) for grey; clamped to [0, 1].

    Raises
    ------
    ValueError
        For another suffix, and values of another shape.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in COLOURED_MESHES:
        raise ValueError(f"{path} must end in {' or '.join(COLOURED_MESHES)}")
    vertices, triangles, _ = checked_triangles(mesh)
    values = np.asarray(values, np.float64)
    if values.shape not in ((len(vertices),), (len(vertices), 1), (len(vertices), 3)):
        raise ValueError(f"values must be ({len(vertices)}, 3), are {values.shape}")
    linear = np.clip(np.nan_to_num(values.reshape(len(vertices), -1)), 0.0, 1.0) + np.zeros(3)
    curve = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    bytes_ = np.rint(255 * (curve if suffix == ".ply" else linear)).astype(np.uint8)
    coloured = trimesh.Trimesh(vertices, triangles, vertex_colors=bytes_, process=False)
    written = coloured.export(file_type=suffix[1:])
    # Both kinds of file are bytes, of what trimesh may return.
    content = cast(bytes, written)
    write_whole(path, lambda file: file.write(content))
