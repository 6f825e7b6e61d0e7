"""What lights.cl reads of the area lights: their records, and each light's strip of the unit square."""

from __future__ import annotations

from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np

from ..opencl.layout import Record
from ..points.points import RELATIVE_OFFSET
from ..scene.load import Scene
from . import tuning
from .environment import (
    SKY_ROW,
    environment_defines,
    has_environment,
    maps_begin,
    row_numbers,
    sky_block,
    sky_rows,
)
from .light_cells import Cells, may_light, mean_irradiance, scene_cells
from .light_sources import BALL, DISC, PARALLELOGRAM, TRIANGLE, Lights, light_sources

# A light, in the scene's frame. `normal` is that of the emitting side and `offset` that of ray ends off
# the light's plane, for rays from the scene's origin; `along` is the unit vector along edge2, of that
# `length`, and `across` that across it in the plane, by which edge1 measures `width`; `slope` is edge1
# along edge2 over that; at less than the root of `large` from its middle the light is not small. `shape`
# is one of light_sources, `strip` the strip of the square that the light is in, and `part` where it
# begins and how wide it is in that. Of a ball `corner` is the centre, `length` the radius and `width`
# that of a sphere about all that stands for it; `along` is its beam's axis, and `across` holds the angle
# where the beam ends and one over the width of the range of angles in which it falls off.
LIGHT = Record(
    "LIGHT",
    {
        "corner": 3,
        "edge1": 3,
        "edge2": 3,
        "normal": 3,
        "radiance": 3,
        "two_sided": 1,
        "offset": 1,
        "area": 1,
        "along": 3,
        "across": 3,
        "length": 1,
        "width": 1,
        "slope": 1,
        "large": 1,
        "shape": 1,
        "strip": 1,
        "part": 2,
    },
    multiple=16,
)
# Between the records and the rows of strips: the grid of cells by its lower corner, one over the extent
# of its boxes and how many there are along each axis, and where behind the first row the table of cells
# and what environment.cl reads begin: single precision holds that exactly, and so it does where tables
# of clusters do.
FRAME = Record("FRAME", {"lower": 3, "inverse": 3, "counts": 3, "table": 1, "sky": 1}, multiple=16)
STRIP = Record("STRIP", {"first": 1, "width": 1})
# Of a strip of several lights: in how many steps a table deals it out, and where that begins behind the
# frame.
CLUSTER = Record("CLUSTER", {"steps": 1, "table": 1})
# Kernel files of lights.
LIGHT_FILES = ("light_shapes", "lights")
NO_MAPS = np.zeros((0, 0), np.float32)
# Steps of the dyadic grid that strips are made of, at least; and steps a light, at least.
FEWEST_STRIP_STEPS = 16
STEPS_A_LIGHT = 4
# Boxes along a scene's longest extent, the most for which rows and what finds them fit.
SIDES = (32, 16, 8, 4, 2, 1)
ROW_FLOATS_AT_MOST = 1 << 23
PAIRS_AT_MOST = 1 << 22


def strip_widths(brings: np.ndarray) -> np.ndarray:
    """Each light's share of the unit square's u axis, float64 of the shape of `brings`, of sum 1.

    Parameters
    ----------
    brings : ndarray
        float64 (..., lights): what each light brings, in any unit; 0 where it is certain that it brings
        nothing, and a tiny number where that is but likely.

    Notes
    -----
    `EQUAL_PART` of the square is shared out alike, the rest by what lights bring: so no light has less
    than that part of an equal share, however bright another is that may not even be seen. Lights that
    bring nothing have none. Strips consist of whole steps, a power of two of them, 16 for up to 4 lights
    and at least 4 a light, so that each has one or more when shares are rounded (by largest remainders).
    The first so many Sobol points are spread evenly over dyadic intervals, so strips that begin and end
    on such a grid get their share of points, and get them well spread; others do not. Float32 holds
    these numbers exactly.
    """
    # Where all is dark it does not matter, nor where float64 overflows, which is refused later.
    brings = np.nan_to_num(brings)
    brings = np.where((brings > 0).any(axis=-1, keepdims=True), brings, 1.0)
    shining = brings > 0
    count = np.count_nonzero(shining, axis=-1, keepdims=True)
    # By the largest first, or the sum might leave float64's range.
    relative = brings / brings.max(axis=-1, keepdims=True)
    relative /= relative.sum(axis=-1, keepdims=True)
    steps = _steps(count)
    share = steps * ((1.0 - tuning.EQUAL_PART) * relative + tuning.EQUAL_PART * shining / count)
    width = np.floor(share)
    rest = steps - width.sum(axis=-1, keepdims=True)
    order = np.argsort(width - share, axis=-1, kind="stable")
    more = np.arange(width.shape[-1]) < rest
    np.put_along_axis(width, order, np.take_along_axis(width, order, -1) + more, -1)
    return width / steps


