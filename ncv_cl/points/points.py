"""Shading points: what the camera sees, compacted, as a structure of arrays on the device."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from ..opencl.device import GROUP_SIZE, Device
from ..opencl.kernel import Kernel
from ..opencl.layout import Record
from ..opencl.memory import HostArray, Window
from ..opencl.program import Program, build
from ..scene.load import Camera, Scene
from ..scene.textures.surface import Surface, bent_normals, surface_at, varies
from .trace import Hits, Tracer

# A point's properties, each number of them a row of `surface`.
SURFACE = Record(
    "ROW",
    {
        "position": 3,
        "normal": 3,
        "geometric_normal": 3,
        "outgoing": 3,
        "offset": 1,
        "albedo": 3,
        "reflectance": 3,
        "roughness": 1,
        "eta": 1,
        "lobe_share": 1,
        "detached": 1,
    },
)
# Of a camera, right and up reach to the sides of the picture at distance 1.
CAMERA = Record("CAMERA", {"position": 3, "forward": 3, "right": 3, "up": 3})
# `ior` is 0 of what is no glass, negative of thin panes.
MATERIAL = Record("MATERIAL", {"albedo": 3, "reflectance": 3, "roughness": 1, "ior": 1})
# What an integrand may depend on, and a network's inputs be, in feature order: some of these.
INPUTS = ("position", "normal", "outgoing", "albedo", "roughness")

# Rays start and end off surfaces by this multiple of the coordinates that enter there (surface.cl): 32
# rounding errors of float32, some ten times what interpolation and embree's own arithmetic lose.
RELATIVE_OFFSET = 32 * 2.0**-24
# This part of a triangle's extent counts for every normal, so that the offset is never zero.
LEAST_SPREAD = 2.0**-10
CAMERA_RAYS_PER_BATCH = 1 << 19
# Origin and direction.
CAMERA_RAY_BYTES = 4 * (3 + 3)


def surface_defines() -> dict[str, int | str]:
    """The `-D` constants of surface.cl."""
    return {
        **SURFACE.defines(),
        "RELATIVE_OFFSET": f"{RELATIVE_OFFSET!r}f",
        "LEAST_SPREAD": f"{LEAST_SPREAD!r}f",
    }


@dataclass(frozen=True)
class ShadingPoints:
    """The shading points of an image.

    Attributes
    ----------
    surface : HostArray
        float32 (SURFACE.size, total), rows as in `SURFACE`, about the scene's origin.
    cell : ndarray
        uint32 (total,), sub-pixel of each point in row-major order on the supersampled grid.
    light : ndarray
        int32 (total,), index of the area light that the point lies on, or -1.
    active : int
        The first `active` points have an integral; the rest only fill image layers.
    background : int
        Sub-pixels whose camera ray hit nothing.
    dark : int
        Points that `without_last` took out, since their integral is zero.
    material : ndarray, optional
        int32 (total,), index of the material of each point.
    origin : ndarray
        float64 (3,), world position of the scene's origin.
    emission_factor : ndarray, optional
        float32 (total, 3), what textures multiply the emission of each point's material by.
    first_id : int
        What the first point's number is in the whole image, where these are a part of its points: its
        random numbers are those of that point.
    """

    surface: HostArray
    cell: np.ndarray
    light: np.ndarray
    active: int
    background: int
    dark: int = 0
    material: np.ndarray | None = None
    origin: np.ndarray = field(default_factory=lambda: np.zeros(3))
    emission_factor: np.ndarray | None = None
    first_id: int = 0

    @property
    def total(self) -> int:
        return len(self.cell)

    def rows(self, name: str, points: range | None = None) -> np.ndarray:
        """A copy of one property, float32 (floats, points), of `points` or of all.

        `name` is as in `SURFACE`. Nothing else is read.
        """
        return self.surface.read(window=surface_window(self.surface, name, points))

    def active_rows(self, name: str) -> np.ndarray:
        """The same of the active points."""
        return self.rows(name, range(self.active))

    def taken(self, order: np.ndarray) -> HostArray:
        """`surface` of the points that `order` (indices) names, in its order; made on the device."""
        device, count = self.surface.device, len(order)
        surface = HostArray(device, (SURFACE.size, count), np.float32)
        points_program(device).kernel("take_points")(
            (count, SURFACE.size),
            count=count,
            total_points=self.total,
            order=HostArray.of(device, order.astype(np.uint32)),
            surface=self.surface,
            taken=surface,
            group=(GROUP_SIZE, 1),
        )
        return surface

    def with_dark_last(self, dark: np.ndarray) -> ShadingPoints:
        """The same points, of the active ones those where `dark` (active,) is true last."""
        if not dark.any():
            return self
        order = np.arange(self.total)
        order[: self.active] = np.argsort(dark, kind="stable")
        surface = self.taken(order)
        names = ("cell", "light", "material", "emission_factor")
        kept = {name: getattr(self, name) for name in names if getattr(self, name) is not None}
        return replace(self, surface=surface, **{name: one[order] for name, one in kept.items()})

    def without_last(self, dark: int) -> ShadingPoints:
        """The same points, the last `dark` active ones inactive."""
        return replace(self, active=self.active - dark, dark=dark)


def surface_window(surface: HostArray, name: str, points: range | None = None) -> Window:
    """Where a `surface` holds a property of `points`, by default of all."""
    at, total = SURFACE[name], surface.shape[1]
    return Window(0, total, range(at.start, at.stop), range(total) if points is None else points)


def points_program(device: Device) -> Program:
    """The kernels that make shading points."""
    defines = {**surface_defines(), **CAMERA.defines(), **MATERIAL.defines()}
    return build(device, ("common", "surface", "points"), defines)


def camera_record(camera: Camera, width: int, height: int) -> np.ndarray:
    """What points.cl reads of a camera, float32 (CAMERA.size,)."""
    forward = np.asarray(camera.target, float) - np.asarray(camera.position, float)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, camera.up)
    right /= np.linalg.norm(right)
    up = np.cross(right, forward)
    half_height = np.tan(np.radians(camera.vertical_fov) / 2)
    return CAMERA.pack(
        position=camera.position,
        forward=forward,
        right=right * half_height * (width / height),
        up=up * half_height,
    )


def material_records(scene: Scene) -> np.ndarray:
    """What points.cl reads of the materials, float32 (materials, MATERIAL.size)."""
    records = [
        MATERIAL.pack(
            albedo=one.tint, reflectance=one.facing, roughness=one.roughness, ior=one.signed_ior
        )
        for one in scene.materials
    ]
    return np.array(records, np.float32).reshape(-1, MATERIAL.size)


def triangle_spreads(corners: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """The extent of each triangle's box along the triangle's normal: `spread` of surface.cl.

    Parameters
    ----------
    corners : ndarray
        (triangles, 3, 3).
    normals : ndarray
        (triangles, 3), unit vectors.
    """
    extent = np.ptp(corners, axis=1)
    return np.sum(np.abs(normals) * extent, axis=1) + LEAST_SPREAD * extent.max(axis=1)


def find_points(
    device: Device,
    scene: Scene,
    tracer: Tracer,
    width: int,
    height: int,
    supersample: int = 1,
    emitters_active: bool = False,
    chosen: np.ndarray | None = None,
) -> ShadingPoints:
    """Trace the camera's rays and keep what was hit.

    Parameters
    ----------
    width, height : int
        Pixels of the image.
    supersample : int
        k makes k × k sub-pixels of a pixel, each a shading point of its own.
    emitters_active : bool
        Whether points on area lights have an integral: they do for ambient occlusion, and do not for
        direct light, since lights reflect nothing.
    chosen : ndarray, optional
        uint32, increasing: sub-pixels whose points are wanted, all of which are active; by default all.

    Raises
    ------
    ValueError
        If nothing is hit at one that is chosen.
    """
    columns, rows = width * supersample, height * supersample
    cells = range(columns * rows)
    if chosen is not None:
        cells = range(int(chosen[0]), int(chosen[-1]) + 1)
    program = points_program(device)
    camera = HostArray.of(device, camera_record(scene.camera, width, height))
    hits = _trace_camera(device, tracer, program.kernel("camera_rays"), camera, columns, rows, cells)

    if chosen is None:
        hit = np.flatnonzero(hits.triangle >= 0).astype(np.uint32)
    else:
        hit = chosen - np.uint32(cells.start)
        if (hits.triangle[hit] < 0).any():
            raise ValueError("a camera ray that hit the scene elsewhere does not hit it here")
    light = scene.triangle_light[hits.triangle[hit]]
    if chosen is None and not emitters_active:
        order = np.argsort(light >= 0, kind="stable")
        hit, light = hit[order], light[order]
    every = emitters_active or chosen is not None
    active = len(hit) if every else int(np.count_nonzero(light < 0))
    cell = (hit + cells.start).astype(np.uint32)
    # Large images: only what is needed is kept.
    triangle, u, v = hits.triangle[hit], hits.u[hit], hits.v[hit]
    del hits
    background = len(cells) - len(cell)

    surface = HostArray(device, (SURFACE.size, len(cell)), np.float32)
    program.kernel("shading_points")(
        len(cell),
        camera=camera,
        columns=columns,
        rows=rows,
        total_points=len(cell),
        cells=HostArray.of(device, cell),
        hit_triangle=HostArray.of(device, triangle.astype(np.uint32)),
        hit_u=HostArray.of(device, u),
        hit_v=HostArray.of(device, v),
        vertices=HostArray.of(device, scene.vertices),
        vertex_normals=HostArray.of(device, scene.vertex_normals),
        triangles=HostArray.of(device, scene.triangles),
        triangle_material=HostArray.of(device, scene.triangle_material),
        materials=HostArray.of(device, material_records(scene)),
        surface=surface,
    )
    device.queue.finish()
    emission_factor = _vary(surface, scene, triangle, u, v) if varies(scene) else None
    material = scene.triangle_material[triangle]
    return ShadingPoints(
        surface, cell, light, active, background, 0, material, scene.origin, emission_factor
    )


def _vary(
    surface: HostArray, scene: Scene, triangle: np.ndarray, u: np.ndarray, v: np.ndarray
) -> np.ndarray:
    """Put in what textures and colours of vertices make of hits, as `surface_at` takes them.

    Returns `ShadingPoints.emission_factor`.
    """
    factor = vary_colours(surface, surface_at(scene, triangle, u, v))
    outgoing = surface.read(window=surface_window(surface, "outgoing")).T
    with surface.mapped(update=True, window=surface_window(surface, "normal")) as normal:
        normal[...] = bent_normals(scene, triangle, u, v, normal.T, outgoing).T
    return factor


def vary_colours(surface: HostArray, found: Surface) -> np.ndarray:
    """Put in what points reflect; returns `ShadingPoints.emission_factor`."""
    for name in ("albedo", "reflectance", "roughness"):
        with surface.mapped(write=True, window=surface_window(surface, name)) as rows:
            rows[...] = getattr(found, name).T
    return found.emission_factor.astype(np.float32)


def _trace_camera(
    device: Device,
    tracer: Tracer,
    camera_rays: Kernel,
    camera: HostArray,
    columns: int,
    rows: int,
    cells: range,
) -> Hits:
    batch = device.memory.fitting(min(CAMERA_RAYS_PER_BATCH, len(cells)), CAMERA_RAY_BYTES)
    origins = HostArray(device, (batch, 3), np.float32, streams=True)
    directions = HostArray(device, (batch, 3), np.float32, streams=True)
    found = []
    for first in range(cells.start, cells.stop, batch):
        count = min(batch, cells.stop - first)
        camera_rays(
            count,
            camera=camera,
            first_cell=first,
            count=count,
            columns=columns,
            rows=rows,
            origins=origins,
            directions=directions,
        )
        with origins.mapped(count=count) as starts, directions.mapped(count=count) as towards:
            found.append(tracer.closest(starts, towards))
    return Hits(
        np.concatenate([hits.triangle for hits in found]),
        np.concatenate([hits.u for hits in found]),
        np.concatenate([hits.v for hits in found]),
        np.concatenate([hits.distance for hits in found]),
    )
