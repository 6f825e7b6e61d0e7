"""Samples with a path behind the first bounce, in wavefronts: each value is itself an estimate."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from ..integrands import GlobalIllumination, Integrand
from ..opencl.device import Device
from ..opencl.memory import HostArray
from ..opencl.program import build
from ..points.points import ShadingPoints, surface_defines
from ..points.sampler import sampler_defines
from ..points.textures import Textures, texture_defines
from ..points.trace import Tracer
from ..scene.load import Scene
from ..visibility import tuning as visibility_tuning
from ..visibility.shadow import CENTRE_FLOATS, shadow_casters, shadow_defines
from ..visibility.slices import Slices
from . import tuning
from .guide import Guide, GuideRecorder, guide_defines, guide_frame
from .samples import NO_RAY, Batch, SampleSource, ray_defines
from .triangles import triangle_records
from .warp import Warp, warp_defines
from .wave import Wave, wave_defines

# Places of a batch at most: paths.cl finds a place's point by a product of floats, exactly below this.
MOST_PLACES = 1 << 22
# A depth that no path reaches.
EVERY_DEPTH = 1 << 30
# Floats that sum what a path brings: three channels, and a place that makes them one aligned vector.
RADIANCE_FLOATS = 4


def sample_source(
    device: Device,
    scene: Scene,
    tracer: Tracer,
    points: ShadingPoints,
    integrand: Integrand,
    *rest: Any,
    lines: bool = False,
    slices: Slices | None = None,
    shadows_tested: bool = False,
) -> SampleSource:
    """The `SampleSource` that suits the integrand; arguments as it and `PathSource` take them."""
    if integrand.nested:
        arguments = (device, scene, tracer, points, integrand, *rest)
        return PathSource(*arguments, shadows_tested=shadows_tested)
    return SampleSource(device, scene, tracer, points, integrand, *rest, lines=lines, slices=slices)


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
        tracer: Tracer,
        points: ShadingPoints,
        integrand: GlobalIllumination,
        sampler: str,
        *rest: Any,
        shadows_tested: bool = False,
    ) -> None:
        super().__init__(device, scene, tracer, points, integrand, sampler, *rest)
        self._max_depth = integrand.max_depth or EVERY_DEPTH
        self._most = np.inf if integrand.clamp is None else integrand.clamp
        records, defines = triangle_records(scene)
        self._triangles = HostArray.of(device, records)
        self._textures = Textures.of(device, scene)
        self._frame = HostArray.of(device, guide_frame(scene))
        few = shadows_tested and len(scene.triangles) <= visibility_tuning.MOST_CASTERS
        few = self.by_kernels = few and not scene.has_holes
        casters = shadow_casters(scene) if few else np.zeros(CENTRE_FLOATS, np.float32)
        self._casters = HostArray.of(device, casters)
        # What no kernel reads before there is a guide.
        self._guided = False
        self._guide_densities, self._guide_known = (
            HostArray(device, 1, t) for t in (np.uint32, np.float32)
        )
        self._recorder: GuideRecorder | None = None
        surface = ("common", "sampler", "surface", "bsdf", "bounce", "lights")
        self._files = (
            *surface,
            "textures",
            "warp",
            "guide",
            "shadow",
            "closest",
            "batch",
            "wave",
            "vertex",
            "paths",
        )
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
        }
        self._branches = 0
        self._choose_program()
        self._place = _zeros(device, self._capacity, np.uint32)
        # Values are complete: all samples share one ray that has been answered.
        self._whole_slot = _zeros(device, self._capacity, np.uint32)
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
        flags = {
            "BRANCHES": f"{self._branches}u",
            "RECORDED": int(recorded),
            "GUIDED": int(guided),
            "ROULETTE_BOUNCE": f"{bounce}u",
            "ROULETTE_SCALE": f"{scale!r}f",
        }
        self._paths = build(self.device, self._files, {**self._defines, **flags})

    def _make_room(self, branches: int) -> None:
        """For so many paths behind the second vertex of each sample's path."""
        if branches != self._branches:
            self._branches, most = branches, branches * self._capacity
            self._wave, self._next = (Wave(self.device, most) for _ in range(2))
            self._radiance = HostArray(self.device, (most, RADIANCE_FLOATS), np.float32)

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

        Raises
        ------
        ValueError
            More points, times samples, than `MOST_PLACES`.
        """
        batch = super().draw(points, samples, stream, order, density)
        places = len(batch.points) * batch.stride
        if places > MOST_PLACES:
            raise ValueError(f"a batch of paths has {MOST_PLACES} places at most, not {places}: cut it")
        begun, traced = time.perf_counter(), self.rays.trace_seconds
        path_stream = stream if paths is None else paths
        self._begin(batch)
        bounce, under_way = 1, None
        self._trace()
        while self._wave.rays or self._wave.shadows:
            self._add_lit()
            if bounce == 2 and self._recorder is not None:
                under_way = self._under_way()
            self._shade(batch, bounce, samples.start, path_stream)
            self._trace()
            bounce += 1
        if under_way is not None:
            self._record(*under_way)
        self._paths.kernel("finish_paths")(
            -(-places // self.device.vector_width),
            count=places,
            most=self._most,
            slot=batch.slot,
            visible=batch.visible,
            radiance=self._radiance,
            value=batch.value,
        )
        self.device.queue.finish()
        traced = self.rays.trace_seconds - traced
        self.rays.sample_seconds += time.perf_counter() - begun - traced
        return Batch(
            points, batch.order, batch.samples, batch.stride, batch.u, batch.v, batch.value,
            self._whole_slot, self._whole_visible, batch.weight,
        )  # fmt: skip

    def _begin(self, batch: Batch) -> None:
        """The first rays."""
        wave = self._wave
        wave.make_room(len(batch.points) * batch.stride)
        self._paths.kernel("begin_paths")(
            len(batch.points) * batch.stride // self.device.vector_width,
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
            plane=wave.plane,
            wave=wave.words,
        )

    def _under_way(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rays that leave the first hits: their paths, throughputs, what the paths brought so far."""
        path, throughput = self._wave.under_way()
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
        self._recorder.add(place[known], arrived[:, known], throughput[:, known])

    def _trace(self) -> None:
        """Closest hits of the rays under way, and which shadow rays reach their lights."""
        if self.by_kernels:
            self._wave.count()
            self.rays.on_device += self._wave.tested
            return
        self.rays.trace_seconds += self._wave.trace(self._tracer)
        self.rays.traced += self._wave.rays + self._wave.shadows

    def _add_lit(self) -> None:
        """Add what shadow rays found visible."""
        wave = self._wave
        if wave.shadows:
            self._paths.kernel("add_lit")(
                wave.shadows,
                count=wave.shadows,
                plane=wave.plane,
                wave=wave.words,
                radiance=self._radiance,
            )

    def _shade(self, batch: Batch, bounce: int, first_sample: int, stream: int) -> None:
        """From hits to shadow rays and the next rays, which are then the wave."""
        wave, following = self._wave, self._next
        following.make_room(wave.rays * (self._branches if bounce == 1 else 1))
        self._paths.kernel("shade_hits")(
            -(-wave.rays // self.device.vector_width),
            count=wave.rays,
            max_depth=self._max_depth,
            bounce=bounce,
            first_point=batch.points.start,
            first_sample=first_sample,
            stride=batch.stride,
            inverse_stride=1.0 / batch.stride,
            stream=stream,
            **self._seed,
            places=len(batch.points) * batch.stride,
            order=batch.order,
            triangles=self._triangles,
            textures=self._textures.records,
            texels=self._textures.texels,
            lights=self._data,
            casters=self._casters,
            guide_frame=self._frame,
            guide=self._guide_densities,
            guide_known=self._guide_known,
            guide_place=self._place,
            plane=wave.plane,
            wave=wave.words,
            radiance=self._radiance,
            next_plane=following.plane,
            next_wave=following.words,
        )
        self._wave, self._next = following, wave


def _zeros(device: Device, shape: tuple[int, ...] | int, dtype: type) -> HostArray:
    array = HostArray(device, shape, dtype)
    array.fill(0)
    return array