@dataclass(frozen=True)
class LightRows:
    """How the unit square is dealt out to the lights, by cells of the scene.

    Attributes
    ----------
    widths : ndarray
        float64 (rows, strips), the strips' widths in each row; row 0 goes by power alone.
    table : ndarray
        int64 (cells.table_length,), the row of each cell; 0 where no light may light it, or nothing is.
    cells : Cells
    sky, maps : ndarray
        Of the environment: float64 (rows, SKY_ROW.size + suns), or none; and its maps.
    """

    widths: np.ndarray
    table: np.ndarray
    cells: Cells
    sky: np.ndarray
    maps: np.ndarray

    @property
    def strips(self) -> np.ndarray:
        """Where strips begin and how wide they are, float64 (rows, strips, STRIP.size)."""
        return np.stack([np.cumsum(self.widths, axis=1) - self.widths, self.widths], axis=2)


_ROWS: WeakKeyDictionary[Scene, LightRows] = WeakKeyDictionary()
_RECORDS: WeakKeyDictionary[Scene, np.ndarray] = WeakKeyDictionary()


def light_rows(scene: Scene) -> LightRows:
    """The rows of a scene that `has_rows`, made once."""
    if scene not in _ROWS:
        _ROWS[scene] = _light_rows(scene)
    return _ROWS[scene]


