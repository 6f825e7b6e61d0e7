"""What environment.cl reads: suns, maps by which directions are drawn, the image; and their strips.

A map is a density over the sphere, for surfaces whose normals are near one direction.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..opencl.layout import Record
from ..scene.load import Scene
from ..scene.sky.environment import Environment
from . import tuning
from .light_cells import Cells

# Of the environment: the image's axes and size, where its texels begin, and what reaches out of the
# scene from its origin.
SKY = Record("SKY", {"axes": 9, "width": 1, "height": 1, "texels": 1, "reach": 1}, multiple=16)
# A sun: towards it, the chord of its half angle, and one over its solid angle.
SUN = Record("SUN", {"direction": 3, "chord": 1, "radiance": 3, "density": 1})
# Of a row of strips: the environment's part of the square, the image's, where its map begins; then each
# sun's part.
SKY_ROW = Record("SKY_ROW", {"share": 1, "image": 1, "map": 1, "suns": 0})
# Maps' rows: a power of two, as many as the image's if all maps fit. Twice as many columns. All maps
# take 16 MiB at most, and places in them are numbers below 2^24, which single precision holds exactly.
FEWEST_ROWS, ENOUGH_ROWS, MOST_ROWS = 64, 128, 512
MAP_FLOATS_AT_MOST = 1 << 22
# Of so many normals each has a map of its own; of more, the nearest of 26 directions (those to a cube's
# faces, edges and corners), so that there are hardly more maps.
FEW_NORMALS = 32
# What maps are told apart by: how far cells' normals are from the direction of the map, at most:
# rounding, steps of two, and 2, the farthest that unit vectors are apart.
SPREADS = (2e-3, 0.25, 0.5, 1.0, 2.0)
# Parts of the square for the environment where there are lights, too: what is left for these is a power
# of two, or three quarters, so strips stay on a dyadic grid.
SHARES = (0.25, 0.5, 0.75, 0.875)
_ROWS = tuple(1 << k for k in range(FEWEST_ROWS.bit_length() - 1, MOST_ROWS.bit_length()))


def has_environment(scene: Scene) -> bool:
    """Whether light arrives from outside."""
    return scene.environment is not None and not scene.environment.is_black


def surroundings(scene: Scene) -> Environment:
    """The environment of a scene that has one."""
    if scene.environment is None:
        raise ValueError(f"{scene.name} has no environment")
    return scene.environment


def has_image(scene: Scene) -> bool:
    """Whether more arrives than from suns."""
    return scene.environment is not None and bool(np.any(scene.environment.radiance))


def row_numbers(scene: Scene) -> int:
    """What a row of strips has of the environment."""
    return SKY_ROW.size + len(surroundings(scene).suns) if has_environment(scene) else 0


def environment_defines(scene: Scene, maps: np.ndarray) -> dict[str, int]:
    """The `-D` constants of environment.cl, by the maps of `SkyRows`."""
    rows = rows_of(maps)
    return {
        "HAS_ENVIRONMENT": int(has_environment(scene)),
        "HAS_SKY_IMAGE": int(has_image(scene)),
        "SUN_COUNT": len(surroundings(scene).suns) if has_environment(scene) else 0,
        "SKY_NUMBERS": row_numbers(scene),
        "SKY_ROWS": rows,
        "SKY_COLUMNS": 2 * rows,
        **SKY.defines(),
        **SUN.defines(),
        **SKY_ROW.defines(),
    }


def rows_of(maps: np.ndarray) -> int:
    """Rows of maps (maps, floats)."""
    return next((rows for rows in _ROWS if _map_floats(rows) == maps.shape[1]), FEWEST_ROWS)


def _map_rows(environment: Environment, number: int) -> int:
    """Rows of so many maps of an environment's image."""
    wanted = max(environment.texels.shape[0], ENOUGH_ROWS)
    fitting = [rows for rows in _ROWS if number * _map_floats(rows) <= MAP_FLOATS_AT_MOST]
    return next((rows for rows in fitting if rows >= wanted), max(fitting, default=FEWEST_ROWS))


