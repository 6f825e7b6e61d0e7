"""Shading points from arrays: plane sensors anywhere, or points of the scene's surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..opencl.device import Device
from ..opencl.memory import HostArray
from ..scene.geometry import LARGEST_COORDINATE
from ..scene.load import Scene
from ..scene.textures.surface import surface_at, varies
from .points import (
    MATERIAL,
    RELATIVE_OFFSET,
    SURFACE,
    ShadingPoints,
    material_records,
    points_program,
    triangle_spreads,
    vary_colours,
)
from .trace import Tracer

# A point lies on a surface that is no farther than these parts of its largest coordinate and of the
# scene's: what is computed or written with some six digits.
NEAR_OF_POINT, NEAR_OF_SCENE = 2.0**-16, 2.0**-20
# It is moved onto that surface if it is farther off than this part of the coordinates that enter: half
# of what rays start off surfaces by, and some ten times what rounding makes.
SNAPPED_FROM = 2.0**-20
# A sensor stands on a surface edgewise, and counts as beside it, below this cosine between the normals.
EDGEWISE = 0.01
# Vectors whose length differs from 1 by no more are taken as they are.
UNIT_ROUNDING = 1e-6
# A sensor's material: what it reflects, times pi, is what it receives.
WHITE_RECORD = MATERIAL.pack(albedo=(1, 1, 1), reflectance=(0, 0, 0), roughness=1, ior=0)[None]
# Bits of a coordinate in the order of points.
_MORTON_BITS = 21


@dataclass(frozen=True)
class PointArrays:
    """Points as they are asked for, in the scene's frame.

    Attributes
    ----------
    positions, normals, outgoing : ndarray
        float32 (points, 3); `outgoing` is unit vectors towards the viewer.
    cells : ndarray
        uint32 (points,), where the points are on a grid: neighbours there are neighbours in space.
    size : (int, int)
        Columns and rows of the grid.
    is_sensor : bool
        Whether these are white plane sensors, or points of the scene's surface, which have a material.
    """

    positions: np.ndarray
    normals: np.ndarray
    outgoing: np.ndarray
    cells: np.ndarray
    size: tuple[int, int]
    is_sensor: bool


class PointError(ValueError):
    """Points cannot be used as they are; the message names array and index."""


class OffSurfaceError(PointError):
    """Points of the surface that lie on none; `where` are their rows, int64."""

    def __init__(self, where: np.ndarray) -> None:
        super().__init__("points lie on no surface")
        self.where = where


def checked_vectors(name: str, values: object, shape: tuple[int, ...] | None = None) -> np.ndarray:
    """Finite vectors, float64 (n, 3) or (rows, columns, 3).

    Parameters
    ----------
    shape : tuple, optional
        The shape that another array has, which this one must have too.

    Raises
    ------
    PointError
        Names array and index.
    """
    try:
        found = np.asarray(values)
    except ValueError as error:  # rows of unequal lengths
        raise PointError(f"{name}: expected numbers (n, 3): {error}") from error
    if found.shape == (0,):
        found = found.reshape(0, 3)
    if found.dtype.kind not in "fiu" or found.ndim not in (2, 3) or found.shape[-1] != 3:
        raise PointError(
            f"{name}: expected numbers (n, 3), or (rows, columns, 3), got {found.dtype} {found.shape}"
        )
    if shape is not None and found.shape != shape:
        raise PointError(f"{name}: must have the shape of positions, {shape}, has {found.shape}")
    found = found.astype(np.float64)
    usable = (np.abs(found) <= LARGEST_COORDINATE).all(axis=-1)
    if not usable.all():
        where = tuple(np.argwhere(~usable)[0].tolist())
        raise PointError(f"{_place(name, where)}: {found[where].tolist()} is not finite, or beyond "
                         f"{LARGEST_COORDINATE:g}")  # fmt: skip
    return found


def unit_vectors(name: str, values: object, shape: tuple[int, ...]) -> np.ndarray:
    """As `checked_vectors`, of length 1: others are scaled to that, and zero is an error."""
    found = checked_vectors(name, values, shape)
    # By the largest component first: squares might leave float64's range.
    largest = np.abs(found).max(axis=-1, keepdims=True, initial=0.0)
    if not largest.all():
        where = tuple(np.argwhere(largest[..., 0] == 0)[0].tolist())
        raise PointError(f"{_place(name, where)}: is zero, so it has no direction")
    scaled = found / largest
    scaled /= np.linalg.norm(scaled, axis=-1, keepdims=True)
    length = largest * np.linalg.norm(found / largest, axis=-1, keepdims=True)
    return np.where(np.abs(length - 1.0) <= UNIT_ROUNDING, found, scaled)


def _place(name: str, where: tuple[int, ...]) -> str:
    return name + "".join(f"[{index}]" for index in where)


def ordered(vectors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """An order of points that does not depend on the one they come in, in which neighbours are near.

    Parameters
    ----------
    vectors : ndarray
        float32 (points, numbers), position first; all of a point's numbers count.

    Returns
    -------
    first : ndarray
        int64, one of every kind of equal points, in Morton order of positions.
    number : ndarray
        int64 (points,), which of these each point is.
    """
    position = vectors[:, :3].astype(np.float64)
    lower, extent = position.min(axis=0), np.ptp(position, axis=0).max()
    steps = (position - lower) / (extent or 1.0) * (2**_MORTON_BITS - 1)
    code = _interleaved(steps.astype(np.uint64), 3)
    order = np.lexsort((*vectors.T[::-1], code))
    rows = vectors[order]
    is_new = np.append(True, (rows[1:] != rows[:-1]).any(axis=1))
    number = np.empty(len(vectors), np.int64)
    number[order] = np.cumsum(is_new) - 1
    return order[is_new], number


def curve_cells(points: int) -> tuple[np.ndarray, tuple[int, int]]:
    """Cells of a square grid along a Z curve, uint32 (points,), and the grid's size."""
    side = 1
    while side * side < points:
        side *= 2
    rank = np.arange(points, dtype=np.uint64)
    axes = np.zeros((2, points), np.uint64)
    for bit in range(16):
        for axis in range(2):
            axes[axis] |= ((rank >> np.uint64(2 * bit + axis)) & np.uint64(1)) << np.uint64(bit)
    return (axes[1] * np.uint64(side) + axes[0]).astype(np.uint32), (side, side)


