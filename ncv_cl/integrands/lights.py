"""What lights.cl reads of the area lights: their records, and each light's strip of the unit square."""

from __future__ import annotations

import numpy as np

from ..points.points import RELATIVE_OFFSET
from ..scene.load import QuadLight, Scene

LIGHT_FLOATS = 32
# Lights whose sides make less than this part of the distance to their middle (the root of the sum of
# squares) are sampled by area. Tried on the shipped scenes from 1/4 to 2: by less, samples of those
# where shadows are all of the error cost more than they gain.
SMALL_LIGHT = 1.0
# Cells of the dyadic grid that strips are made of, at least; and cells a light, at least.
FEWEST_CELLS = 16
CELLS_A_LIGHT = 4
# Of more lights than so many all have strips at every point.
MOST_CHOSEN = 8


def strip_widths(power: np.ndarray) -> np.ndarray:
    """Each light's share of the unit square's u axis, by `power_of` each, float64 (lights,), of sum 1.

    One half of the square is shared out by emitted power, the other alike: so no light has less than
    half of an equal share, however bright another is that may not even be seen. Lights without power
    have none. Strips consist of whole cells, a power of two of them, 16 for up to 4 lights: at least 4 a
    light, so that each has 2 or more when shares are rounded (by largest remainders). The first so many
    Sobol points are spread evenly over dyadic intervals, so strips that begin and end on such a grid get
    their share of points, and get them well spread; others do not. Float32 holds these numbers exactly.
    """
    # Where all is dark it does not matter, nor where float64 overflows, which is refused later.
    power = np.nan_to_num(power) if power.any() else np.ones(len(power))
    shining = power > 0
    count = np.count_nonzero(shining)
    cells = max(FEWEST_CELLS, 1 << int(CELLS_A_LIGHT * count - 1).bit_length())
    # By the largest first, or the sum might leave float64's range.
    relative = power / power.max()
    share = 0.5 * cells * (relative / relative.sum() + shining / count)
    width = np.floor(share)
    rest = int(cells - width.sum())
    width[np.argsort(width - share, kind="stable")[:rest]] += 1
    return width / cells


def power_of(light: QuadLight) -> float:
    """What a light emits, mean of the channels, over pi."""
    return float(light.area * np.mean(light.radiance) * (1 + light.two_sided))


def strip_rows(lights: tuple[QuadLight, ...]) -> np.ndarray:
    """Where strips begin and how wide they are, float64 (rows, lights, 2).

    Of two to `MOST_CHOSEN` lights there is a row for every choice of them, light k chosen in those whose
    number has bit k: lights that cannot light a point take nothing of its square, and the others have
    strips as if they were alone, on the grid. The row of none is that of all; so is the only row of more
    lights.
    """
    count, rows = len(lights), _choices(len(lights))
    power = np.array([power_of(light) for light in lights])
    strips = np.zeros((rows, count, 2))
    for row in range(rows):
        chosen = [k for k in range(count) if rows == 1 or row == 0 or row >> k & 1]
        widths = strip_widths(power[chosen])
        strips[row, chosen] = np.stack([np.cumsum(widths) - widths, widths], axis=1)
    return strips


def light_records(lights: tuple[QuadLight, ...]) -> np.ndarray:
    """What lights.cl reads of the lights, float32 (floats,): their records, then `strip_rows`."""
    if not lights:
        return np.zeros(0, np.float32)
    rows = strip_rows(lights)
    records = [_light_record(light, strip) for light, strip in zip(lights, rows[-1], strict=True)]
    return np.concatenate([*records, rows.astype(np.float32).ravel()])


def light_defines(scene: Scene) -> dict[str, int]:
    """The `-D` constants of lights.cl."""
    count = len(scene.lights)
    return {"LIGHT_COUNT": count, "LIGHT_FLOATS": LIGHT_FLOATS, "STRIP_ROWS": _choices(count)}


def emitted_by_lights(scene: Scene, light: np.ndarray, outgoing: np.ndarray) -> np.ndarray:
    """As `Integrand.emitted`, for area lights."""
    radiance = np.array([one.radiance for one in scene.lights], np.float32)
    normals = np.array([one.normal for one in scene.lights], np.float32)
    two_sided = np.array([one.two_sided for one in scene.lights])
    front = np.einsum("pi,ip->p", normals[light], outgoing) > 0
    return radiance[light] * (front | two_sided[light])[:, None]


def narrowest_strip(scene: Scene) -> float:
    """The narrowest part of the unit square that one light has to itself; 1 without lights."""
    if not scene.lights:
        return 1.0
    widths = strip_rows(scene.lights)[..., 1]
    return float(widths[widths > 0].min(initial=1.0))


def _choices(lights: int) -> int:
    return 1 << lights if 2 <= lights <= MOST_CHOSEN else 1


def _light_record(light: QuadLight, strip: np.ndarray) -> np.ndarray:
    edges = np.abs(np.asarray([light.edge1, light.edge2], np.float64)).sum(axis=0)
    centre = np.abs(light.corner + 0.5 * (np.asarray(light.edge1, np.float64) + light.edge2))
    edge1, edge2 = (np.asarray(edge, np.float64) for edge in (light.edge1, light.edge2))
    length = np.linalg.norm(edge2)
    along = edge2 / length
    vector_area = np.cross(edge1, edge2)
    across = np.cross(along, vector_area / np.linalg.norm(vector_area))
    record = [
        *light.corner,
        *light.edge1,
        *light.edge2,
        *light.normal,
        *light.radiance,
        *strip,
        float(light.two_sided),
        RELATIVE_OFFSET * float(np.abs(light.normal) @ (centre + edges)),
        light.area,
        *along,
        *across,
        length,
        edge1 @ across,
        (edge1 @ along) / (edge1 @ across),
        (edge1 @ edge1 + edge2 @ edge2) / SMALL_LIGHT**2,
        0.0,
        0.0,
    ]
    return np.array(record, np.float32)