def _map_floats(rows: int) -> int:
    return (rows + 1) + rows * (2 * rows + 1)


@dataclass(frozen=True)
class SkyRows:
    """What the environment brings to cells of a scene.

    Attributes
    ----------
    brings : ndarray
        float64 (cells + 1, 1 + suns), irradiance without shadows of the image and of each sun, mean of
        the channels; the first row is of places that are in no cell.
    number : ndarray
        int64 (cells + 1,), the map of each.
    maps : ndarray
        float32 (maps, floats).
    """

    brings: np.ndarray
    number: np.ndarray
    maps: np.ndarray

    @property
    def lit(self) -> np.ndarray:
        """Which cells may see something of it, bool (cells,)."""
        return np.any(self.brings[1:] > 0, axis=1)

    def columns(self, parts: np.ndarray, from_lights: np.ndarray) -> np.ndarray:
        """Rows of `SKY_ROW`, float64 (cells + 1, floats), maps by their numbers.

        Parameters
        ----------
        parts : ndarray
            float64, of the shape of `brings`: how the environment's part of the square is dealt out.
        from_lights : ndarray
            float64 (cells + 1,), irradiance of all lights together, in the unit of `brings`.
        """
        total = self.brings.sum(axis=1)
        wanted = total / np.maximum(total + from_lights, 1e-300)
        nearest = np.array(SHARES)[np.abs(wanted[:, None] - SHARES).argmin(axis=1)]
        share = np.where(total > 0, np.where(from_lights > 0, nearest, 1.0), 0.0)[:, None]
        parts = share * parts
        return np.concatenate([share, parts[:, :1], self.number[:, None], parts[:, 1:]], axis=1)


def sky_rows(scene: Scene, cells: Cells) -> SkyRows:
    """What a scene's environment brings to its cells."""
    environment, count = surroundings(scene), len(cells.number)
    brings = np.zeros((count + 1, 1 + len(environment.suns)))
    number, maps = np.zeros(count + 1, np.int64), np.zeros((0, 0), np.float32)
    if has_image(scene):
        number[1:], maps, irradiance = _maps(environment, cells)
        brings[:, 0] = irradiance[number]
    for k, sun in enumerate(environment.suns):
        brings[:, 1 + k] = sun.irradiance.mean()
        brings[1:, 1 + k] *= _sun_cosines(sun.towards, sun.half_angle, cells)
    return SkyRows(brings, number, maps)


def sky_block(scene: Scene, maps: np.ndarray) -> np.ndarray:
    """What environment.cl reads at FRAME_SKY, float32 (floats,); the maps come right after the suns."""
    environment = surroundings(scene)
    suns = [
        SUN.pack(
            direction=sun.towards,
            chord=2 * np.sin(sun.half_angle / 2),
            radiance=sun.radiance,
            density=1 / sun.solid_angle,
        )
        for sun in environment.suns
    ]
    texels = environment.texels
    record = SKY.pack(
        axes=environment.axes.ravel(),
        width=texels.shape[1],
        height=texels.shape[0],
        texels=SKY.size + len(suns) * SUN.size + maps.size,
        # From any position: how far that is from the origin, and what is beyond.
        reach=1.01 * np.linalg.norm(np.abs(scene.bounds).max(axis=0)),
    )
    return np.concatenate([record, *suns, maps.ravel(), texels.ravel()]).astype(np.float32)


def maps_begin(scene: Scene) -> int:
    """Where the first map is in `sky_block`."""
    return SKY.size + len(surroundings(scene).suns) * SUN.size


def environment_seen(scene: Scene, directions: np.ndarray) -> np.ndarray | None:
    """As `Integrand.background`: what is seen of the environment."""
    return surroundings(scene).radiance_of(directions) if has_environment(scene) else None


def _sun_cosines(towards: np.ndarray, half_angle: float, cells: Cells) -> np.ndarray:
    """The mean cosine over a cell's normals; tiny where it is 0 but something may be lit: (cells,)."""
    mean = np.maximum(cells.normals @ towards, 0.0).mean(axis=1)
    highest = cells.middle @ towards + np.linalg.norm(cells.spread, axis=1)
    return np.where(highest > -np.sin(half_angle) - 1e-4, np.maximum(mean, 1e-3), 0.0)


