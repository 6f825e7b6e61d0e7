"""How large arrangements of lines can become: exact bounds, known before anything is computed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass


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


def capacities(widths: Sequence[int], method: str) -> Capacities:
    """Bounds that hold for every arrangement of a network; `widths` as for `Integrator`."""
    layers = arrangement_layers(widths, method)
    corners = 4
    largest = Capacities.of(0, corners)
    for lines in layers:
        # A cell of the next arrangement has at most one side on each line so far.
        bound = Capacities.of(lines, corners)
        largest = Capacities(*map(max, zip(vars(largest).values(), vars(bound).values(), strict=True)))
        corners += lines
    return largest


def arrangement_layers(widths: Sequence[int], method: str) -> tuple[int, ...]:
    """Widths of the hidden layers whose lines are arranged."""
    hidden = tuple(widths[1:-1])
    return hidden if method == "full" else hidden[:-1]
