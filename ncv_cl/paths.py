"""Samples whose values are estimates themselves: paths behind the first bounce, in wavefronts."""

from __future__ import annotations

import time
from contextlib import ExitStack
from typing import NamedTuple

import numpy as np

from .device import Device, HostArray
from .guide import Guide, GuideRecorder, guide_defines, guide_frame
from .integrands import GlobalIllumination, Integrand
from .points import RELATIVE_OFFSET, ShadingPoints, surface_defines
from .program import build
from .sampler import sampler_defines
from .samples import DENSITY_BINS, NO_RAY, Batch, SampleSource, Warp, ray_defines
from .scene import Scene
from .shaft import Occluders
from .trace import Hits, Tracer

# A depth that no path reaches.
UNLIMITED = 1 << 30
# Of a ray beside its origin and direction: throughput and density.
STATE_ROWS = 4
# Russian roulette: from which bounce on, and at which multiple of its throughput a path goes on; then
# the same where the mean of what is ended is known. Of those tried, the least variance times rays
# (96 x 96 points, one pair of seeds, Cornell box and interior).
ROULETTE = (2, 2.0)
GUIDED_ROULETTE = (2, 3.0)
# The most that go on.
MOST_SURVIVE = 0.95


def sample_source(
    device: Device,
    scene: Scene,
    tracer: Tracer,
    points: ShadingPoints,
    integrand: Integrand,
    sampler: str,
    seed: int,
    samples_per_point: int,
    occluders: Occluders | None = None,
) -> SampleSource:
    """The `SampleSource` that suits the integrand; arguments as it takes them."""
    kind = PathSource if integrand.nested else SampleSource
    return kind(device, scene, tracer, points, integrand, sampler, seed, samples_per_point, occluders)


class _Rays(NamedTuple):
    """Memory for rays and what they carry, as paths.cl lays it out."""

    origins: HostArray
    directions: HostArray
    state: HostArray
    path: HostArray

    @classmethod
    def of(cls, device: Device, capacity: int) -> _Rays:
        # Kernels load whole vectors, also where the last has lanes without a ray.
        return cls(
            _zeros(device, (capacity, 3), np.float32),
            _zeros(device, (capacity, 3), np.float32),
            _zeros(device, (STATE_ROWS, capacity), np.float32),
            _zeros(device, capacity, np.uint32),
        )