def _maps(environment: Environment, cells: Cells) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Each cell's map, int64 (cells,), counted from 1; maps, of which 0 is that of all directions; and
    the irradiance of each one's surfaces, float64 (maps,)."""
    direction, own = _directions(cells.middle)
    spread = np.linalg.norm(cells.middle - direction[own], axis=1) + np.linalg.norm(cells.spread, axis=1)
    bucket = np.searchsorted(SPREADS[:-1], spread + 1e-4)
    kinds, chosen = np.unique(np.stack([own, bucket], axis=1), axis=0, return_inverse=True)
    rows = _map_rows(environment, 1 + len(kinds))
    grid = _grid(environment, rows)
    maps, irradiance = [_cumulative(grid.radiance, rows)], [np.pi * grid.radiance.mean()]
    for number, of_bucket in kinds:
        weight = grid.weight(direction[number], SPREADS[of_bucket])
        maps.append(_cumulative(grid.radiance * weight, rows))
        cosine = np.maximum(grid.towards @ direction[number], 0.0)
        found = 4 * np.pi * (grid.radiance * cosine).mean()
        some = (grid.radiance * weight).any()
        irradiance.append(max(found, 1e-3 * irradiance[0]) if some else 0.0)
    return 1 + chosen.ravel(), np.stack(maps), np.array(irradiance)


