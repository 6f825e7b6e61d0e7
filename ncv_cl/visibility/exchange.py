"""What two convex polygons see of each other with nothing between them."""

from __future__ import annotations

import numpy as np

# Nodes of the integral along an edge, by substitution with tanh(sinh) (Takahasi and Mori 1974): 1e-14 of
# the whole, logarithmic singularities at the ends included.
_STEP, _REACH = 1.0 / 16, 3.4
# Parts of polygons narrower than this part of their size are none.
_SLIVER = 1e-12


def _nodes() -> tuple[np.ndarray, np.ndarray]:
    """Places in (0, 1) and weights."""
    t = np.arange(-_REACH, _REACH + _STEP / 2, _STEP)
    inner = 0.5 * np.pi * np.sinh(t)
    weight = 0.25 * np.pi * np.cosh(t) / np.cosh(inner) ** 2
    return 1.0 / (1.0 + np.exp(-2 * inner)), weight / weight.sum()


NODES, WEIGHTS = _nodes()


def exchange_area(first: np.ndarray, second: np.ndarray) -> float:
    """∫∫ cos cos / (π r²) dA dA over two convex polygons that see each other's fronts.

    1 / 2π ∮ ∮ ln r dx · dy around both (Sparrow 1963), where what is behind either's plane is cut off
    first. The inner integral along an edge is known, the outer one is by quadrature.

    Parameters
    ----------
    first, second : ndarray
        float64 (corners, 3), counter-clockwise as seen from the front.
    """
    first, second = _in_front(first, second), _in_front(second, first)
    if len(first) < 3 or len(second) < 3:
        return 0.0
    # In units of the whole, so that no logarithm is large.
    both = np.concatenate([first, second])
    unit = float(np.ptp(both, axis=0).max())
    first, second = ((one - both[0]) / unit for one in (first, second))
    total = sum(_around(corner, edge, second) for corner, edge in zip(first, _edges(first), strict=True))
    return max(total / (2 * np.pi), 0.0) * unit**2


def _around(corner: np.ndarray, edge: np.ndarray, other: np.ndarray) -> float:
    """∫ ∮ ln r dx · dy over an edge from a corner, and around the other polygon."""
    across = _edges(other)
    length = np.linalg.norm(across, axis=1)
    direction = across / length[:, None]
    # The logarithm is singular where the edge meets the other polygon's corners or edges.
    breaks = np.unique(np.clip(np.append(_nearest(corner, edge, other, direction), [0.0, 1.0]), 0, 1))
    widths = np.diff(breaks)[:, None]
    at, weight = (breaks[:-1, None] + widths * NODES).ravel(), (widths * WEIGHTS).ravel()
    apart = (corner + at[:, None] * edge)[:, None] - other
    foot = (apart * direction).sum(axis=-1)
    height = np.linalg.norm(np.cross(apart, direction), axis=-1)
    inner = _logarithms(length - foot, height) - _logarithms(-foot, height)
    return float(weight @ inner @ (direction @ edge))


def _nearest(
    corner: np.ndarray, edge: np.ndarray, other: np.ndarray, direction: np.ndarray
) -> np.ndarray:
    """Where an edge is nearest to each corner and each line of the other polygon, in its length."""
    apart, squared = other - corner, edge @ edge
    to_corners = apart @ edge / squared
    # Of the lines: without what lies along them.
    across = edge - (direction @ edge)[:, None] * direction
    beside = apart - (apart * direction).sum(axis=1)[:, None] * direction
    size = (across**2).sum(axis=1)
    crosses = size > 1e-12 * squared
    to_lines = (beside * across).sum(axis=1)[crosses] / size[crosses]
    return np.append(to_corners, to_lines)


def _logarithms(at: np.ndarray, height: np.ndarray) -> np.ndarray:
    """∫ ln √(t² + h²) dt from 0 to `at`."""
    squared = at**2 + height**2
    logarithm = 0.5 * np.log(np.where(squared > 0, squared, 1.0))
    return at * (logarithm - 1.0) + height * np.arctan2(at, height)


def _edges(corners: np.ndarray) -> np.ndarray:
    return np.roll(corners, -1, axis=0) - corners


def _in_front(corners: np.ndarray, of: np.ndarray) -> np.ndarray:
    """What of a convex polygon is on the front side of another's plane, float64 (corners, 3)."""
    normal = np.cross(of, np.roll(of, -1, axis=0)).sum(axis=0)
    heights = (corners - of[0]) @ (normal / np.linalg.norm(normal))
    heights[np.abs(heights) <= _SLIVER * np.abs(corners - of[0]).max()] = 0.0
    if heights.max() <= 0:
        return corners[:0]
    kept = []
    for k, (corner, height) in enumerate(zip(corners, heights, strict=True)):
        before, earlier = heights[k - 1], corners[k - 1]
        if height * before < 0:
            kept.append(earlier + (corner - earlier) * (before / (before - height)))
        if height >= 0:
            kept.append(corner)
    return np.array(kept)
