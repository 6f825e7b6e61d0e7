"""Samples with a path behind the first bounce, in wavefronts: each value is itself an estimate."""

from __future__ import annotations

import functools
import time
from typing import Any

import numpy as np

from ..integrands import GlobalIllumination, Integrand
from ..integrands.lights import LIGHT_FILES
from ..opencl.device import Device
from ..opencl.memory import HostArray
from ..opencl.program import Program, build
from ..points.groups import Groups, group_points
from ..points.points import ShadingPoints, surface_defines
from ..points.sampler import sampler_defines
from ..points.textures import Textures, texture_defines
from ..points.trace import Tracer
from ..scene.load import Scene
from ..visibility import tuning as visibility_tuning
from ..visibility.shadow import CENTRE_FLOATS, shadow_casters, shadow_defines
from ..visibility.shaft import Occluders
from ..visibility.slices import Slices
from ..visibility.trace import DeviceTracer
from . import tuning
from .guide import Guide, GuideRecorder, guide_defines, guide_frame
from .own_noise import OwnNoise
from .samples import LONGEST_RUN, NO_RAY, Batch, SampleSource, ray_defines
from .share import Entries, share_defines
from .triangles import triangle_records
from .warp import Warp, warp_defines
from .waves.wave import knows_counts, wave_defines
from .waves.waves import Waves

# Places of a batch at most: paths.cl finds a place's point by a product of floats, exactly below this.
MOST_PLACES = 1 << 22
# Waves of a batch where the host does not know how many rays are left: what these leave, work-items
# follow to their ends, each its own. In interior that is a fiftieth of all rays (tests/test_rays.py).
WAVES = 8
# A depth that no path reaches.
EVERY_DEPTH = 1 << 30
# Floats that sum what a path brings: three channels, and a place that makes them one aligned vector.
RADIANCE_FLOATS = 4


def sample_source(
    device: Device,
    scene: Scene,
    tracer: Tracer | DeviceTracer,
    points: ShadingPoints,
    integrand: Integrand,
    sampler: str,
    seed: int,
    samples_per_point: int,
    occluders: Occluders | None = None,
    lines: bool = False,
    slices: Slices | None = None,
    shadows_tested: bool = False,
) -> SampleSource:
    """The `SampleSource` that suits the integrand; arguments as it and `PathSource` take them."""
    common = (sampler, seed, samples_per_point, occluders)
    if not integrand.nested:
        return SampleSource(device, scene, tracer, points, integrand, *common, lines, slices)
    if not isinstance(integrand, GlobalIllumination):
        raise TypeError(f"{type(integrand).__name__}: only integrand gi can be nested")
    return PathSource(device, scene, tracer, points, integrand, *common, shadows_tested=shadows_tested)


