"""Samples of an integrand in batches: coordinates, values without shadow, and traced visibility."""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np

from ..integrands import Integrand
from ..opencl.device import Device
from ..opencl.kernel import Arguments
from ..opencl.memory import HostArray
from ..opencl.program import build
from ..points.groups import Groups
from ..points.points import ShadingPoints, surface_defines
from ..points.sampler import Stream, sampler_defines, seed_words
from ..points.trace import Tracer
from ..scene.load import Scene
from ..visibility import tuning as visibility_tuning
from ..visibility.lines import LINE_FILES, line_defines
from ..visibility.rays import RayCount, shadow_rays
from ..visibility.room import LANE_BLOCKS, Asked, Batch, Room, sample_bytes, samples_held
from ..visibility.shaft import Occluders
from ..visibility.slices import Slices
from ..visibility.trace import DeviceTracer
from .warp import Warp

# Slots of samples without a ray: their value is zero, or they are known to see the light.
NO_RAY = 0xFFFFFFFF
SEEN = 0xFFFFFFFE
# Samples a point on average drawn at a time; Ctrl-C, targets and progress act between such passes.
SAMPLES_A_PASS = 128
# Samples held at a time, or fewer where the device has less memory: the scratch memory of sampling is
# fixed whatever the image's size.
SAMPLES_PER_BATCH = 1 << 19
# Samples of one point drawn at a time; fixed, so that sums do not depend on the size of a batch.
LONGEST_RUN = 1024
# Samples whose mean stands for the unshadowed integral; it only scales what the network learns.
MEAN_SAMPLES = 64


def ray_defines() -> dict[str, str]:
    """The `-D` constants of batch.cl and samples.cl."""
    return {"NO_RAY": f"{NO_RAY}u", "SEEN": f"{SEEN}u"}