def _light_rows(scene: Scene) -> LightRows:
    lights = light_sources(scene).lights
    stand_ins = lights.stand_ins()
    most = min(ROW_FLOATS_AT_MOST // _row_floats(scene), PAIRS_AT_MOST // max(len(stand_ins.area), 1))
    cells = next(
        cells for side in SIDES if len((cells := scene_cells(scene, side)).number) <= most or side == 1
    )
    may, found, by_power = _of_lights(lights, stand_ins, cells)
    sky = sky_rows(scene, cells) if has_environment(scene) else None
    lit = np.any(may, axis=1) | (False if sky is None else sky.lit)
    may, brings = may[lit], found[lit]
    # Those that may light a cell but bring nothing to its places have their equal part.
    most = brings.max(axis=1, keepdims=True, where=may, initial=0.0)
    brings = np.where(may, np.maximum(brings, np.where(most > 0, 1e-30 * most, 1.0)), 0.0)
    rows = np.concatenate([by_power, strip_widths(brings) if lights.strips else brings])
    if sky is not None:
        # What lights bring is in units of the brightest one's radiance; places in no cell are unknown.
        unit = float(stand_ins.radiance.mean(axis=1).max(initial=0.0))
        unknown = sky.brings[0].sum() if lights.strips else 0.0
        from_lights = np.append(unknown, unit * found.sum(axis=1))
        columns = sky.columns(strip_widths(sky.brings), from_lights)
        rows = np.concatenate([rows, columns[np.append(True, lit)]], axis=1)
    distinct, row = np.unique(rows[1:], axis=0, return_inverse=True)
    table = np.zeros(cells.table_length, np.int64)
    table[cells.number[lit]] = row.ravel() + 1
    widths, columns = np.split(np.concatenate([rows[:1], distinct]), [lights.strips], axis=1)
    return LightRows(widths, table, cells, columns, NO_MAPS if sky is None else sky.maps)


def _of_lights(
    lights: Lights, stand_ins: Lights, cells: Cells
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Which strips' lights may light which cells, bool (cells, strips); what they bring there, as
    `mean_irradiance`; and the strips' widths by power alone, float64 (1, strips)."""
    shape = len(cells.number), lights.strips
    if not lights.strips:
        return np.zeros(shape, bool), np.zeros(shape), np.zeros((1, 0))
    power = lights.per_strip(lights.power)
    may = may_light(cells, lights.bounds()) & (power > 0)
    lit = np.any(may, axis=1)
    found = np.zeros(shape)
    found[lit] = stand_ins.per_strip(mean_irradiance(cells.only(lit), stand_ins))
    return may, np.where(may, found, 0.0), strip_widths(power)[None]


def light_records(scene: Scene) -> np.ndarray:
    """What lights.cl reads of the lights, float32 (floats,), made once.

    Their records; where it `has_rows` also the frame of the cells, rows of strips, each cell's row, and
    what environment.cl reads.
    """
    if scene not in _RECORDS:
        _RECORDS[scene] = _light_records(scene)
    return _RECORDS[scene]


def _light_records(scene: Scene) -> np.ndarray:
    lights = light_sources(scene).lights
    parts, clusters = _parts_of(lights)
    records = _records_of(lights, parts) if len(lights.strip) else np.zeros(0, np.float32)
    if not has_rows(scene):
        return records
    rows, count = light_rows(scene), lights.strips
    steps, outside = int(_steps(count)), has_environment(scene)
    # Which strip each step of the square belongs to.
    owner: np.ndarray = np.tile(np.arange(count), len(rows.widths)).repeat(
        (steps * rows.widths).ravel().astype(int)
    )
    owner = owner.reshape(-1, steps) if count else np.zeros((len(rows.widths), steps))
    strips = rows.strips.reshape(len(rows.widths), -1)
    table = _row_floats(scene) * len(rows.widths)
    after, sky = table + len(rows.table), rows.sky.copy()
    if outside:
        sky[:, SKY_ROW["map"]] = after + maps_begin(scene) + rows.maps.shape[1] * sky[:, SKY_ROW["map"]]
    frame = FRAME.pack(
        lower=rows.cells.lower,
        inverse=rows.cells.inverse,
        counts=rows.cells.counts,
        table=table,
        sky=after,
    )
    found = [records, frame, clusters, np.concatenate([owner, strips, sky], axis=1).ravel(), rows.table]
    found += [sky_block(scene, rows.maps)] if outside else []
    return np.concatenate([part.astype(np.float32) for part in found])


def has_rows(scene: Scene) -> bool:
    """Whether the square is dealt out differently over the scene."""
    return len(light_sources(scene).lights.strip) > 1 or has_environment(scene)


def light_defines(scene: Scene) -> dict[str, int]:
    """The `-D` constants of lights.cl."""
    lights = light_sources(scene).lights
    maps = light_rows(scene).maps if has_environment(scene) else NO_MAPS
    return {
        "LIGHT_COUNT": len(lights.strip),
        **LIGHT.defines(),
        **FRAME.defines(),
        **STRIP.defines(),
        **CLUSTER.defines(),
        "STRIP_COUNT": lights.strips,
        "STRIP_STEPS": int(_steps(lights.strips)),
        "HAS_ROWS": int(has_rows(scene)),
        **environment_defines(scene, maps),
        "HAS_CLUSTERS": int(lights.has_clusters),
        "ALL_CLUSTERS_FLOATS": _clusters_floats(lights),
        "HAS_SHAPES": int((lights.shape != PARALLELOGRAM).any()),
        "HAS_BALLS": int(lights.has_balls),
        "HAS_BRIGHT_SURFACES": int(len(lights.strip) > len(scene.lights)),
        "SHAPE_TRIANGLE": TRIANGLE,
        "SHAPE_DISC": DISC,
        "SHAPE_BALL": BALL,
    }


def narrowest_strip(scene: Scene) -> float:
    """The narrowest strip of the unit square; 1 without lights."""
    if not has_rows(scene):
        return 1.0
    rows = light_rows(scene)
    widths = rows.widths
    if has_environment(scene):
        share, image, _, suns = np.split(rows.sky, [1, 2, 3], axis=1)
        widths = np.concatenate([widths * (1 - share), image, suns], axis=1)
    return float(widths[widths > 0].min(initial=1.0))


def emitted_by_lights(scene: Scene, light: np.ndarray, outgoing: np.ndarray) -> np.ndarray:
    """As `Integrand.emitted`, for area lights."""
    if not len(light):
        return np.zeros((0, 3), np.float32)
    lights = light_sources(scene).lights
    front = np.einsum("pi,ip->p", lights.normal.astype(np.float32)[light], outgoing) > 0
    radiance = lights.radiance.astype(np.float32)
    return (
        radiance[light] * (lights.sent(light, outgoing.T) * (front | lights.two_sided[light]))[:, None]
    )


def _steps(count: np.ndarray | int) -> np.ndarray:
    """Steps of the grid of strips of so many lights."""
    needed = np.maximum(STEPS_A_LIGHT * np.asarray(count), FEWEST_STRIP_STEPS)
    return 1 << np.frexp(needed - 1.0)[1].astype(np.int64)


def _row_floats(scene: Scene) -> int:
    count = light_sources(scene).lights.strips
    return int(_steps(count)) + STRIP.size * count + row_numbers(scene)


def _clusters_floats(lights: Lights) -> int:
    """Floats of what lights.cl reads of clusters."""
    if not lights.has_clusters:
        return 0
    return lights.strips * CLUSTER.size + int(_steps(np.bincount(lights.strip)).sum())


def _parts_of(lights: Lights) -> tuple[np.ndarray, np.ndarray]:
    """Each light's part of its strip, float64 (lights, 2): where it begins and how wide it is.

    Then what lights.cl reads of clusters, float64, empty where there are none. A strip's lights share
    it as lights do the square where only their power is known.
    """
    parts = np.tile([0.0, 1.0], (len(lights.strip), 1))
    if not lights.has_clusters:
        return parts, np.zeros(0)
    begin = lights.strips * CLUSTER.size
    power, heads, tables = lights.power, [], []
    for strip in range(lights.strips):
        own = np.flatnonzero(lights.strip == strip)
        width, steps = strip_widths(power[own]), int(_steps(len(own)))
        parts[own] = np.stack([np.cumsum(width) - width, width], axis=1)
        heads.append(CLUSTER.pack(steps=steps, table=begin))
        tables.append(own.repeat((steps * width).astype(int)))
        begin += steps
    return parts, np.concatenate([*heads, *tables])


def _records_of(lights: Lights, parts: np.ndarray) -> np.ndarray:
    """float32 (lights * LIGHT.size,)."""
    edge1, edge2 = lights.edges.transpose(1, 0, 2)
    reach = np.abs(lights.edges).sum(axis=1)
    centre = np.abs(lights.corner + 0.5 * (edge1 + edge2))
    ball = lights.shape == BALL
    length = np.where(ball, np.sqrt(lights.area / np.pi), np.linalg.norm(edge2, axis=1))
    along = edge2 / length[:, None]
    vector_area = np.cross(edge1, edge2)
    size = np.linalg.norm(vector_area, axis=1, keepdims=True)
    across = np.cross(along, vector_area / np.where(size > 0, size, 1.0))
    width = (edge1 * across).sum(axis=1)
    offset = (np.abs(lights.normal) * (centre + reach)).sum(axis=1)
    beam = np.pad(lights.beam[:, 3:], ((0, 0), (0, 1)))
    records = LIGHT.pack(
        corner=lights.corner,
        edge1=edge1,
        edge2=edge2,
        normal=lights.normal,
        radiance=lights.radiance,
        two_sided=lights.two_sided,
        offset=RELATIVE_OFFSET * np.where(ball, centre.sum(axis=1) + lights.reach, offset),
        area=lights.area,
        along=np.where(ball[:, None], lights.beam[:, :3], along),
        across=np.where(ball[:, None], beam, across),
        length=length,
        width=np.where(ball, lights.reach, width),
        slope=(edge1 * along).sum(axis=1) / np.where(ball, 1.0, width),
        large=(lights.edges**2).sum(axis=(1, 2)) / tuning.SMALL_LIGHT**2,
        shape=lights.shape,
        strip=lights.strip,
        part=parts,
    )
    return records.ravel()