class PathSource(SampleSource):
    """Draws samples of global illumination: complete values, each with the noise of one path.

    Parameters as for `SampleSource`, and

    shadows_tested : bool
        Whether kernels find what paths and their shadow rays hit, where the scene is of few triangles.
    """

    def __init__(
        self,
        device: Device,
        scene: Scene,
        tracer: Tracer | DeviceTracer,
        points: ShadingPoints,
        integrand: GlobalIllumination,
        sampler: str,
        *rest: Any,
        shadows_tested: bool = False,
    ) -> None:
        # Where direct light comes by the same samples, its points on lights are each point's own; and
        # glass does not send out the same to two points.
        self.members = 1 if integrand.direct or scene.has_glass else tuning.MEMBERS
        super().__init__(device, scene, tracer, points, integrand, sampler, *rest)
        self._max_depth = integrand.max_depth or EVERY_DEPTH
        self._most = np.inf if integrand.clamp is None else integrand.clamp
        records, defines = triangle_records(scene)
        self._triangles = HostArray.of(device, records)
        self._textures = Textures.of(device, scene)
        self._frame = HostArray.of(device, guide_frame(scene))
        few = shadows_tested and len(scene.triangles) <= visibility_tuning.MOST_CASTERS
        few = self.by_kernels = few and not scene.has_gaps
        self._waves = Waves(device, self._tracer, few, scene.has_panes)
        casters = shadow_casters(scene) if few else np.zeros(CENTRE_FLOATS, np.float32)
        self._casters = HostArray.of(device, casters)
        # What no kernel reads before there is a guide.
        self._guided = False
        self._guide_densities, self._guide_known = (
            HostArray(device, 1, t) for t in (np.uint32, np.float32)
        )
        self._recorder: GuideRecorder | None = None
        self._files = (
            "common", "sampler", "surface", "bsdf", "bounce", "dielectric", *LIGHT_FILES, "environment",
            "textures", "warp", "guide", "shadow", "closest", "batch", "wave", "vertex", "place",
            "share", "paths",
        )  # fmt: skip
        self._defines = {
            **surface_defines(),
            **sampler_defines(sampler),
            **integrand.defines(scene),
            **defines,
            **wave_defines(),
            "RADIANCE_FLOATS": f"{RADIANCE_FLOATS}u",
            "LEAST_SURVIVE": f"{tuning.LEAST_SURVIVE!r}f",
            "MOST_SURVIVE": f"{tuning.MOST_SURVIVE!r}f",
            **shadow_defines(len(scene.triangles) if few else 0),
            **ray_defines(),
            **warp_defines(),
            **guide_defines(),
            **texture_defines(),
            "HAS_PANES": int(scene.has_panes),
            "GLASS_ROULETTE_SCALE": f"{tuning.ROULETTE[1]!r}f",
        }
        self._own_noise = OwnNoise(scene, tracer)
        self._most_entries = max(self._capacity, self.members**2 * LONGEST_RUN)
        self._branches, self._no_hits = 0, HostArray(device, 1, np.float32)
        self._choose_program()
        self._place = _zeros(device, self._capacity, np.uint32)
        # Values are complete: all samples share one ray that has been answered.
        self._whole_slot = _zeros(device, self._most_entries, np.uint32)
        self._whole_visible = HostArray.of(device, np.ones(1, np.uint8))

    def record_guide(self) -> None:
        """Keep what paths find from now on, for `learn_guide`."""
        self._recorder = GuideRecorder()
        self._choose_program()

    def learn_guide(self) -> Guide:
        """Guide bounces by what was recorded since `record_guide`; returns what `use_guide` takes."""
        if self._recorder is None:
            raise RuntimeError("record_guide comes first")
        guide = self._recorder.guide()
        self._recorder = None
        self.use_guide(guide)
        return guide

    def use_guide(self, guide: Guide) -> None:
        """Guide bounces behind the first."""
        self._guided = True
        self._guide_densities, self._guide_known = (
            HostArray.of(self.device, a) for a in (guide.densities, guide.known())
        )
        self._choose_program()

    def _choose_program(self) -> None:
        recorded = self._recorder is not None
        guided = self._guided and not recorded
        bounce, scale = tuning.GUIDED_ROULETTE if guided else tuning.ROULETTE
        self._make_room(tuning.BRANCHES if guided else 1)
        self._flags: dict[str, int | str] = {
            "BRANCHES": f"{self._branches}u",
            "RECORDED": int(recorded),
            "GUIDED": int(guided),
            "ROULETTE_BOUNCE": f"{bounce}u",
            "ROULETTE_SCALE": f"{scale!r}f",
        }
        self._paths = self._program_of(1)
        # What paths find is recorded on the host.
        ahead = isinstance(self._tracer, DeviceTracer) and not knows_counts(self.device)
        self.runs_ahead = self._waves.ahead = ahead and not recorded

    def _program_of(self, members: int, weighted: bool = False) -> Program:
        sharing = {**share_defines(members, weighted), "FOLLOWED": 0}
        return build(self.device, self._files, {**self._defines, **self._flags, **sharing})

    def _following_program(self) -> Program:
        """What has follow_paths, which starts behind all that points share."""
        if not isinstance(self._tracer, DeviceTracer):
            raise TypeError("only a device's own walk through the scene follows paths")
        defines = {**self._tracer.defines(), **share_defines(1, False), "FOLLOWED": 1}
        files = (*self._files, "trace", "follow")
        return build(self.device, files, {**self._defines, **self._flags, **defines})

    def groups(self, density: str, apart: int) -> Groups:
        """Which points share paths, if the residual's samples follow a density of this kind."""
        members = 1 if density == "subdivision" else self.members
        return group_points(self.points, members, tuning.GROUP_WINDOW, apart, self._own_noise.pays)

    def _make_room(self, branches: int) -> None:
        """For so many paths behind the second vertex of each sample's path."""
        if branches != self._branches:
            self._branches, most = branches, max(branches * self._capacity, self._most_entries)
            self._waves.make(most)
            self._slots = branches + 1
            sums = (max(most, self._slots * self._capacity), RADIANCE_FLOATS)
            self._radiance = HostArray(self.device, sums, np.float32)

    def draw(
        self,
        points: range,
        samples: range,
        stream: int,
        order: HostArray | None = None,
        density: Warp | None = None,
        grouped: bool = False,
        paths: int | None = None,
    ) -> Batch:
        """As `SampleSource.draw`; all samples of the batch are visible, their values complete.

        With `paths`, a stream of its own for all but (u, v): other estimates at the same points. With
        `grouped`, the points are whole `groups`, which share their paths.

        Raises
        ------
        ValueError
            More points, times samples, than `MOST_PLACES`.
        """
        members = self.members if grouped else 1
        self._paths = self._program_of(members, density is not None)
        entries = self._entries if members > 1 else None
        self._hits = self._no_hits if entries is None else entries.hits
        batch = super().draw(points, samples, stream, order, density)
        places = len(batch.points) * batch.stride
        if places > MOST_PLACES:
            raise ValueError(f"a batch of paths has {MOST_PLACES} places at most, not {places}: cut it")
        begun, traced = time.perf_counter(), self._rays.trace_seconds
        path_stream = stream if paths is None else paths
        self._begin(batch)
        if self.runs_ahead:
            self._run_ahead(batch, samples.start, path_stream)
        else:
            self._run(batch, samples.start, path_stream)
        if entries is not None:
            self._rays.trace_seconds += entries.gather(
                self._paths,
                self._waves,
                self.points,
                batch,
                density,
                casters=self._casters,
                most=self._most,
                radiance=self._radiance,
            )
            self._count_seconds(begun, traced)
            return entries.batch(batch, self._whole_slot, self._whole_visible)
        self._paths.kernel("finish_paths")(
            -(-places // self.device.vector_width),
            count=places,
            most=self._most,
            slot=batch.slot,
            visible=batch.visible,
            radiance=self._radiance,
            value=batch.value,
        )
        self._count_seconds(begun, traced)
        return Batch(
            points, batch.order, batch.samples, batch.stride, batch.u, batch.v, batch.value,
            self._whole_slot, self._whole_visible, batch.weight,
        )  # fmt: skip

    @functools.cached_property
    def _entries(self) -> Entries:
        """Memory for what points share, made when it is first needed."""
        return Entries(self.device, self.members, self._capacity, self._most_entries, self._slots)

    def _run(self, batch: Batch, first_sample: int, stream: int) -> None:
        """A bounce of all paths after the other, until no rays are left."""
        waves, bounce, under_way = self._waves, 1, None
        self._trace(bounce)
        while waves.now.rays or waves.now.shadows:
            waves.each_lit(self._paths, "add_lit", radiance=self._radiance)
            if bounce == 2 and self._recorder is not None:
                under_way = self._under_way()
            self._shade(batch, bounce, first_sample, stream)
            bounce += 1
            self._trace(bounce)
        waves.end(self._paths)
        if under_way is not None:
            self._record(*under_way)

    def _run_ahead(self, batch: Batch, first_sample: int, stream: int) -> None:
        """The same without knowing how many rays are left."""
        waves = self._waves
        # Rays of the last bounce of all find nothing but lights.
        last = min(WAVES, self._max_depth - 1)
        for bounce in range(1, last + 1):
            waves.trace(bounce)
            waves.each_lit(self._paths, "add_lit", radiance=self._radiance)
            self._shade(batch, bounce, first_sample, stream)
        waves.trace(last + 1, hits=False)
        waves.each_lit(self._paths, "add_lit", radiance=self._radiance)
        if last < self._max_depth - 1:
            common = self._common(batch, first_sample, stream)
            waves.follow(self._following_program(), bounce=last + 1, **common)
        waves.end(self._paths)

    def _trace(self, bounce: int) -> None:
        self._rays.trace_seconds += self._waves.trace(bounce)

    def _collect(self) -> None:
        super()._collect()
        if self.by_kernels:
            self._rays.on_device += self._waves.counted()
        else:
            self._rays.traced += self._waves.counted()

    def _count_seconds(self, begun: float, traced: float) -> None:
        """The seconds of a batch begun then, when rays had been `traced` for so many."""
        if not self.runs_ahead:
            self.device.queue.finish()
        traced = self._rays.trace_seconds - traced
        self._rays.sample_seconds += time.perf_counter() - begun - traced

    def _begin(self, batch: Batch) -> None:
        """The first rays."""
        paths = len(batch.points) * batch.stride
        wave = self._waves.begin(paths)
        self._paths.kernel("begin_paths")(
            paths // self.device.vector_width,
            first_point=batch.points.start,
            point_count=len(batch.points),
            total_points=self.points.total,
            sample_count=batch.samples,
            stride=batch.stride,
            max_depth=self._max_depth,
            order=batch.order,
            surface=self.points.surface,
            lights=self._data,
            u=batch.u,
            v=batch.v,
            radiance=self._radiance,
            hits=self._hits,
            plane=wave.plane,
            wave=wave.words,
        )

    def _under_way(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rays that leave the first hits: their paths, throughputs, what the paths brought so far."""
        path, throughput = self._waves.now.under_way()
        with self._radiance.mapped() as radiance:
            return path, throughput, radiance[path, : self.channels].T

    def _record(self, path: np.ndarray, throughput: np.ndarray, before: np.ndarray) -> None:
        """What came along rays that were `_under_way`."""
        with self._radiance.mapped() as radiance, self._place.mapped() as place:
            brought = (radiance[path, : self.channels].T - before).astype(np.float64)
            place = place[path]
        # A channel that the surface swallows tells nothing, and what it is taken for does not matter.
        arrived = brought / np.maximum(throughput, 1e-3 * throughput.max(axis=0))
        known = place != NO_RAY
        if self._recorder is not None:
            self._recorder.add(place[known], arrived[:, known], throughput[:, known])

    def _common(self, batch: Batch, first_sample: int, stream: int) -> dict[str, Any]:
        """What all paths of a batch have in common, as paths.cl has it."""
        return {
            "max_depth": self._max_depth,
            "first_point": batch.points.start,
            "first_id": self.points.first_id,
            "first_sample": first_sample,
            "stride": batch.stride,
            "inverse_stride": 1.0 / batch.stride,
            "stream": stream,
            **self._seed,
            "places": len(batch.points) * batch.stride,
            "order": batch.order,
            "triangles": self._triangles,
            "textures": self._textures.records,
            "texels": self._textures.texels,
            "lights": self._data,
            "casters": self._casters,
            "guide_frame": self._frame,
            "guide": self._guide_densities,
            "guide_known": self._guide_known,
            "guide_place": self._place,
            "hits": self._hits,
            "radiance": self._radiance,
        }

    def _shade(self, batch: Batch, bounce: int, first_sample: int, stream: int) -> None:
        """From hits to shadow rays and the next rays, which are then the wave."""
        branches = self._branches if bounce == 1 else 1
        common = self._common(batch, first_sample, stream)
        self._waves.shade(self._paths, branches, bounce=bounce, **common)


def _zeros(device: Device, shape: tuple[int, ...] | int, dtype: type) -> HostArray:
    array = HostArray(device, shape, dtype)
    array.fill(0)
    return array