class Batches:
    """Memory for batches of samples, and how work is cut to fit it.

    Parameters
    ----------
    device, points
    channels : int
    samples_per_point : int
        Samples a point that `batches` leaves room for.
    nested : bool
        Whether there are paths behind the samples.

    Attributes
    ----------
    sliced : bool
        Whether samples are slices of the hemisphere.
    by_kernels : bool
        Whether paths are traced by kernels, and none by the host.
    members : int
        Points that share paths where points do.
    runs_ahead : bool
        Whether the host waits for nothing while it draws: samples come in the order they are asked for.
    """

    sliced = False
    by_kernels = False
    members = 1
    runs_ahead = False

    def __init__(
        self,
        device: Device,
        points: ShadingPoints,
        channels: int,
        samples_per_point: int,
        nested: bool = False,
    ) -> None:
        self.device = device
        self.points = points
        self.channels = channels
        self._rays = RayCount()
        self._every_point = HostArray.of(device, np.arange(points.active, dtype=np.uint32))
        self.stride = self._stride_of(samples_per_point)
        samples = samples_held(device, SAMPLES_PER_BATCH, sample_bytes(channels, nested))
        self.points_per_batch = max(1, min(points.active, samples // self.stride))
        capacity = self._capacity = max(self.points_per_batch * self.stride, LONGEST_RUN * self.members)
        self._room = Room(device, channels, capacity)

    @property
    def rays(self) -> RayCount:
        """The rays of all samples so far."""
        self._collect()
        return self._rays

    @rays.setter
    def rays(self, rays: RayCount) -> None:
        self._collect()
        self._rays = rays

    def _collect(self) -> None:
        """Bring `_rays` up to date."""

    def move_to(self, points: ShadingPoints, occluders: Occluders | None = None) -> None:
        """Draw at other points from now on, in the memory that there is, and count rays anew.

        Parameters
        ----------
        occluders : Occluders, optional
            Of these points, where there were some of the others.
        """
        self.points, self.rays = points, RayCount()
        self._every_point = HostArray.of(self.device, np.arange(points.active, dtype=np.uint32))

    def unshadowed_means(self) -> HostArray:
        """Mean over the square of the integrand without shadows, float32 (channels, points.active)."""
        raise NotImplementedError

    def draw(
        self,
        points: range,
        samples: range,
        stream: int,
        order: HostArray | None = None,
        density: Warp | None = None,
    ) -> Batch:
        """Samples of points order[i], i in `points`, by `density`; valid until the next call."""
        raise NotImplementedError

    def groups(self, density: str, apart: int) -> Groups:
        """Which points share paths, where samples follow a density of this kind; none by default.

        The `apart` points of a pixel do not.
        """
        return Groups(np.arange(self.points.active, dtype=np.uint32))

    def batches(self, count: int | None = None) -> list[range]:
        """`count` points (all active ones by default) cut into ranges that fit a batch."""
        step = self.points_per_batch
        count = self.points.active if count is None else count
        return [range(first, min(first + step, count)) for first in range(0, count, step)]

    def parts(
        self, points: range, samples: range, most_points: int | None = None, grouped: int = 0
    ) -> list[tuple[range, range]]:
        """`samples` of each of `points`, cut into ranges of both that fit a batch.

        The first `grouped` points share paths, and are in other ranges than those that do not.
        """
        found = []
        for first in range(samples.start, samples.stop, LONGEST_RUN):
            part = range(first, min(first + LONGEST_RUN, samples.stop))
            step = max(1, self._capacity // self._stride_of(len(part)))
            step = min(step, most_points or step)
            edge = min(max(points.start, grouped), points.stop)
            # Groups are not cut, and a batch has room for what each of its points gets of all members.
            together = max(1, step // self.members**2) * self.members
            for start, stop, length in ((points.start, edge, together), (edge, points.stop, step)):
                found += [(range(a, min(a + length, stop)), part) for a in range(start, stop, length)]
        return found

    def drawn(
        self,
        parts: list[tuple[range, range]],
        stream: int,
        order: HostArray | None = None,
        density: Warp | None = None,
        grouped: int = 0,
    ) -> Iterator[Batch]:
        """Batches of all `parts` in turn, as `draw` makes one; each is valid until the next is taken."""
        for points, samples in parts:
            shared = {"grouped": True} if points.start < grouped else {}
            yield self.draw(points, samples, stream, order, density, **shared)

    def _stride_of(self, samples: int) -> int:
        """`samples` rounded up to whole vectors."""
        return -(-samples // self.device.vector_width) * self.device.vector_width


class SampleSource(Batches):
    """Draws samples of one integrand at the shading points of one image.

    Parameters
    ----------
    device, scene
    tracer : Tracer or DeviceTracer
        Answers rays, on the host or on the device.
    points, integrand
    sampler : {"independent", "sobol"}
    seed : int
    samples_per_point : int
        Samples a point that `batches` leaves room for.
    occluders : Occluders, optional
        What decides visibility where it is known; by default rays decide all.
    lines : bool
        Whether samples lie where lines see the lights.
    slices : Slices, optional
        Samples are whole slices of the hemisphere; the integrand must be `sliced`.
    """

    def __init__(
        self,
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
    ) -> None:
        super().__init__(device, points, integrand.channels, samples_per_point, integrand.nested)
        self.sliced = slices is not None
        self._tracer = tracer
        # Rays to lights pass panes; for others these are in the way.
        sees_through = scene.has_panes and integrand.promises("to_lights")
        self._seed = seed_words(seed)
        self._data = HostArray.of(device, integrand.data(scene))
        defines: dict[str, int | str] = {
            **surface_defines(),
            **sampler_defines(sampler),
            **integrand.defines(scene),
            **ray_defines(),
            "SHAFTS": int(occluders is not None),
            "LINES": int(lines and occluders is not None),
            "SLICES": int(slices is not None),
            "MEAN_SAMPLES": f"{MEAN_SAMPLES}u",
            "BLOCKS_A_ITEM": f"{visibility_tuning.BLOCKS_A_ITEM}u",
            "WARPED": 0,
        }
        shaft: tuple[str, ...] = ()
        self._occluders: Arguments = {}
        self._lines = lines
        if occluders is not None:
            shaft, defines = ("shaft",), {**defines, **occluders.defines()}
            if lines:
                shaft, defines = ("shaft", *LINE_FILES), {**defines, **line_defines()}
        if slices is not None:
            shaft, defines = ("slices",), {**defines, **slices.defines()}
            self._occluders = slices.arguments
        if device.vector_width == 1:
            defines["BLOCKS_A_ITEM"] = f"{LANE_BLOCKS}u"
        self._item_samples = int(str(defines["BLOCKS_A_ITEM"]).rstrip("u")) * device.vector_width
        files = ("common", "sampler", "surface", *integrand.kernels(), *shaft, "samples")
        self._program = build(device, files, defines)
        self._point_kernel = integrand.point_kernel(scene)
        self._look_at_points(occluders)
        # Built when first asked for: most renders draw uniformly only, or by density only.
        self._warped_files, self._warped_defines = files[:-1], {**defines, "WARPED": 1}
        rays = shadow_rays(device, tracer, self._capacity, sees_through)
        self._rooms = [(self._room, rays)]
        self.runs_ahead = rays.runs_ahead and not integrand.nested
        # A device of its own memory computes a batch while the host answers the rays of another. Of
        # paths the host has to know how many go on.
        if rays.streams and not device.memory.shared and not integrand.nested:
            second = Room(device, self.channels, self._capacity)
            self._rooms.append((second, shadow_rays(device, tracer, self._capacity, sees_through)))
            self.runs_ahead = True

    def _collect(self) -> None:
        for _, rays in self._rooms:
            rays.collect(self._rays)

    def move_to(self, points: ShadingPoints, occluders: Occluders | None = None) -> None:
        super().move_to(points)
        self._look_at_points(occluders)

    def _look_at_points(self, occluders: Occluders | None) -> None:
        """Take what is known of the points beside their surface."""
        points, self.occluders = self.points, occluders
        if occluders is not None:
            walked = occluders.walked if self._lines else {}
            self._occluders = {**occluders.arguments, **walked}
        if self._point_kernel is not None:
            self._program.kernel(self._point_kernel)(
                points.active,
                point_count=points.active,
                total_points=points.total,
                surface=points.surface,
                integrand_data=self._data,
            )

    def unshadowed_means(self) -> HostArray:
        """Mean over the square of the integrand without shadows, float32 (channels, points.active)."""
        active = self.points.active
        means = HostArray(self.device, (self.channels, active), np.float32)
        self._program.kernel("unshadowed_means")(
            active,
            point_count=active,
            total_points=self.points.total,
            first_id=self.points.first_id,
            stream=Stream.UNSHADOWED,
            **self._seed,
            surface=self.points.surface,
            integrand_data=self._data,
            means=means,
        )
        return means

    def draw(
        self,
        points: range,
        samples: range,
        stream: int,
        order: HostArray | None = None,
        density: Warp | None = None,
    ) -> Batch:
        """Sample points order[i], i in `points`, and trace what matters; see `parts` for how many.

        Without an `order` these are the points themselves. With a `density` samples are drawn by it,
        else uniformly. The batch is valid until the next call.
        """
        return self._answered(self._asked(0, points, samples, stream, order, density))

    def drawn(
        self,
        parts: list[tuple[range, range]],
        stream: int,
        order: HostArray | None = None,
        density: Warp | None = None,
        grouped: int = 0,
    ) -> Iterator[Batch]:
        if len(self._rooms) == 1:
            yield from super().drawn(parts, stream, order, density, grouped)
            return
        before = None
        for number, part in enumerate(parts):
            asked = self._asked(number % 2, *part, stream, order, density)
            if before is not None:
                yield self._answered(before)
            before = asked
        if before is not None:
            yield self._answered(before)

    def _asked(
        self,
        number: int,
        points: range,
        samples: range,
        stream: int,
        order: HostArray | None,
        density: Warp | None,
    ) -> Asked:
        """Have the device compute a batch in one of the rooms."""
        begun = time.perf_counter()
        room, rays = self._rooms[number]
        order = self._every_point if order is None else order
        count = len(samples)
        stride = self._stride_of(count)
        rays.begin()
        program = self._program
        warp: Arguments = {}
        if density is not None:
            files = (*self._warped_files, *density.files, "samples")
            program = build(self.device, files, self._warped_defines | density.defines)
            warp = {"density": density.records(order, points), "weight": room.weight}
        drawn = program.kernel("draw_samples")(
            len(points) * -(-stride // self._item_samples),
            first_point=points.start,
            point_count=len(points),
            total_points=self.points.total,
            first_id=self.points.first_id,
            first_sample=samples.start,
            sample_count=count,
            stride=stride,
            stream=stream,
            **self._seed,
            order=order,
            surface=self.points.surface,
            integrand_data=self._data,
            **warp,
            **self._occluders,
            u=room.u,
            v=room.v,
            value=room.value,
            slot=room.slot,
            **rays.arguments,
        )
        self._rays.sample_seconds += time.perf_counter() - begun
        waits = drawn if len(self._rooms) > 1 else None
        return Asked(room, rays, waits, points, order, count, stride, warp.get("weight"))

    def _answered(self, asked: Asked) -> Batch:
        """The batch with its rays answered."""
        begun, traced = time.perf_counter(), self._rays.trace_seconds
        asked.answer(self._rays)
        traced = self._rays.trace_seconds - traced
        self._rays.sample_seconds += time.perf_counter() - begun - traced
        room = asked.room
        arrays = (room.u, room.v, room.value, room.slot, room.visible)
        return Batch(asked.points, asked.order, asked.samples, asked.stride, *arrays, asked.weight)
