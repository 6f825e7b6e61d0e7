"""The waves of a batch of paths, bounce after bounce, and who traces their rays."""

from __future__ import annotations

from collections.abc import Hashable
from typing import Any

import numpy as np

from ...opencl.device import Device
from ...opencl.memory import HostArray
from ...opencl.program import Program, build
from ...points.points import surface_defines
from ...points.trace import Tracer
from ...visibility.trace import DeviceTracer
from .embree import Copies, trace_in_place
from .wave import Wave, items_for, wave_defines


class Waves:
    """Two waves: kernels read one, whose rays are traced, and write the next.

    Parameters
    ----------
    device
    tracer : Tracer or DeviceTracer
    by_kernels : bool
        Whether paths.cl finds what rays hit itself.
    panes : bool
        Whether rays may go through thin panes.

    Attributes
    ----------
    now, next : Wave
    ahead : bool
        Whether nobody waits for how many rays there are: `now` knows most that there may be.
    """

    def __init__(
        self, device: Device, tracer: Tracer | DeviceTracer, by_kernels: bool, panes: bool
    ) -> None:
        self._device, self._tracer, self._by_kernels, self._panes = device, tracer, by_kernels, panes
        self._copies = None if device.memory.shared else Copies(device)
        self._first = 0
        self._totals = HostArray.of(device, np.zeros(1, np.uint64))
        self._is_counted = True
        self.ahead = False

    def make(self, most: int) -> None:
        """For at most so many rays of each kind."""
        self.now, self.next = (Wave(self._device, most, self._panes) for _ in range(2))

    def begin(self, rays: int, shadows: int = 0) -> Wave:
        """The wave that gets a batch's first rays, so many at most."""
        wave = self.now
        self._first = max(rays, shadows)
        wave.make_room(self._first)
        wave.expect(rays, shadows)
        return wave

    def trace(self, bounce: Hashable, hits: bool = True) -> float:
        """Closest hits of the rays, and which shadow rays reach their ends; the seconds of embree.

        Where nobody waits, `hits` False leaves the former out.
        """
        wave, tracer = self.now, self._tracer
        if self._by_kernels or isinstance(tracer, DeviceTracer):
            if not self.ahead:
                wave.count()
            if isinstance(tracer, DeviceTracer) and not self._by_kernels:
                self._trace_on_device(tracer, hits)
            return 0.0
        if self._copies is None:
            return trace_in_place(wave, tracer)
        return self._copies.trace(wave, tracer, self._first, bounce)

    def _trace_on_device(self, tracer: DeviceTracer, hits: bool) -> None:
        wave = self.now
        files = ("common", "surface", "wave", "trace", "wave_rays")
        # What only lights need is left out.
        without = {"HAS_ROWS": 0, "HAS_PANES": 0, "FOLLOWED": 0}
        defines = {**surface_defines(), **wave_defines(), **without, **tracer.defines()}
        program = build(self._device, files, defines)
        arguments = {**tracer.arguments, "plane": wave.plane, "wave": wave.words}
        if hits:
            items = items_for(self._device, wave.rays)
            program.kernel("find_hits")(items, numbers=tracer.numbers, **arguments)
        program.kernel("find_lit")(items_for(self._device, wave.shadows), **arguments)

    def each_lit(self, program: Program, name: str, **arguments: Any) -> None:
        """Have a kernel go through shadow rays that are traced, if there are such."""
        if not self._by_kernels:
            wave = self.now
            items = items_for(self._device, wave.shadows)
            program.kernel(name)(items, plane=wave.plane, wave=wave.words, **arguments)

    def shade(self, program: Program, branches: int, **arguments: Any) -> None:
        """From hits to shadow rays and the next rays, `branches` of each, which are then the wave."""
        wave, following = self.now, self.next
        most = branches * wave.rays
        following.make_room(most)
        following.expect(most, wave.rays)
        program.kernel("shade_hits")(
            items_for(self._device, -(-wave.rays // self._device.vector_width)),
            **arguments,
            plane=wave.plane,
            wave=wave.words,
            next_plane=following.plane,
            next_wave=following.words,
        )
        self.end(program)
        self.now, self.next = following, wave

    def follow(self, program: Program, **arguments: Any) -> None:
        """Rays to the ends of their paths, when shadow rays are answered."""
        wave, tracer = self.now, self._tracer
        assert isinstance(tracer, DeviceTracer)
        tree = {name: tracer.arguments[name] for name in ("extent", "levels", "boxes")}
        program.kernel("follow_paths")(
            items_for(self._device, -(-wave.rays // self._device.vector_width)),
            **arguments,
            **tree,
            corners=tracer.arguments["triangles"],
            numbers=tracer.numbers,
            plane=wave.plane,
            wave=wave.words,
        )

    def end(self, program: Program) -> None:
        """Count the wave's rays, and leave it empty."""
        program.kernel("end_wave")(1, wave=self.now.words, rays=self._totals, group=1)
        self._is_counted = False

    def counted(self) -> int:
        """Rays of both kinds in all waves that have ended since this was asked last."""
        if self._is_counted:
            return 0
        rays = int(self._totals.read()[0])
        self._totals.fill(0)
        self._is_counted = True
        return rays
