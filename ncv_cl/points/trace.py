"""Rays on the host: embree by way of embreex, chunked over threads."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from embreex import rtcore_scene
from embreex.mesh_construction import TriangleMesh

from ..scene.load import Scene
from ..scene.textures.holes import Holes
from .panes import Panes

# Most and fewest rays a task: few enough to balance threads, many enough to hide the cost of a call.
CHUNK = 1 << 14
SMALLEST_CHUNK = 1 << 11
# A ray that passes a hole goes on this much behind it, as a part of the coordinates that enter: two of
# their roundings, and twice as much whenever it hits the same triangle again.
PAST_HOLE = 2.0**-23


@dataclass(frozen=True)
class Hits:
    """Closest hits: triangle index (-1 for none), barycentric u, v of corners 1 and 2, and distance.

    The distance is in multiples of the ray's direction.
    """

    triangle: np.ndarray
    u: np.ndarray
    v: np.ndarray
    distance: np.ndarray


def usable_cores() -> int:
    """Cores that this process may use; all there are where the system has no such limit."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


class Tracer:
    """A scene committed to embree.

    Parameters
    ----------
    scene : Scene
    threads : int, optional
        Host threads; the number of cores this process may use by default. embreex releases the GIL
        while it traces.
    """

    def __init__(self, scene: Scene, threads: int | None = None) -> None:
        if threads is not None and (int(threads) != threads or threads < 1):
            raise ValueError(f"threads must be a whole number of at least 1, got {threads!r}")
        self.threads = threads or usable_cores()
        # Robust traversal: no ray slips through the edge between two triangles.
        self._scene = rtcore_scene.EmbreeScene(robust=True)
        TriangleMesh(self._scene, scene.vertices, scene.triangles.astype(np.int32))
        self._holes = Holes(scene) if scene.has_holes else None
        self._panes = Panes(scene) if scene.has_panes else None
        self._pool = ThreadPoolExecutor(self.threads)
        # The first run commits the scene and must not race with another.
        ray = np.zeros((1, 3), np.float32)
        self._scene.run(ray, ray + np.float32(1.0))

    def closest(self, origins: np.ndarray, directions: np.ndarray, out: Hits | None = None) -> Hits:
        """The closest hit of each ray; `origins` and `directions` are float32 (rays, 3).

        Written to `out` where that is given: int32 and three times float32 (rays,).
        """
        kinds = (np.int32, np.float32, np.float32, np.float32)
        hits = out or Hits(*(np.empty(len(origins), kind) for kind in kinds))
        self._in_chunks((len(origins), self._closest_part(origins, directions, hits)))
        return hits

    def visible(
        self,
        origins: np.ndarray,
        directions: np.ndarray,
        distances: np.ndarray,
        out: np.ndarray,
        light: np.ndarray | None = None,
    ) -> None:
        """Write 1 to `out` (uint8) where nothing lies between 0 and `distances` along a ray, else 0.

        Directions need no unit length; distances are in multiples of them. With `light` (float32
        (rays, 3)) thin panes are not in the way: what they let through multiplies it.
        """
        part = self._visible_part(origins, directions, distances, out, light)
        self._in_chunks((len(origins), part))

    def closest_and_visible(
        self,
        origins: np.ndarray,
        directions: np.ndarray,
        hits: Hits,
        shadow_origins: np.ndarray,
        shadow_directions: np.ndarray,
        out: np.ndarray,
        light: np.ndarray | None = None,
    ) -> None:
        """`closest` of some rays, `visible` to the ends of others: threads wait once for both."""
        shadows = (shadow_origins, shadow_directions, np.ones(len(out), np.float32), out, light)
        self._in_chunks(
            (len(origins), self._closest_part(origins, directions, hits)),
            (len(shadow_origins), self._visible_part(*shadows)),
        )

    def _closest_part(
        self, origins: np.ndarray, directions: np.ndarray, hits: Hits
    ) -> Callable[[slice], None]:
        def trace(part: slice) -> None:
            found = self._scene.run(origins[part], directions[part], output=True)
            hits.triangle[part] = found["primID"]
            hits.u[part] = found["u"]
            hits.v[part] = found["v"]
            hits.distance[part] = found["tfar"]
            if self._holes is not None:
                own = Hits(*(getattr(hits, name)[part] for name in vars(hits)))
                self._pass(origins[part], directions[part], own)

        return trace

    def _passes(self, triangle: np.ndarray, u: np.ndarray, v: np.ndarray, panes: bool) -> np.ndarray:
        """Which hits are in holes, or with `panes` on panes."""
        found = np.zeros(len(triangle), bool)
        if self._holes is not None:
            found |= self._holes.at(triangle, u, v)
        if panes and self._panes is not None:
            found |= (triangle >= 0) & self._panes.triangles[triangle]
        return found

    def _pass(
        self,
        origins: np.ndarray,
        directions: np.ndarray,
        hits: Hits,
        farthest: np.ndarray | None = None,
        light: np.ndarray | None = None,
    ) -> None:
        """Go on where hits are in holes, to the next that are not, or to `farthest` along a ray.

        With `light` rays go on behind panes too, which multiply it.
        """
        panes = light is not None
        waiting = np.flatnonzero(self._passes(hits.triangle, hits.u, hits.v, panes))
        step = np.full(len(origins), PAST_HOLE, np.float32)
        if panes:
            self._dim(light, waiting, hits, directions)
        while waiting.size:
            start, towards, passed = origins[waiting], directions[waiting], hits.triangle[waiting]
            distance = hits.distance[waiting]
            along = distance[:, None] * towards
            coordinates = (np.abs(start) + np.abs(along)).max(axis=1) / np.abs(towards).max(axis=1)
            distance = distance + step[waiting] * coordinates
            left = np.full(len(waiting), np.inf, np.float32)
            if farthest is not None:
                left = np.maximum(farthest[waiting] - distance, np.float32(0.0))
            is_left = left > 0
            found = self._scene.run(start + distance[:, None] * towards, towards, left, output=True)
            triangle = np.where(is_left, found["primID"], -1)
            again = triangle == passed
            step[waiting] = np.where(again, 2 * step[waiting], PAST_HOLE)
            hits.triangle[waiting] = triangle
            hits.u[waiting], hits.v[waiting] = found["u"], found["v"]
            hits.distance[waiting] = distance + found["tfar"]
            on = self._passes(triangle, found["u"], found["v"], panes)
            if panes:
                # A pane that rounding makes a ray meet twice dims it once.
                self._dim(light, waiting[on & ~again], hits, directions)
            waiting = waiting[on]

    def _dim(
        self, light: np.ndarray | None, rays: np.ndarray, hits: Hits, directions: np.ndarray
    ) -> None:
        """Multiply `light`, if it is asked for, of those of the `rays` that hit panes."""
        if light is None or self._panes is None:
            return
        rays = rays[self._panes.triangles[hits.triangle[rays]]]
        light[rays] *= self._panes.let_through(
            hits.triangle[rays], hits.u[rays], hits.v[rays], directions[rays]
        )

    def _visible_part(
        self,
        origins: np.ndarray,
        directions: np.ndarray,
        distances: np.ndarray,
        out: np.ndarray,
        light: np.ndarray | None,
    ) -> Callable[[slice], None]:
        def trace(part: slice) -> None:
            blocked = self._scene.run(origins[part], directions[part], distances[part], query="OCCLUDED")
            np.less(blocked, 0, out=out[part].view(np.bool_))
            if self._holes is not None or light is not None:
                own = None if light is None else light[part]
                self._see_through(origins[part], directions[part], distances[part], out[part], own)

        return trace

    def _see_through(
        self,
        origins: np.ndarray,
        directions: np.ndarray,
        distances: np.ndarray,
        out: np.ndarray,
        light: np.ndarray | None,
    ) -> None:
        """Ask again about rays that are blocked: by holes, or with `light` panes, they are visible."""
        blocked = np.flatnonzero(out == 0)
        starts, towards, farthest = origins[blocked], directions[blocked], distances[blocked]
        # embree writes hits' distances where it was given the farthest ones.
        found = self._scene.run(starts, towards, farthest.copy(), output=True)
        hits = Hits(*(found[name].copy() for name in ("primID", "u", "v", "tfar")))
        own = None if light is None else light[blocked]
        self._pass(starts, towards, hits, farthest, own)
        if light is not None:
            light[blocked] = own
        out[blocked] = hits.triangle < 0

    def _in_chunks(self, *work: tuple[int, Callable[[slice], None]]) -> None:
        """Do each (rays, what traces a part of them), cut into parts that all threads share."""
        shared = sum(rays for rays, _ in work) // (2 * self.threads)
        step = min(max(shared, SMALLEST_CHUNK), CHUNK)
        parts = [
            (trace, slice(start, min(start + step, rays)))
            for rays, trace in work
            for start in range(0, rays, step)
        ]
        if len(parts) == 1:
            parts[0][0](parts[0][1])
        else:
            # list() passes on what a thread raised.
            list(self._pool.map(lambda part: part[0](part[1]), parts))
