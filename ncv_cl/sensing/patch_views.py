"""View factors by samples: along lines on a target, or by rays that end on it."""

from __future__ import annotations

from concurrent.futures import Executor
from dataclasses import replace

import numpy as np

from ..opencl.device import Device
from ..points.hidden import frames
from ..points.patches import Patch, patch_points
from ..points.points import RELATIVE_OFFSET
from ..points.sampler import HostStream, Stream, host_generator, square_samples
from ..points.trace import Tracer
from ..scene.load import Material, QuadLight, Scene
from ..visibility.tuning import MOST_LIGHTS
from .sense import irradiance

# Independent scrambles of the points on a patch, whose spread tells the error.
SCRAMBLES = 16
EXACT, LINES, RAYS, RECIPROCAL = "exact", "lines", "rays", "reciprocal"
# Of all surfaces: what arrives counts, and not what is reflected.
_BLACK = Material(np.zeros(3, np.float32), name="black")


def _has_lines(patch: Patch) -> bool:
    return len(patch.corner) <= MOST_LIGHTS and bool(patch.is_parallelogram.all())


def measured(
    device: Device,
    scene: Scene,
    sides: list[Patch],
    wanted: np.ndarray,
    points: int,
    lines: int,
    seed: int,
    executor: Executor | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Each scramble's factors, float64 (patches, patches, SCRAMBLES), and `ViewFactors.how`."""
    places = {
        k: patch_points(device, side, points, range(k * SCRAMBLES, (k + 1) * SCRAMBLES), seed)
        for k, side in enumerate(sides)
        if wanted[k].any()
    }
    means = np.full((*wanted.shape, SCRAMBLES), np.nan)
    how = np.where(wanted, RECIPROCAL, EXACT)
    # Lines do not pass the holes of textures.
    along = np.array([_has_lines(side) and not scene.has_holes for side in sides], bool)
    for target in np.flatnonzero(along & wanted.any(axis=0)):
        sources = np.flatnonzero(wanted[:, target])
        chosen = [places[int(k)] for k in sources]
        means[sources, target] = _along_lines(
            device, scene, sides[target], chosen, lines, seed, executor
        )
        how[sources, target] = LINES
    for source in np.flatnonzero(~along):
        rest = np.flatnonzero(~along & wanted[source])
        if len(rest):
            own, targets = sides[source], [sides[k] for k in rest]
            means[source, rest] = _by_rays(device, scene, own, places[int(source)], targets, lines, seed)
            how[source, rest] = RAYS
    return means, how


def _along_lines(
    device: Device,
    scene: Scene,
    target: Patch,
    places: list[tuple[np.ndarray, np.ndarray]],
    lines: int,
    seed: int,
    executor: Executor | None,
) -> np.ndarray:
    """Each scramble's mean of the factors from points of each source, float64 (sources, SCRAMBLES)."""
    position, normal = (np.stack(arrays) for arrays in zip(*places, strict=True))
    found = irradiance(
        _lit_by(scene, target),
        position.reshape(-1, 3) + scene.origin,
        normal.reshape(-1, 3),
        method="mc",
        spp=lines,
        visibility="lines",
        seed=seed,
        device=device,
        executor=executor,
    )
    return found.values[:, 0].reshape(position.shape[:3]).mean(axis=2) / np.pi


def _lit_by(scene: Scene, patch: Patch) -> Scene:
    """The scene with nothing but the patch's side as its lights, of radiance 1."""
    pieces = (patch.corner, patch.edge1, patch.edge2)
    lights = tuple(
        QuadLight(*vectors, np.ones(3, np.float32)).single() for vectors in zip(*pieces, strict=True)
    )
    corners = [
        np.stack([one.corner, one.corner + one.edge1, one.corner + one.edge1 + one.edge2,
                  one.corner + one.edge2])
        for one in lights
    ]  # fmt: skip
    kept = np.delete(scene.triangles, patch.triangles, axis=0)
    first = len(scene.vertices) + 4 * np.arange(len(lights), dtype=np.uint32)[:, None]
    added = first + np.array([[0, 1, 2, 0, 2, 3]], np.uint32)
    vertices = np.concatenate([scene.vertices, *corners]).astype(np.float32)
    triangles = np.concatenate([kept, added.reshape(-1, 3)]).astype(np.uint32)
    light = np.full(len(triangles), -1, np.int32)
    light[len(kept) :] = np.repeat(np.arange(len(lights)), 2)
    return replace(
        scene,
        materials=(_BLACK,),
        lights=lights,
        vertices=vertices,
        vertex_normals=np.zeros_like(vertices),
        triangles=triangles,
        triangle_material=np.zeros(len(triangles), np.int32),
        triangle_light=light,
        vertex_uv=None,
        vertex_colours=None,
        environment=None,
        named=(),
    )


def _by_rays(
    device: Device,
    scene: Scene,
    source: Patch,
    place: tuple[np.ndarray, np.ndarray],
    targets: list[Patch],
    rays: int,
    seed: int,
) -> np.ndarray:
    """Shares of rays from a source's points that end on the targets, float64 (targets, SCRAMBLES)."""
    position, normal = (np.repeat(array, rays, axis=1) for array in place)
    number = position.shape[1]
    u, v = square_samples(device, "sobol", range(SCRAMBLES), range(number), seed, Stream.PATCH_RAYS)
    generator = host_generator(seed, HostStream.PATCH_RAYS)
    # Points and directions are of the same sequence: in another order they are independent.
    order = np.stack([generator.permutation(number) for _ in range(SCRAMBLES)])
    u, v = (np.take_along_axis(array, order, axis=1).ravel() for array in (u, v))
    position, normal = position.reshape(-1, 3), normal.reshape(-1, 3)
    direction = _cosine_directions(normal, u, v)
    offset = RELATIVE_OFFSET * (np.abs(position).max(axis=1) + source.spread)
    hits = Tracer(scene).closest(
        (position + offset[:, None] * normal).astype(np.float32), direction.astype(np.float32)
    )
    return np.stack([_arrived(scene, target, hits.triangle, direction) for target in targets])


def _cosine_directions(normal: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Directions about normals (n, 3) of density cos / pi, float64 (n, 3)."""
    tangent, other = frames(normal)
    radius, angle = np.sqrt(u.astype(np.float64)), 2 * np.pi * v.astype(np.float64)
    across = np.cos(angle)[:, None] * tangent + np.sin(angle)[:, None] * other
    return radius[:, None] * across + np.sqrt(1 - radius**2)[:, None] * normal


def _arrived(scene: Scene, target: Patch, triangle: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """The share of rays that hit the patch, and on its side, in each scramble: float64 (SCRAMBLES,)."""
    own = np.full(len(scene.triangles) + 1, -1)
    own[target.triangles] = np.arange(len(target.triangles))
    own = own[triangle]
    facing = np.sum(target.triangle_normals(scene)[own] * direction, axis=1) < 0
    return ((own >= 0) & facing).reshape(SCRAMBLES, -1).mean(axis=1)
