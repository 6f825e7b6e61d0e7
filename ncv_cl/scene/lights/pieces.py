"""Triangles that emit, in pieces: pairs that make parallelograms, and groups of neighbours."""

from __future__ import annotations

import numpy as np


def parallelograms(corners: np.ndarray, material: np.ndarray) -> np.ndarray:
    """The triangle with which each makes a parallelogram, int64 (triangles,), or itself.

    Parameters
    ----------
    corners : ndarray
        float64 (triangles, 3, 3), single precision's numbers.
    material : ndarray
        (triangles,); only those of the same go together.
    """
    count = len(corners)
    _, place = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
    place = place.reshape(count, 3)
    ends = np.sort(np.stack([place[:, [1, 2]], place[:, [2, 0]], place[:, [0, 1]]], axis=1), axis=2)
    keys = (ends[..., 0] * (place.max() + 1) + ends[..., 1]).ravel()
    order = np.argsort(keys, kind="stable")
    same = keys[order][1:] == keys[order][:-1]
    first, second = order[:-1][same], order[1:][same]
    one, other = first // 3, second // 3
    # The corners beside a common edge lie opposite each other about its middle.
    sums = corners[one, first % 3] + corners[other, second % 3]
    of_edge = corners[one].sum(axis=1) - corners[one, first % 3]
    slack = 4 * np.finfo(np.float32).eps * np.abs(corners[one]).max(axis=(1, 2))
    fits = (np.abs(sums - of_edge).max(axis=1) <= slack) & (material[one] == material[other])
    partner = np.arange(count)
    # Along the longest edges first: of a square's grid these are its squares' diagonals.
    one, other, first = one[fits], other[fits], first[fits]
    a, b = corners[one, (first + 1) % 3], corners[one, (first + 2) % 3]
    for pair in np.argsort(-((a - b) ** 2).sum(axis=1), kind="stable"):
        k, m = one[pair], other[pair]
        if k != m and partner[k] == k and partner[m] == m:
            partner[k], partner[m] = m, k
    return partner


def pieces(
    corners: np.ndarray, partner: np.ndarray, kept: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Corner (pieces, 3) and edges (pieces, 2, 3) of `kept` triangles; whether they have partners.

    A triangle's lines go along its longest edge; a parallelogram's corner is the one off the diagonal.
    """
    own = corners[kept]
    opposite = np.linalg.norm(np.roll(own, -1, axis=1) - np.roll(own, -2, axis=1), axis=2)
    turn = opposite.argmax(axis=1)
    is_pair = partner[kept] != kept
    others = corners[partner[kept]]
    shared = (own[:, :, None] == others[:, None]).all(axis=3).any(axis=2)
    turn = np.where(is_pair, np.argmin(shared, axis=1), (turn + 2) % 3)
    around = (turn[:, None] + np.arange(3)) % 3
    own = np.take_along_axis(own, around[:, :, None], axis=1)
    edges = own[:, 1:] - own[:, :1]
    return own[:, 0], edges, is_pair


def clusters(middle: np.ndarray, power: np.ndarray, most: int) -> tuple[np.ndarray, np.ndarray]:
    """An order of lights, and the group of each in it, int64 (lights,), from 0.

    More than `most`, a power of two, are halved by power, along the longest extent, until there are as
    many groups.

    Parameters
    ----------
    middle, power : ndarray
        float64 (lights, 3) and (lights,).
    """
    groups = [np.arange(len(power))]
    if len(power) <= most:
        return groups[0], groups[0]
    power = np.maximum(power, 1e-30)
    while len(groups) < most:
        groups = [half for group in groups for half in _halves(group, middle[group], power[group])]
    groups = [group for group in groups if len(group)]
    return np.concatenate(groups), np.repeat(np.arange(len(groups)), [len(group) for group in groups])


def _halves(group: np.ndarray, middle: np.ndarray, power: np.ndarray) -> list[np.ndarray]:
    if len(group) < 2:
        return [group, group[:0]]
    axis = np.ptp(middle, axis=0).argmax()
    order = np.argsort(middle[:, axis], kind="stable")
    total = np.cumsum(power[order])
    cut = int(np.clip(np.searchsorted(total, total[-1] / 2) + 1, 1, len(group) - 1))
    return [group[order[:cut]], group[order[cut:]]]