class PathSource(SampleSource):
    """Draws samples of global illumination: complete values, each with the noise of one path.

    Parameters as for `SampleSource`.
    """

    def __init__(
        self,
        device: Device,
        scene: Scene,
        tracer: Tracer,
        points: ShadingPoints,
        integrand: GlobalIllumination,
        sampler: str,
        seed: int,
        samples_per_point: int,
        occluders: Occluders | None = None,
    ) -> None:
        super().__init__(
            device, scene, tracer, points, integrand, sampler, seed, samples_per_point, occluders
        )
        self._max_depth = integrand.max_depth or UNLIMITED
        self._most = np.inf if integrand.clamp is None else integrand.clamp
        records, defines = triangle_records(scene)
        self._triangles = HostArray.of(device, records)
        self._frame = HostArray.of(device, guide_frame(scene))
        self._guide: list[HostArray] = []
        self._recorder: GuideRecorder | None = None
        surface = ("common", "sampler", "surface", "bsdf", "bounce", "lights")
        self._files = (*surface, "warp", "guide", "batch", "paths")
        self._defines = {
            **surface_defines(),
            **sampler_defines(sampler),
            **integrand.defines(scene),
            **defines,
            "STATE_ROWS": f"{STATE_ROWS}u",
            "MOST_SURVIVE": f"{MOST_SURVIVE!r}f",
            **ray_defines(),
            "DENSITY_BINS": DENSITY_BINS,
            **guide_defines(),
        }
        self._choose_program()
        capacity = self._capacity
        self._rays, self._next, self._shadows = (_Rays.of(device, capacity) for _ in range(3))
        self._hits = Hits(
            _zeros(device, capacity, np.int32),
            *(_zeros(device, capacity, np.float32) for _ in range(3)),
        )
        self._radiance = HostArray(device, (self.channels, capacity), np.float32)
        self._place = _zeros(device, capacity, np.uint32)
        self._counts = HostArray(device, 2, np.uint32)
        self._lit = HostArray(device, capacity, np.uint8)
        # Shadow rays end at multiple 1 of their directions.
        self._reach = np.ones(capacity, np.float32)
        # Values are complete: all samples share one ray that has been answered.
        self._whole_slot = _zeros(device, capacity, np.uint32)
        self._whole_visible = HostArray.of(device, np.ones(1, np.uint8))

    def record_guide(self) -> None:
        """Keep what paths find from now on, for `learn_guide`."""
        self._recorder = GuideRecorder()
        self._choose_program()

    def learn_guide(self) -> Guide:
        """Guide bounces by what was recorded since `record_guide`; returns what `use_guide` takes."""
        guide = self._recorder.guide()
        self._recorder = None
        self.use_guide(guide)
        return guide

    def use_guide(self, guide: Guide) -> None:
        """Guide bounces behind the first."""
        self._guide = [HostArray.of(self.device, array) for array in guide]
        self._choose_program()

    def _choose_program(self) -> None:
        recorded = self._recorder is not None
        guided = bool(self._guide) and not recorded
        bounce, scale = GUIDED_ROULETTE if guided else ROULETTE
        flags = {
            "RECORDED": int(recorded),
            "GUIDED": int(guided),
            "ROULETTE_BOUNCE": f"{bounce}u",
            "ROULETTE_SCALE": f"{scale!r}f",
        }
        self._paths = build(self.device, self._files, {**self._defines, **flags})

    def draw(
        self,
        points: range,
        samples: range,
        stream: int,
        order: HostArray | None = None,
        density: Warp | None = None,
        paths: int | None = None,
    ) -> Batch:
        """As `SampleSource.draw`; all samples of the batch are visible, their values complete.

        With `paths`, a stream of its own for all but (u, v): other estimates at the same points.
        """
        batch = super().draw(points, samples, stream, order, density)
        begun, traced = time.perf_counter(), self.rays.trace_seconds
        alive, bounce = self._begin(batch), 1
        path_stream = stream if paths is None else paths
        while alive:
            self._trace(alive)
            shadows, alive = self._shade(batch, bounce, alive, samples.start, path_stream)
            self._add_lit(shadows)
            self._rays, self._next = self._next, self._rays
            if bounce == 1 and self._recorder is not None:
                under_way = self._under_way(alive)
            bounce += 1
        if bounce > 2 and self._recorder is not None:
            self._record(*under_way)
        count = len(batch.points) * batch.stride
        self._paths.kernel("finish_paths")(
            -(-count // self.device.vector_width),
            count,
            self._capacity,
            self._most,
            batch.slot,
            batch.visible,
            self._radiance,
            batch.value,
        )
        self.device.queue.finish()
        traced = self.rays.trace_seconds - traced
        self.rays.sample_seconds += time.perf_counter() - begun - traced
        return Batch(
            points, batch.order, batch.samples, batch.stride, batch.u, batch.v, batch.value,
            self._whole_slot, self._whole_visible, batch.weight,
        )  # fmt: skip

    def _begin(self, batch: Batch) -> int:
        """The first rays; returns how many."""
        self._counts.fill(0)
        self._paths.kernel("begin_paths")(
            len(batch.points) * batch.stride // self.device.vector_width,
            batch.points.start,
            len(batch.points),
            self.points.total,
            batch.samples,
            batch.stride,
            self._capacity,
            self._max_depth,
            batch.order,
            self.points.surface,
            batch.u,
            batch.v,
            self._radiance,
            *self._rays,
            self._counts,
        )
        return int(self._counts.read()[0])

    def _under_way(self, alive: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rays that leave the first hits: their paths, throughputs, what the paths brought so far."""
        with self._rays.path.mapped(count=alive) as path, self._rays.state.mapped() as state:
            path, throughput = path.copy(), state[:3, :alive].copy()
        with self._radiance.mapped() as radiance:
            return path, throughput, radiance[:, path]

    def _record(self, path: np.ndarray, throughput: np.ndarray, before: np.ndarray) -> None:
        """What came along rays that were `_under_way`."""
        with self._radiance.mapped() as radiance, self._place.mapped() as place:
            brought = (radiance[:, path] - before).astype(np.float64)
            place = place[path]
        # A channel that the surface swallows tells nothing, and what it is taken for does not matter.
        arrived = brought / np.maximum(throughput, 1e-3 * throughput.max(axis=0))
        known = place != NO_RAY
        self._recorder.add(place[known], arrived[:, known])

    def _trace(self, alive: int) -> None:
        """Closest hits of the rays under way."""
        started = time.perf_counter()
        with ExitStack() as stack:
            origins, directions = (
                stack.enter_context(one.mapped(count=alive)) for one in self._rays[:2]
            )
            hits = self._hits
            # Whole vectors: lanes past the last ray are to have hit nothing.
            width = self.device.vector_width
            padded = -(-alive // width) * width
            views = [
                stack.enter_context(one.mapped(write=True, count=padded))
                for one in (hits.triangle, hits.u, hits.v, hits.distance)
            ]
            for view, nothing in zip(views, (-1, 0, 0, 0), strict=True):
                view[alive:] = nothing
            self._tracer.closest(origins, directions, Hits(*(view[:alive] for view in views)))
        self.rays.trace_seconds += time.perf_counter() - started
        self.rays.traced += alive

    def _shade(
        self, batch: Batch, bounce: int, alive: int, first_sample: int, stream: int
    ) -> tuple[int, int]:
        """From hits to shadow rays and the next rays; returns how many of each."""
        self._counts.fill(0)
        hits = self._hits
        self._paths.kernel("shade_hits")(
            -(-alive // self.device.vector_width),
            alive,
            self._capacity,
            self._max_depth,
            bounce,
            batch.points.start,
            first_sample,
            batch.stride,
            stream,
            *self._seed,
            batch.order,
            self._triangles,
            self._data,
            self._frame,
            *(self._guide or (self._frame, self._frame)),
            self._place,
            hits.triangle,
            hits.u,
            hits.v,
            hits.distance,
            self._rays.directions,
            self._rays.state,
            self._rays.path,
            self._radiance,
            *self._shadows,
            *self._next,
            self._counts,
        )
        shadows, alive = self._counts.read().tolist()
        return shadows, alive

    def _add_lit(self, count: int) -> None:
        """Trace the shadow rays and add what they found visible."""
        started = time.perf_counter()
        with (
            self._shadows.origins.mapped(count=count) as origins,
            self._shadows.directions.mapped(count=count) as directions,
            self._lit.mapped(write=True, count=count) as lit,
        ):
            self._tracer.visible(origins, directions, self._reach[:count], lit)
        self.rays.trace_seconds += time.perf_counter() - started
        self.rays.traced += count
        self._paths.kernel("add_lit")(
            count,
            count,
            self._capacity,
            self._lit,
            self._shadows.state,
            self._shadows.path,
            self._radiance,
        )


def _zeros(device: Device, shape: tuple[int, ...] | int, dtype: type) -> HostArray:
    array = HostArray(device, shape, dtype)
    array.fill(0)
    return array


def triangle_records(scene: Scene) -> tuple[np.ndarray, dict[str, int]]:
    """What paths.cl reads of the triangles, float32 (triangles, floats), and its `-D` constants."""
    corners = scene.vertices[scene.triangles].astype(np.float64)
    edges = corners[:, 1:] - corners[:, :1]
    # Scaled before the cross product, whose squared length is very small for small triangles.
    scaled = edges / np.abs(edges).max(axis=2, keepdims=True)
    normals = np.cross(scaled[:, 0], scaled[:, 1])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    offsets = RELATIVE_OFFSET * np.abs(corners).max(axis=(1, 2))
    materials = [scene.materials[index] for index in range(len(scene.materials))]
    rows = {name: np.array([getattr(m, name) for m in materials], np.float64).reshape(len(materials), -1)
            for name in ("albedo", "reflectance", "roughness", "emission")}  # fmt: skip
    own = scene.triangle_material
    defines = {
        "HAS_EMISSION": int(rows["emission"].any()),
        "HAS_NORMALS": int(scene.vertex_normals.any()),
    }
    parts = [
        corners[:, 0],
        edges.reshape(len(corners), 6),
        normals,
        offsets[:, None],
        scene.triangle_light[:, None],
        rows["albedo"][own],
    ]
    if rows["reflectance"].any():
        parts += [rows["reflectance"][own], rows["roughness"][own]]
    if defines["HAS_EMISSION"]:
        parts.append(rows["emission"][own])
    if defines["HAS_NORMALS"]:
        parts.append(scene.vertex_normals[scene.triangles].reshape(len(corners), 9))
    records = np.concatenate(parts, axis=1).astype(np.float32)
    return records, {**defines, "TRIANGLE_FLOATS": records.shape[1]}