def _interleaved(numbers: np.ndarray, axes: int) -> np.ndarray:
    """Morton codes, uint64 (points,), of uint64 (points, axes)."""
    code = np.zeros(len(numbers), np.uint64)
    for bit in range(_MORTON_BITS):
        for axis in range(axes):
            code |= (numbers[:, axis] >> np.uint64(bit) & np.uint64(1)) << np.uint64(axes * bit + axis)
    return code


def surfaces_at(
    scene: Scene, tracer: Tracer, positions: np.ndarray, normals: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The triangles that points lie on, int32 (points,), -1 for none, and the points moved onto these.

    Last come barycentric coordinates of corners 1 and 2, float32 (2, points). A short ray along the
    normal, from above the point to below it, finds the triangle. The point is moved only where it is off
    by more than rounding.
    """
    reach = NEAR_OF_POINT * np.abs(positions).max(axis=1, initial=0.0)
    reach = (reach + NEAR_OF_SCENE * float(np.abs(scene.bounds).max())).astype(np.float32)
    hits = tracer.closest(positions + reach[:, None] * normals, -normals)
    on = np.flatnonzero((hits.triangle >= 0) & (hits.distance <= 2 * reach))
    corners = scene.vertices[scene.triangles[hits.triangle[on]]].astype(np.float64)
    planes = _unit_normals(corners)
    flat = np.abs(np.sum(planes * normals[on], axis=1)) >= EDGEWISE
    on, corners, planes = on[flat], corners[flat], planes[flat]
    on_triangle = np.full(len(positions), -1, np.int32)
    on_triangle[on] = hits.triangle[on]
    above = (hits.distance - reach)[on]
    rounding = np.abs(positions[on]).max(axis=1, initial=0.0) + triangle_spreads(corners, planes)
    off = np.abs(above) > SNAPPED_FROM * rounding
    moved = positions.copy()
    moved[on[off]] -= above[off, None] * normals[on[off]]
    return on_triangle, moved, np.stack([hits.u, hits.v])


def _unit_normals(corners: np.ndarray) -> np.ndarray:
    """Normals of triangles, float64 (triangles, 3), of corners (triangles, 3, 3)."""
    edges = corners[:, 1:] - corners[:, :1]
    # Scaled before the cross product, whose squared length is very small for small triangles.
    edges /= np.abs(edges).max(axis=2, keepdims=True)
    normals = np.cross(edges[:, 0], edges[:, 1])
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)


def _off_light(positions: np.ndarray, normals: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Points on lights' triangles moved off these: rounding must not take any behind its light."""
    planes = _unit_normals(corners)
    planes *= np.where((planes * normals).sum(axis=1) < 0, -1.0, 1.0)[:, None]
    lift = RELATIVE_OFFSET * (
        np.abs(positions).max(axis=1, initial=0.0) + triangle_spreads(corners, planes)
    )
    return (positions + lift[:, None] * planes).astype(np.float32)


def place_points(
    device: Device, scene: Scene, tracer: Tracer, given: PointArrays, emitters_active: bool
) -> ShadingPoints:
    """Shading points of arrays, as `find_points` makes them of a camera's rays.

    Parameters
    ----------
    emitters_active : bool
        As `find_points` takes it; sensors have an integral wherever they are.

    Raises
    ------
    OffSurfaceError
    """
    count = len(given.positions)
    on_triangle, positions, barycentric = surfaces_at(scene, tracer, given.positions, given.normals)
    is_on = on_triangle >= 0
    if not given.is_sensor and not is_on.all():
        raise OffSurfaceError(np.flatnonzero(~is_on))
    light = np.where(is_on, scene.triangle_light[on_triangle], -1).astype(np.int32)
    on_light = np.flatnonzero(light >= 0)
    if given.is_sensor and not emitters_active:
        corners = scene.vertices[scene.triangles[on_triangle[on_light]]].astype(np.float64)
        positions[on_light] = _off_light(positions[on_light], given.normals[on_light], corners)
    every = emitters_active or given.is_sensor
    order = np.arange(count) if every else np.argsort(light >= 0, kind="stable")
    active = count if every else int(np.count_nonzero(light < 0))
    white = len(scene.materials)
    material = np.where(given.is_sensor, white, scene.triangle_material[on_triangle]).astype(np.uint32)
    # Cells of the scene know nothing of what is on no surface, or on a light.
    detached = (~is_on | (light >= 0)).astype(np.float32)
    surface = HostArray(device, (SURFACE.size, count), np.float32)
    points_program(device).kernel("placed_points")(
        count,
        total_points=count,
        positions=HostArray.of(device, positions[order]),
        normals=HostArray.of(device, given.normals[order]),
        outgoings=HostArray.of(device, given.outgoing[order]),
        on_triangle=HostArray.of(device, on_triangle[order]),
        detached=HostArray.of(device, detached[order]),
        point_material=HostArray.of(device, material[order]),
        vertices=HostArray.of(device, scene.vertices),
        triangles=HostArray.of(device, scene.triangles),
        materials=HostArray.of(device, np.concatenate([material_records(scene), WHITE_RECORD])),
        surface=surface,
    )
    device.queue.finish()
    kept = emission_factor = None
    if not given.is_sensor:
        kept = material[order].astype(np.int32)
        if varies(scene):
            hits = (on_triangle[order], *barycentric[:, order])
            emission_factor = vary_colours(surface, surface_at(scene, *hits))
    return ShadingPoints(
        surface,
        given.cells[order],
        light[order],
        active,
        background=0,
        material=kept,
        origin=scene.origin,
        emission_factor=emission_factor,
    )
