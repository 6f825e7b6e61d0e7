"""A wave's rays traced by embree: in memory that host and device share, or by copies of them."""

from __future__ import annotations

import time
from collections.abc import Hashable

import numpy as np
import pyopencl as cl

from ...opencl.device import Device
from ...opencl.memory import Window, start_copy
from ...opencl.staging import Staging
from ...points.trace import Hits, Tracer
from .wave import COUNT_STEP, HEADER, PLANES, Wave

# Rays that are copied beyond those expected by the batch before: one in so many, and a few.
SPARE_SHARE, SPARE = 16, 64
# Rows that embree reads of rays and of shadow rays, origin and direction, and those that it writes.
RAY_ROWS = range(PLANES["origin"].start, PLANES["direction"].stop)
SHADOW_ROWS = range(PLANES["shadow_origin"].start, PLANES["shadow_direction"].stop)
HIT_ROWS = range(PLANES["triangle"].start, PLANES["distance"].stop)
LIT_ROW = range(PLANES["lit"].start, PLANES["lit"].stop)
THROUGHPUT_ROWS = range(PLANES["shadow_throughput"].start, PLANES["shadow_throughput"].stop)


def answer(
    tracer: Tracer,
    rays: np.ndarray,
    hits: np.ndarray,
    shadows: np.ndarray,
    lit: np.ndarray,
    throughput: np.ndarray | None,
) -> float:
    """Trace rays and shadow rays; the seconds.

    Parameters
    ----------
    rays, shadows : ndarray
        float32 (6, rays) and (6, shadow rays), origins and directions.
    hits : ndarray
        float32 (4, rays), written: triangles (as int32), u, v, distances.
    lit : ndarray
        uint8 (shadow rays,), written.
    throughput : ndarray, optional
        float32 (3, shadow rays), which panes dim.
    """
    started = time.perf_counter()
    triangle, u, v, distance = hits
    tracer.closest_and_visible(
        rays[:3].T,
        rays[3:].T,
        Hits(triangle.view(np.int32), u, v, distance),
        shadows[:3].T,
        shadows[3:].T,
        lit,
        *([] if throughput is None else [throughput.T]),
    )
    return time.perf_counter() - started


def trace_in_place(wave: Wave, tracer: Tracer) -> float:
    """Have embree trace a wave in memory that host and device share; its seconds."""
    planes = wave.host_planes
    with wave.words.mapped(count=HEADER + planes * wave.plane, update=True) as words:
        wave.take_counts(words)
        own = words[HEADER:].reshape(planes, wave.plane)
        rays, shadows = own[:, : wave.rays], own[:, : wave.shadows]
        return answer(
            tracer,
            rays[RAY_ROWS.start : RAY_ROWS.stop],
            rays[HIT_ROWS.start : HIT_ROWS.stop],
            shadows[SHADOW_ROWS.start : SHADOW_ROWS.stop],
            own[LIT_ROW.start].view(np.uint8)[: wave.shadows],
            shadows[THROUGHPUT_ROWS.start : THROUGHPUT_ROWS.stop] if wave.panes else None,
        )


class Copies:
    """Copies of waves for embree, where a device has its own memory: 24 bytes a ray out, 16 or 1 back.

    How many rays there are comes with the rays themselves: as many are copied as the batch before had
    at the same bounce, and a few more. So the host waits once, or twice where that was not enough.
    """

    def __init__(self, device: Device) -> None:
        names = ("counts", "rays", "hits", "shadows", "lit", "throughput")
        self._areas = {name: Staging(device) for name in names}
        # Of each bounce how many were there first, and rays of both kinds, in the batch before.
        self._before: dict[Hashable, tuple[int, int, int]] = {}

    def trace(self, wave: Wave, tracer: Tracer, first: int, bounce: Hashable) -> float:
        """Have embree trace a wave of a batch whose `first` one had so many rays at most; its seconds.

        What `wave.rays` and `wave.shadows` are before is the most there may be.
        """
        rays, shadows, throughput = self._fetched(wave, *self._expected(wave, first, bounce))
        self._before[bounce] = (first, wave.rays, wave.shadows)
        hits, hits_number = self._areas["hits"].area((len(HIT_ROWS), wave.rays), np.dtype(np.float32))
        # Whole words.
        words = -(-wave.shadows // 4)
        lit, lit_number = self._areas["lit"].area((1, words), np.dtype(np.float32))
        seconds = answer(
            tracer, rays, hits, shadows, lit.view(np.uint8).reshape(-1)[: wave.shadows], throughput
        )
        self._give_back(wave, "hits", hits, hits_number, HIT_ROWS)
        self._give_back(wave, "lit", lit, lit_number, LIT_ROW)
        if throughput is not None:
            own, number = self._areas["throughput"].area(throughput.shape, throughput.dtype)
            own[...] = throughput
            self._give_back(wave, "throughput", own, number, THROUGHPUT_ROWS)
        return seconds

    def _expected(self, wave: Wave, first: int, bounce: Hashable) -> tuple[int, int]:
        """Rays and shadow rays that a wave hardly has more of."""
        most = wave.rays, wave.shadows
        if bounce not in self._before:
            return most
        begun, *before = self._before[bounce]
        expected = (-(-count * first // begun) for count in before)
        rays, shadows = (
            min(bound, count + count // SPARE_SHARE + SPARE)
            for bound, count in zip(most, expected, strict=True)
        )
        return rays, shadows

    def _fetched(
        self, wave: Wave, rays: int, shadows: int
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
        """Rays, shadow rays and with panes their throughputs, copied when so many are expected."""
        counts = self._areas["counts"].area((1, COUNT_STEP + 1), np.dtype(np.float32))[0]
        header = Window(0, HEADER, range(1), range(COUNT_STEP + 1))
        parts = [("rays", RAY_ROWS, rays), ("shadows", SHADOW_ROWS, shadows)]
        if wave.panes:
            parts.append(("throughput", THROUGHPUT_ROWS, shadows))
        found = [
            self._areas[name].area((len(rows), count), np.dtype(np.float32))[0]
            for name, rows, count in parts
        ]
        copies = [start_copy(wave.words, counts, header)]
        for (_, rows, count), own in zip(parts, found, strict=True):
            if count:
                window = Window(HEADER, wave.plane, rows, range(count))
                copies.append(start_copy(wave.words, own, window))
        # The last of an in-order queue.
        cl.wait_for_events(copies[-1:])
        wave.take_counts(counts[0])
        if wave.rays > rays or wave.shadows > shadows:
            return self._fetched(wave, wave.rays, wave.shadows)
        throughput = found[2][:, : wave.shadows] if wave.panes else None
        return found[0][:, : wave.rays], found[1][:, : wave.shadows], throughput

    def _give_back(self, wave: Wave, name: str, own: np.ndarray, number: int, rows: range) -> None:
        """Copy planes back; nobody waits."""
        if own.size:
            window = Window(HEADER, wave.plane, rows, range(own.shape[1]))
            self._areas[name].copying(number, start_copy(wave.words, own, window, back=True))
