"""Samples of functions of the user: coordinates go out, a Python callable gives the values."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..integrands import Integrand, IntegrandError
from ..opencl.device import Device
from ..opencl.kernel import Arguments
from ..opencl.memory import HostArray, Window
from ..opencl.program import build
from ..points.points import SURFACE, ShadingPoints
from ..points.sampler import Stream, sampler_defines, seed_words
from ..scene.load import Scene
from ..visibility.room import Batch
from .samples import SAMPLES_A_PASS, Batches, ray_defines
from .warp import Warp

# A callable's constant is the median of so many values at each of so many points.
OFFSET_POINTS, OFFSET_SAMPLES = 256, 17
# Sums of squares of larger values would overflow float32.
LARGEST_VALUE = 1e15

Function = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


class HostIntegrand(Integrand):
    """An integrand that a Python callable evaluates."""

    name = "custom"
    files = ()
    inputs = ("position",)
    demodulated = False
    emitters_active = True
    channels = 1

    def __init__(self, channels: int) -> None:
        self.channels = channels

    def data(self, scene: Scene) -> np.ndarray:
        return np.empty(0, np.float32)

    def defines(self, scene: Scene) -> dict[str, int | str]:
        return {"CHANNELS": self.channels}


def function_points(device: Device, positions: np.ndarray) -> ShadingPoints:
    """Points of which a function knows only the number; float32 (points, 3) tells them apart."""
    count = len(positions)
    surface = np.zeros((SURFACE.size, count), np.float32)
    surface[SURFACE["position"]] = positions.T
    nowhere = np.full(count, -1, np.int32)
    return ShadingPoints(
        HostArray.of(device, surface), np.arange(count, dtype=np.uint32), nowhere, count, 0
    )


class CallableSource(Batches):
    """Draws samples of a callable less a constant, as `SampleSource` does of a scene's integrand.

    Attributes
    ----------
    offset : ndarray
        float64 (channels,), a constant that is subtracted from f and added to the result again: 0, and
        after `centre` the median of a few values at some points. With it float32 holds the differences
        of f even if f is large. It comes from samples that nothing else uses, so estimates stay
        unbiased.
    """

    def __init__(
        self,
        device: Device,
        points: ShadingPoints,
        function: Function,
        channels: int,
        sampler: str,
        seed: int,
    ) -> None:
        super().__init__(device, points, channels, SAMPLES_A_PASS)
        self.function = function
        self._seed = seed_words(seed)
        self._defines: dict[str, int | str] = {
            **sampler_defines(sampler),
            **ray_defines(),
        }
        with (
            self._room.slot.mapped(write=True) as slot,
            self._room.visible.mapped(write=True) as visible,
        ):
            slot[...], visible[...] = np.arange(len(slot), dtype=np.uint32), 1
        self.offset = np.zeros(channels)

    def centre(self) -> None:
        """Set `offset` to the medians of f's channels over some values at some points."""
        points = self.points.active
        chosen = np.linspace(0, points, min(points, OFFSET_POINTS), endpoint=False)
        order = HostArray.of(self.device, chosen.astype(np.uint32))
        parts = self.parts(range(len(chosen)), range(OFFSET_SAMPLES))
        values = [self._values(*part, Stream.OFFSET, order)[0] for part in parts]
        flat = np.concatenate([one.reshape(-1, self.channels) for one in values])
        self.offset = self.offset + np.median(flat, axis=0)

    def draw(
        self,
        points: range,
        samples: range,
        stream: int,
        order: HostArray | None = None,
        density: Warp | None = None,
    ) -> Batch:
        order = self._every_point if order is None else order
        values, weight = self._values(points, samples, stream, order, density)
        stride = self._stride_of(len(samples))
        count, shape = len(points) * stride, (len(points), stride)
        window = Window(0, count, range(self.channels), range(count))
        with self._room.value.mapped(write=True, window=window) as view:
            planes = view.reshape(self.channels, *shape)
            planes[..., : len(samples)] = np.moveaxis(values, -1, 0)
            planes[..., len(samples) :] = 0
        arrays = (self._room.u, self._room.v, self._room.value, self._room.slot, self._room.visible)
        return Batch(points, order, len(samples), stride, *arrays, weight)

    def _values(
        self,
        points: range,
        samples: range,
        stream: int,
        order: HostArray,
        density: Warp | None = None,
    ) -> tuple[np.ndarray, HostArray | None]:
        """f less the constant, float64 (points, samples, channels), and with a density the weights."""
        stride = self._stride_of(len(samples))
        warp: Arguments = {}
        files: tuple[str, ...] = ()
        defines: dict[str, int | str] = {}
        if density is not None:
            warp = {"density": density.records(order, points), "weight": self._room.weight}
            files, defines = density.files, density.defines
        defines = {**self._defines, **defines, "WARPED": int(bool(warp))}
        program = build(self.device, ("common", "sampler", *files, "callable"), defines)
        program.kernel("draw_coordinates")(
            len(points) * stride // self.device.vector_width,
            first_point=points.start,
            point_count=len(points),
            first_id=self.points.first_id,
            first_sample=samples.start,
            stride=stride,
            stream=stream,
            **self._seed,
            order=order,
            **warp,
            u=self._room.u,
            v=self._room.v,
        )
        count, shape = len(points) * stride, (len(points), stride)
        u, v = (
            array.read(count).reshape(shape)[:, : len(samples)] for array in (self._room.u, self._room.v)
        )
        chosen = order.read()[points.start : points.stop]
        index = np.broadcast_to(chosen[:, None] + np.uint32(self.points.first_id), u.shape)
        values = self._evaluate(u.ravel(), v.ravel(), index.ravel())
        return values.reshape(*u.shape, self.channels), warp.get("weight")

    def _evaluate(self, u: np.ndarray, v: np.ndarray, index: np.ndarray) -> np.ndarray:
        """f less the constant, float64 (samples, channels), checked."""
        values = np.asarray(self.function(u, v, index))
        if values.shape not in ((u.size, self.channels), *(((u.size,),) if self.channels == 1 else ())):
            raise IntegrandError(
                f"f must return {(u.size, self.channels)} values for {u.size} samples, "
                f"returned {values.shape}"
            )
        if values.dtype.kind not in "bfiu":
            raise IntegrandError(f"f must return real numbers, returned {values.dtype}")
        values = values.reshape(u.size, self.channels).astype(np.float64) - self.offset
        for what, bad in (
            ("not finite", ~np.isfinite(values)),
            (f"beyond its median by more than {LARGEST_VALUE:.0e}", np.abs(values) > LARGEST_VALUE),
        ):
            if not bad.any():
                continue
            samples = np.flatnonzero(bad.any(axis=1))
            first = samples[0]
            raise IntegrandError(
                f"f is {what} at {len(samples)} of {u.size} samples of "
                f"{len(np.unique(index[samples]))} points, "
                f"first at u = {u[first]}, v = {v[first]}, point {index[first]}"
            )
        return values
