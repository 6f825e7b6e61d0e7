"""What a network's shape says before anything is computed: bounds of its arrangements, layout of arrays.

Both become `-D` constants of the kernels; this is the only owner of those.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

# Vertices are padded to so many at least, whatever the vector width.
VERTEX_PADDING = 16
# Corners beyond the exact bound: rounding can make a polygon of the robust path slightly concave.
ROBUST_SPARE_CORNERS = 16


@dataclass(frozen=True)
class Capacities:
    """Exact bounds for one arrangement of `lines` lines in a convex cell of `corners` corners.

    Each line meets the border twice and every earlier line at most once; with m = 2 + (earlier lines)
    new vertices it adds 4 m - 4 half-edges (there are none outside the cell) and m - 1 faces.
    """

    corners: int
    vertices: int
    half_edges: int
    faces: int
    triangles: int

    @classmethod
    def of(cls, lines: int, corners: int) -> Capacities:
        return cls(
            corners,
            vertices=corners + 2 * lines + lines * (lines - 1) // 2,
            half_edges=corners + 2 * lines * (lines + 1),
            faces=1 + lines * (lines + 1) // 2,
            triangles=corners - 2 + lines * (lines + 1),
        )


def capacities(widths: Sequence[int], method: str) -> list[Capacities]:
    """Bounds of each arrangement of a network, one at least; `widths` as for `Integrator`."""
    bounds = []
    corners = 4
    for lines in arrangement_layers(widths, method) or (0,):
        bounds.append(Capacities.of(lines, corners))
        # A cell of the next arrangement has at most one side on each line so far.
        corners += lines
    return bounds


def arrangement_layers(widths: Sequence[int], method: str) -> tuple[int, ...]:
    """Widths of the hidden layers whose lines are arranged."""
    hidden = tuple(widths[1:-1])
    return hidden if method == "full" else hidden[:-1]


def shape_constants(widths: Sequence[int], method: str, vector: int) -> dict[str, int | str]:
    """The `-D` constants of the integration kernels that follow from the shape.

    Parameters
    ----------
    widths, method
        As for `Integrator`.
    vector : int
        Neurons that a work-group takes at a time: VEC * LANES. Arrays are padded to multiples of it.

    Returns
    -------
    dict
        Offsets and sizes of the parameters' tables, and capacities of the arrangements.
    """
    hidden = len(widths) - 2
    bounds = capacities(widths, method)

    def most(name: str) -> int:
        return max(getattr(bound, name) for bound in bounds)

    strides = [_round_up(width, vector) for width in widths[1:]]
    matrices = [inputs * stride for inputs, stride in zip(widths, strides, strict=False)]
    lines = strides[: max(1, hidden)]
    return {
        "HIDDEN": hidden,
        "ARRANGEMENTS": max(1, len(arrangement_layers(widths, method))),
        "WIDTHS": _list(widths),
        "STRIDES": _list(strides),
        "MATRIX_OFFSETS": _list(_offsets(matrices)),
        "MATRIX_NUMBERS": sum(matrices),
        "BIAS_OFFSETS": _list(_offsets(strides)),
        "BIAS_NUMBERS": sum(strides),
        "LINE_STRIDE": max(lines),
        "LINE_LAYERS": len(lines),
        "MOMENT_STRIDE": strides[max(0, hidden - 1)],
        "OUTPUT_STRIDE": strides[-1],
        "CORNER_BOUNDS": _list(bound.corners for bound in bounds),
        "MAX_VERTICES": _round_up(most("vertices"), max(vector, VERTEX_PADDING)),
        # The walk asks for room for four; at the border it needs three.
        "MAX_HALF_EDGES": most("half_edges") + 1,
        "MAX_FACES": most("faces"),
        "MAX_TRIANGLES": most("triangles"),
    }


def team_bytes(constants: dict[str, int | str], method: str, item_bytes: int) -> int:
    """About how many bytes integrate.cl keeps of one point: its Workspace and Tables.

    Parameters
    ----------
    constants : dict
        Of `shape_constants`.
    method : {"decoupled", "full"}
    item_bytes : int
        Of a number.
    """
    size = {name: value for name, value in constants.items() if isinstance(value, int)}
    vertices, lines = size["MAX_VERTICES"], size["LINE_STRIDE"]
    arrangement = 3 * item_bytes * vertices + 8 * size["MAX_HALF_EDGES"] + 2 * size["MAX_FACES"]
    numbers = 3 * lines * size["LINE_LAYERS"] + 2 * size["MATRIX_NUMBERS"] + 7 * size["BIAS_NUMBERS"]
    numbers += 2 * (size["MOMENT_STRIDE"] + size["OUTPUT_STRIDE"])
    if method == "full":
        last = 6 * item_bytes * size["MAX_FACES"]
    else:
        numbers += (1 + size["MOMENT_STRIDE"]) * vertices + 4 * lines
        # Three indices of two bytes, padded.
        last = (8 + item_bytes) * size["MAX_TRIANGLES"]
    # Arrays begin at multiples of 64 bytes: half of that each, of 18 beside arrangements' and lines'.
    padding = 32 * (18 + 3 * size["ARRANGEMENTS"] + 3 * size["LINE_LAYERS"])
    return size["ARRANGEMENTS"] * arrangement + item_bytes * numbers + 4 * lines + last + padding


def robust_shape_constants(widths: Sequence[int]) -> dict[str, int | str]:
    """The `-D` constants of the robust path that follow from the shape: nothing is padded there."""
    hidden = widths[1:-1]
    matrices = [inputs * outputs for inputs, outputs in itertools.pairwise(widths)]
    lines = sum(hidden[:-1])
    return {
        "ROBUST_WIDTH": max(hidden),
        "ROBUST_CORNERS": 4 + lines + ROBUST_SPARE_CORNERS,
        "ROBUST_POLYGONS": lines + 1,
        "ROBUST_MATRIX_NUMBERS": sum(matrices),
        "ROBUST_MATRIX_OFFSETS": _list(_offsets(matrices)),
        "ROBUST_BIAS_NUMBERS": sum(widths[1:]),
        "ROBUST_BIAS_OFFSETS": _list(_offsets(widths[1:])),
    }


def _round_up(count: int, multiple: int) -> int:
    return -(-count // multiple) * multiple


def _offsets(sizes: Sequence[int]) -> Iterable[int]:
    return itertools.accumulate(sizes[:-1], initial=0)


def _list(numbers: Iterable[int]) -> str:
    return ",".join(map(str, numbers))
