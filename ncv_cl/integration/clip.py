"""The cells of one network by cutting polygons in double precision: slow, but it cannot fail.

`subdivide` uses this where rounding makes the arrangement of lines wrong. Polygons share no topology
(Sutherland and Hodgman 1974) that rounding could break: both parts of a cut have its two new corners, so
areas add up.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

# A line this close to leaving a polygon on one side, relative to its terms, does not cut it.
ROUNDING = 8 * np.finfo(np.float64).eps


@dataclass(frozen=True)
class Cell:
    """A convex polygon on which a network is affine.

    Attributes
    ----------
    corners : array (n, 2)
        Counter-clockwise.
    layers : int array (n,)
        For the side from each corner to the next the hidden layer whose line it lies on; 0: the border.
    affine : array (channels, 3)
        (a, b, c) of a u + b v + c.
    """

    corners: np.ndarray
    layers: np.ndarray
    affine: np.ndarray


def clipped_cells(
    weights: Sequence[np.ndarray], biases: Sequence[np.ndarray], negative_slope: float
) -> Iterator[Cell]:
    """All cells of a network; arrays as for `subdivide`, in double precision."""
    corners = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], float)
    lines = np.column_stack([weights[0], biases[0]]).astype(float)
    yield from _cells(Cell(corners, np.zeros(4, int), lines), weights, biases, negative_slope, 1)


def _cells(
    cell: Cell,
    weights: Sequence[np.ndarray],
    biases: Sequence[np.ndarray],
    slope: float,
    layer: int,
) -> Iterator[Cell]:
    """The cells inside one on which hidden layer `layer` is affine, its functions in `affine`."""
    if layer == len(weights):
        yield cell
        return
    pieces = [cell]
    for line in cell.affine:
        pieces = [part for piece in pieces for part in _cut(piece, line, layer)]
    for piece in pieces:
        mean = piece.corners.mean(0)
        values = piece.affine[:, :2] @ mean + piece.affine[:, 2]
        hidden = piece.affine * np.where(values < 0, slope, 1.0)[:, None]
        affine = weights[layer].astype(float) @ hidden
        affine[:, 2] += biases[layer]
        yield from _cells(Cell(piece.corners, piece.layers, affine), weights, biases, slope, layer + 1)


def _cut(cell: Cell, line: np.ndarray, layer: int) -> list[Cell]:
    """The parts of a cell above and below a line, or the cell itself."""
    side = cell.corners @ line[:2] + line[2]
    side[np.abs(side) <= ROUNDING * (cell.corners @ np.abs(line[:2]) + abs(line[2]))] = 0
    if (side >= 0).all() or (side <= 0).all():
        return [cell]
    return [_half(cell, sign * side, layer) for sign in (1, -1)]


def _half(cell: Cell, side: np.ndarray, layer: int) -> Cell:
    """The part of a cell where `side`, the line's values at its corners, is not negative."""
    corners, layers = [], []
    for i, (corner, value) in enumerate(zip(cell.corners, side, strict=True)):
        following, next_value = cell.corners[(i + 1) % len(side)], side[(i + 1) % len(side)]
        if value >= 0:
            corners.append(corner)
            # From a corner on the line to the other side, the polygon goes along the line.
            layers.append(layer if value == 0 and next_value < 0 else cell.layers[i])
        if value * next_value < 0:
            corners.append(_crossing(corner, value, following, next_value))
            layers.append(layer if value > 0 else cell.layers[i])
    return Cell(np.array(corners), np.array(layers), cell.affine)


def _crossing(start: np.ndarray, value: float, end: np.ndarray, next_value: float) -> np.ndarray:
    """Where a side crosses the line: the same bits from either end, reached from the nearer one."""
    if abs(value) > abs(next_value):
        start, value, end, next_value = end, next_value, start, value
    return start + value / (value - next_value) * (end - start)
