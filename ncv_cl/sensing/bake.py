"""Baking: light that arrives at a mesh, or ambient occlusion, as a map over its UVs."""

from __future__ import annotations

import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from ..host.version import package_version
from ..integrands import Integrand
from ..output.image import Image, Metadata
from ..output.report import finite
from ..points.arrays import PointArrays, surfaces_at
from ..points.hidden import apart, inside
from ..points.texels import Texels, find_texels
from ..points.trace import Tracer
from ..rendering.render import integrand_of
from ..scene.load import Scene, load_scene
from ..scene.uv_mesh import BakeError, TrianglesOnMap
from ..settings.options import MOST_CELLS, checked_whole
from .point_estimate import estimate_points

ALL_BACKS = "all points of the mesh see the backs of triangles only: turn its triangles' corners round"
# Texels around each, by their places in a map with one more row and column on every side.
_AROUND = [(row, column) for row in range(3) for column in range(3) if (row, column) != (1, 1)]


def bake(
    scene: Scene | str | Path,
    mesh: TrianglesOnMap,
    size: int | tuple[int, int],
    *,
    integrand: str | Integrand = "ao",
    samples: int = 2,
    padding: int = 4,
    **options: object,
) -> Image:
    """A map over a mesh's UVs: of ambient occlusion, or of light.

    Parameters
    ----------
    scene : Scene, str or Path
        The mesh should be part of it; points of the mesh that lie on no surface are counted.
    mesh : UVMesh
        Or anything with `vertices`, `triangles`, `uv` and, if there are some, `normals`.
    size : int or (int, int)
        Texels of a side, or width and height.
    integrand : {"ao", "direct", "gi"}, str or Integrand
        Of "direct" and "gi" the map holds irradiance over pi, so albedo times map is the radiance of a
        matte surface.
    samples : int
        k makes k × k places a texel; a texel is the mean of those that are on the mesh.
    padding : int
        Texels around charts that are filled from their neighbours.
    **options
        As `irradiance` takes them; `spp` and `target_error` are for each place.

    Returns
    -------
    Image
        Pixels and variances of the map, its first row at v = 1, and the layers "coverage", the part of
        the texel's places that are on the mesh, and "N", normals in the world. What is empty is 0.

    Raises
    ------
    BakeError
        If the mesh has no UVs, an array is not as it should be, or nothing of it is on the map or on the
        scene's surfaces.
    ValueError, TypeError
        As `irradiance` raises them.

    Warns
    -----
    UserWarning
        For UVs without area, beyond the map, or that overlap; and points beside the scene's surfaces.

    Notes
    -----
    Nothing leaks through walls: places inside of something, which see the backs of triangles mostly, do
    not count, nor do those that something separates from the texel's place next to its middle. Texels
    without any other place are filled as padding is.
    """
    started = time.perf_counter()
    if not isinstance(scene, Scene):
        scene = load_scene(scene)
    width, height = _size(size)
    samples = checked_whole("samples", samples, 64)
    if padding != 0:
        padding = checked_whole("padding", padding, MOST_CELLS)
    chosen = integrand_of(integrand)
    found = find_texels(mesh, (width, height), samples)
    if not len(found.cell):
        raise BakeError("no texel is on the mesh: it lies beside the map, or has no area there")
    texel, is_kept, counts = _kept(scene, found, (width, height), samples)
    grid = (width * samples, height * samples)
    values, variance, stats = _estimates(scene, chosen, found, is_kept, grid, options)
    number = np.bincount(texel[is_kept], minlength=width * height).reshape(height, width)
    factor = np.maximum(number, 1)[..., None]
    pixels = _sums(values, texel[is_kept], number.shape) / factor + np.zeros(3)
    spread = _sums(variance, texel[is_kept], number.shape) / factor**2 + np.zeros(3)
    planes = _dilated(np.concatenate([pixels, spread], axis=2), number > 0, padding)
    metadata: Metadata = {"version": package_version(), "scene": scene.name, "integrand": chosen.name}
    stats |= counts | {
        "texels": int(np.count_nonzero(number)),
        "mean_standard_error": float(np.sqrt(spread[number > 0]).mean()),
    }
    stats["seconds"]["total"] = time.perf_counter() - started
    layers = _layers(found, texel, number.shape, samples)
    return Image(planes[..., :3], planes[..., 3:], layers, finite(stats), metadata)


def _layers(
    found: Texels, texel: np.ndarray, shape: tuple[int, int], samples: int
) -> dict[str, np.ndarray]:
    normals = _sums(found.normals, texel, shape)
    normals /= np.maximum(np.linalg.norm(normals, axis=2, keepdims=True), 1e-300)
    on_mesh = np.bincount(texel[~found.clamped], minlength=shape[0] * shape[1])
    return {"coverage": on_mesh.reshape(shape) / samples**2, "N": normals}


