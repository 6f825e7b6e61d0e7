"""Groups of shading points that share their paths: points that lie close together and face alike."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from .points import ShadingPoints

# Bits of a position's place along an axis, by which points are sorted.
AXIS_BITS = 10
# Groups lie within so many points in a row, of which a part of an image can be drawn elsewhere.
BLOCK_POINTS = 1 << 12


@dataclass(frozen=True)
class Groups:
    """An order of points in which those that share paths follow each other.

    Attributes
    ----------
    order : ndarray
        uint32, the points.
    grouped : int
        The first so many of them are groups of `members` each; the others share nothing.
    members : int
    """

    order: np.ndarray
    grouped: int = 0
    members: int = 1


def group_points(
    points: ShadingPoints,
    members: int,
    window: int,
    apart: int = 1,
    pays: Callable[[ShadingPoints, np.ndarray], bool] | None = None,
) -> Groups:
    """Groups of `members` points each, that lie close together and face alike.

    Points are dealt to `window` groups in turn, along a curve through space, and then to the next so
    many. So neighbours, and what is averaged, such as the points of a pixel and several at one position,
    are in different groups, and their errors independent. Points that reflect no light are in none.
    Groups do not reach beyond a block of `BLOCK_POINTS` points: each block's are its own points' alone.

    Parameters
    ----------
    window : int
        Groups that points are dealt to in turn; more where more points lie at one position.
    apart : int
        Points of a pixel.
    pays : callable, optional
        Whether the groups of a block, integers (groups, members), share their paths; by default all do.
    """
    if members == 1:
        return Groups(np.arange(points.active, dtype=np.uint32))
    names = ("position", "normal", "albedo", "reflectance")
    rows = [points.active_rows(name) for name in names]
    groups: list[np.ndarray] = []
    rest: list[np.ndarray] = []
    for first in range(0, points.active, BLOCK_POINTS):
        of_block = [row[:, first : first + BLOCK_POINTS] for row in rows]
        grouped, others = (first + own for own in _block_groups(of_block, members, window, apart))
        if pays is not None and len(grouped) and not pays(points, grouped.reshape(-1, members)):
            grouped, others = grouped[:0], np.sort(np.concatenate([grouped, others]))
        groups.append(grouped)
        rest.append(others)
    order = np.concatenate([*groups, *rest, np.zeros(0, np.int64)]).astype(np.uint32)
    return Groups(order, sum(map(len, groups)), members)


def _block_groups(
    rows: list[np.ndarray], members: int, window: int, apart: int
) -> tuple[np.ndarray, np.ndarray]:
    """Groups of the points of a block, and its points that are in none; int64."""
    position, normal, albedo, reflectance = rows
    reflects = (albedo.sum(axis=0) > 0) | (reflectance.sum(axis=0) > 0)
    near = np.lexsort((*position, _curve(position), _facing(normal)))
    near = near[reflects[near]]
    apart = max(apart, _most_equal(position[:, near]))
    groups, first = [np.zeros(0, np.int64)], 0
    while first < len(near):
        number = min(max(window, apart), (len(near) - first) // members)
        if number < apart or number == 0:
            break
        last = first + number * members
        groups.append(near[first:last].reshape(members, number).T.ravel())
        first = last
    rest = np.sort(np.concatenate([near[first:], np.flatnonzero(~reflects)]))
    return np.concatenate(groups), rest


def _most_equal(position: np.ndarray) -> int:
    """How many of the positions (3, points), which are sorted, are equal at most."""
    begins = np.flatnonzero(np.any(np.diff(position, axis=1) != 0, axis=0)) + 1
    return int(np.diff(begins, prepend=0, append=position.shape[1]).max(initial=0))


def _facing(normal: np.ndarray) -> np.ndarray:
    """The axis and sign of the largest coordinate of normals (3, points), as 0 to 5."""
    axis = np.argmax(np.abs(normal), axis=0)
    return 2 * axis + (np.take_along_axis(normal, axis[None], axis=0)[0] > 0)


def _curve(position: np.ndarray) -> np.ndarray:
    """Places of positions (3, points) along Morton's curve through their bounds, int64."""
    lower = position.min(axis=1, keepdims=True, initial=np.inf)
    extent = np.max(position.max(axis=1, keepdims=True, initial=-np.inf) - lower, initial=1e-30)
    most = (1 << AXIS_BITS) - 1
    steps = np.minimum((position - lower) / extent * (most + 1), most).astype(np.int64)
    place = np.zeros(position.shape[1], np.int64)
    for bit in range(AXIS_BITS):
        for axis in range(3):
            place |= (steps[axis] >> bit & 1) << (3 * bit + axis)
    return place
