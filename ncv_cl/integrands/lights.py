"""What lights.cl reads of the area lights: their records, and each light's strip of the unit square."""

from __future__ import annotations

import numpy as np

from ..points import RELATIVE_OFFSET
from ..scene import QuadLight, Scene

LIGHT_FLOATS = 32
# Lights whose sides make less than this part of the distance to their middle (the root of the sum of
# squares) are sampled by area. Tried on the shipped scenes from 1/4 to 2: by less, samples of those
# where shadows are all of the error cost more than they gain.
SMALL_LIGHT = 1.0
# Cells of the dyadic grid that strips are made of, at least; and cells a light, at least.
FEWEST_CELLS = 16
CELLS_A_LIGHT = 4


def strip_widths(lights: tuple[QuadLight, ...]) -> np.ndarray:
    """Each light's share of the unit square's u axis, float64 (lights,), of sum 1.

    One half of the square is shared out by emitted power, the other alike: so no light has less than
    half of an equal share, however bright another is that may not even be seen. Lights without power
    have none. Strips consist of whole cells, a power of two of them, 16 for up to 4 lights: at least 4 a
    light, so that each has 2 or more when shares are rounded (by largest remainders). The first so many
    Sobol points are spread evenly over dyadic intervals, so strips that begin and end on such a grid get
    their share of points, and get them well spread; others do not. Float32 holds these numbers exactly.
    """
    power = np.array([light.area * np.mean(light.radiance) * (1 + light.two_sided) for light in lights])
    # Where all is dark it does not matter.
    power = power if power.any() else np.ones(len(lights))
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


def light_records(lights: tuple[QuadLight, ...]) -> np.ndarray:
    """What lights.cl reads of the lights, float32 (lights * LIGHT_FLOATS,)."""
    if not lights:
        return np.zeros(0, np.float32)
    widths = strip_widths(lights)
    firsts = np.cumsum(widths) - widths
    records = [
        _light_record(light, first, width)
        for light, first, width in zip(lights, firsts, widths, strict=True)
    ]
    return np.concatenate(records)


def light_defines(scene: Scene) -> dict[str, int]:
    """The `-D` constants of lights.cl."""
    return {"LIGHT_COUNT": len(scene.lights), "LIGHT_FLOATS": LIGHT_FLOATS}


def emitted_by_lights(scene: Scene, light: np.ndarray, outgoing: np.ndarray) -> np.ndarray:
    """As `Integrand.emitted`, for area lights."""
    radiance = np.array([one.radiance for one in scene.lights], np.float32)
    normals = np.array([one.normal for one in scene.lights], np.float32)
    two_sided = np.array([one.two_sided for one in scene.lights])
    front = np.einsum("pi,ip->p", normals[light], outgoing) > 0
    return radiance[light] * (front | two_sided[light])[:, None]


def _light_record(light: QuadLight, first: float, width: float) -> np.ndarray:
    edges = np.abs(np.asarray([light.edge1, light.edge2], np.float64)).sum(axis=0)
    centre = np.abs(light.corner + 0.5 * (np.asarray(light.edge1, np.float64) + light.edge2))
    # A light without a strip is never sampled; it still has a record, of finite numbers.
    amount = np.asarray(light.radiance, float) / (width or 1.0)
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
        *amount,
        first,
        width,
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