def _size(size: int | tuple[int, int]) -> tuple[int, int]:
    pair = size if isinstance(size, (tuple, list, np.ndarray)) else (size, size)
    if len(pair) != 2:
        raise ValueError(f"size must be a number or a width and a height, got {size!r}")
    width, height = (checked_whole(f"size[{k}]", one, MOST_CELLS) for k, one in enumerate(pair))
    return width, height


def _kept(
    scene: Scene, found: Texels, size: tuple[int, int], samples: int
) -> tuple[np.ndarray, np.ndarray, dict[str, int]]:
    """The texel of each place, int64; which places count, bool; and numbers for statistics."""
    columns = size[0] * samples
    column, row = found.cell % columns, found.cell // columns
    texel = row // samples * size[0] + column // samples
    half = (samples - 1) / 2
    from_middle = np.hypot(column % samples - half, row % samples - half)
    positions = found.positions - scene.origin
    tracer = Tracer(scene)
    detached = check_on_scene(scene, tracer, positions, found.normals)
    hidden = inside(scene, tracer, positions, found.normals)
    left = np.flatnonzero(~hidden)
    behind = np.zeros(len(texel), bool)
    behind[left] = apart(
        scene, tracer, positions[left], found.normals[left], texel[left], from_middle[left]
    )
    is_kept = ~(hidden | behind)
    if not is_kept.any():
        raise BakeError(ALL_BACKS)
    counts = found.counts | {
        "places": len(texel),
        "places_detached": detached,
        "places_inside": int(hidden.sum()),
        "places_apart": int(behind.sum()),
        "texels_clamped": int(found.clamped.sum()),
        "texels_inside": len(np.unique(texel)) - len(np.unique(texel[is_kept])),
    }
    return texel, is_kept, counts


def check_on_scene(scene: Scene, tracer: Tracer, positions: np.ndarray, normals: np.ndarray) -> int:
    """How many places, in the scene's frame, lie on no surface; raises if all do, and else warns."""
    on_triangle, _, _ = surfaces_at(
        scene, tracer, positions.astype(np.float32), normals.astype(np.float32)
    )
    detached = int((on_triangle < 0).sum())
    if detached == len(positions):
        raise BakeError(
            f"the mesh lies on no surface of {scene.name}: its vertices must be those of the scene, in "
            "the world"
        )
    if detached:
        warnings.warn(
            f"{detached} of {len(positions)} places of the mesh lie on no surface of {scene.name}",
            stacklevel=4,
        )
    return detached


def _estimates(
    scene: Scene,
    integrand: Integrand,
    found: Texels,
    is_kept: np.ndarray,
    grid: tuple[int, int],
    options: dict[str, Any],
) -> tuple[np.ndarray, np.ndarray, dict[str, Any]]:
    """Values and variances of the places that count, and statistics."""
    normals = found.normals[is_kept].astype(np.float32)
    given = PointArrays(
        positions=(found.positions[is_kept] - scene.origin).astype(np.float32),
        normals=normals,
        outgoing=normals,
        cells=found.cell[is_kept].astype(np.uint32),
        size=grid,
        is_sensor=True,
    )
    return estimate_points(scene, integrand, given, options, 1.0)


def _sums(values: np.ndarray, texel: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Sum of `values` (points, channels) over each texel's points, float64 (height, width, channels)."""
    planes = [np.bincount(texel, column, shape[0] * shape[1]) for column in values.T]
    return np.stack(planes, axis=1).reshape(*shape, -1)


def _dilated(planes: np.ndarray, is_known: np.ndarray, rounds: int) -> np.ndarray:
    """The planes (height, width, planes) with what is empty filled by the mean of known neighbours."""
    planes, is_known = planes.copy(), is_known.copy()
    height, width = is_known.shape
    for _ in range(rounds):
        known = np.pad(is_known, 1).astype(float)
        sums = np.pad(planes * is_known[..., None], ((1, 1), (1, 1), (0, 0)))
        around = [(slice(row, row + height), slice(column, column + width)) for row, column in _AROUND]
        number = sum((known[place] for place in around), np.zeros(is_known.shape))
        fresh = ~is_known & (number > 0)
        if not fresh.any():
            break
        total = sum((sums[place] for place in around), np.zeros(planes.shape))
        planes[fresh] = total[fresh] / number[fresh][:, None]
        is_known |= fresh
    return planes
