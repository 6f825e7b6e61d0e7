"""Groups of shading points that share their paths: points that lie close together and face alike."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .points import ShadingPoints
from .sampler import HostStream, host_generator

# Bits of a position's place along an axis, by which points are sorted.
AXIS_BITS = 10


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


def group_points(points: ShadingPoints, members: int, window: int, seed: int) -> Groups:
    """Groups of `members` points each, at random among those that lie close together and face alike.

    They are drawn from `window` groups' points, so that neighbours in an image rarely share a group, and
    their errors are independent. Points that reflect no light are in none.
    """
    active = points.active
    rows = {name: points.rows(name)[:, :active] for name in ("position", "normal", "albedo")}
    matte = rows["albedo"].sum(axis=0) > 0
    near = np.lexsort((_curve(rows["position"]), _facing(rows["normal"])))
    sorted_matte = near[matte[near]]
    grouped = len(sorted_matte) // members * members
    generator = host_generator(seed, HostStream.GROUPS)
    window *= members
    shuffled = [
        generator.permutation(sorted_matte[first : min(first + window, grouped)])
        for first in range(0, grouped, window)
    ]
    rest = np.concatenate([sorted_matte[grouped:], np.flatnonzero(~matte)])
    order = np.concatenate([*shuffled, np.sort(rest)]).astype(np.uint32)
    return Groups(order, grouped, members)


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