def _directions(middle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Directions that stand for cells' normals, and which of them each cell has."""
    normals = middle / np.maximum(np.linalg.norm(middle, axis=1, keepdims=True), 1e-30)
    own, number = np.unique(np.round(normals, 3), axis=0, return_inverse=True)
    if len(own) <= FEW_NORMALS:
        length = np.maximum(np.linalg.norm(own, axis=1, keepdims=True), 1e-30)
        return own / length, number.ravel()
    steps = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    steps = steps[np.any(steps != 0, axis=1)]
    steps = steps / np.linalg.norm(steps, axis=1, keepdims=True)
    return steps, (normals @ steps.T).argmax(axis=1)


@dataclass(frozen=True)
class _Grid:
    """Cells of a map: towards their middles (rows, columns, 3) and corners (4, rows, columns, 3), in the
    world; and the mean radiance, mean of the channels, (rows, columns)."""

    towards: np.ndarray
    corners: np.ndarray
    radiance: np.ndarray

    def weight(self, direction: np.ndarray, spread: float) -> np.ndarray:
        """What a cell counts for surfaces of normals no farther than `spread` from a direction."""
        cosine = self.towards @ direction + spread
        around = self.corners @ direction + spread
        most = np.maximum(cosine, around.max(axis=0))
        # Between the corners a cell may be higher, by no more than the middle is above them.
        most = most + np.abs(cosine - around.mean(axis=0))
        mean = (np.maximum(cosine, 0) + np.maximum(around, 0).sum(axis=0)) / 5
        return np.where(most > 0, np.maximum(mean, tuning.SKY_LEAST_WEIGHT * most), 0.0)


def _grid(environment: Environment, rows: int) -> _Grid:
    columns = 2 * rows
    height = 1 - 2 * np.arange(rows + 1) / rows
    azimuth = 2 * np.pi * np.arange(columns + 1) / columns
    middle = _towards(environment, (height[1:] + height[:-1]) / 2, (azimuth[1:] + azimuth[:-1]) / 2)
    ends = _towards(environment, height, azimuth)
    corners = np.stack([ends[:-1, :-1], ends[:-1, 1:], ends[1:, :-1], ends[1:, 1:]])
    found = _cell_means(environment.texels.mean(axis=2, dtype=np.float64), rows)
    some = found > 0
    floor = tuning.SKY_EQUAL_PART * found[some].mean()
    return _Grid(middle, corners, np.where(some, found + floor, 0.0))


def _towards(environment: Environment, height: np.ndarray, azimuth: np.ndarray) -> np.ndarray:
    """Directions of the world, (heights, azimuths, 3)."""
    radius = np.sqrt(np.maximum(1 - height**2, 0))[:, None]
    level = np.broadcast_to(height[:, None], (len(height), len(azimuth)))
    own = np.stack([radius * np.sin(azimuth), level, -radius * np.cos(azimuth)], axis=-1)
    return own @ environment.axes


def _cell_means(pixels: np.ndarray, rows: int) -> np.ndarray:
    """Means of an image (height, width) over the cells of a map, as it is interpolated: (rows, 2 rows).

    Pixels are made smaller than cells. Then means of the interpolation over each, 1/8, 3/4 and 1/8 of
    it and its neighbours; and of these over the cells, which lie across pixels.
    """
    pixels = _finer(pixels, 2 * rows, wraps=False)
    pixels = _finer(pixels.T, 4 * rows, wraps=True).T
    above, below = np.vstack([pixels[:1], pixels[:-1]]), np.vstack([pixels[1:], pixels[-1:]])
    pixels = 0.75 * pixels + 0.125 * (above + below)
    pixels = 0.75 * pixels + 0.125 * (np.roll(pixels, 1, axis=1) + np.roll(pixels, -1, axis=1))
    count, width = pixels.shape
    edges = 1 - np.cos(np.pi * np.arange(count + 1) / count)
    sums = np.vstack([np.zeros(width), np.cumsum(pixels * np.diff(edges)[:, None], axis=0)])
    sums = _interpolated(2 * np.arange(rows + 1) / rows, edges, sums)
    sums = np.hstack([np.zeros((rows + 1, 1)), np.cumsum(sums, axis=1)]).T
    at = np.arange(2 * rows + 1) * (width / (2 * rows))
    sums = _interpolated(at, np.arange(width + 1.0), sums)
    means = np.diff(np.diff(sums, axis=0), axis=1).T * (rows / 2) * (2 * rows / width)
    # Differences of sums: what is 0 may come out otherwise.
    return np.where(means > 1e-12 * means.max(), means, 0.0)


def _finer(pixels: np.ndarray, wanted: int, wraps: bool) -> np.ndarray:
    """Rows between those of an image, a whole number for each, until there are as many as wanted."""
    count = len(pixels)
    at = (np.arange(count * -(-wanted // count)) + 0.5) / -(-wanted // count) - 0.5
    if not wraps:
        at = np.clip(at, 0, count - 1)
    first = np.floor(at).astype(int)
    part = (at - first)[:, None]
    following = (first + 1) % count if wraps else np.minimum(first + 1, count - 1)
    return (1 - part) * pixels[first % count] + part * pixels[following]


def _interpolated(at: np.ndarray, places: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """`rows`, which are at `places`, between them: (at, columns)."""
    first = np.clip(np.searchsorted(places, at, side="right") - 1, 0, len(places) - 2)
    part = ((at - places[first]) / (places[first + 1] - places[first]))[:, None]
    return (1 - part) * rows[first] + part * rows[first + 1]


def _cumulative(weights: np.ndarray, rows: int) -> np.ndarray:
    """A map of weights (rows, columns), as environment.cl reads it: float32 (floats,)."""
    of_rows = weights.sum(axis=1)
    known = of_rows[:, None] > 0
    columns = np.where(known, weights / np.where(known, of_rows[:, None], 1.0), 1.0 / weights.shape[1])
    if not of_rows.any():
        of_rows = np.ones(rows)
    return np.concatenate([_sums(of_rows / of_rows.sum()), _sums(columns).ravel()]).astype(np.float32)


def _sums(parts: np.ndarray) -> np.ndarray:
    """Cumulative sums along the last axis, from 0 to 1."""
    sums = np.cumsum(parts, axis=-1)
    # The last before a tail of zeros is 1 as well, or rounding would leave something to the tail.
    sums = np.where(sums >= sums[..., -1:], 1.0, sums)
    return np.concatenate([np.zeros((*sums.shape[:-1], 1)), sums], axis=-1)
