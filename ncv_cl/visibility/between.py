"""Whether something may lie between two patches."""

from __future__ import annotations

import numpy as np

from ..points.patches import Patch
from ..scene.load import Scene

# Pairs of pieces that are looked at; patches that have more may have something between them.
MOST_PAIRS = 4096
# What touches the space between, to so much of the coordinates, is not in it.
TOUCHING = 16 * 2.0**-24


def nothing_between(scene: Scene, first: Patch, second: Patch) -> bool:
    """Whether no triangle can block what is seen of one patch from the other; False: it is not known.

    A triangle is not in the space between two convex pieces if it is behind one of them, if both are on
    one side of it, or if their boxes do not meet. That finds all walls of a convex room.
    """
    if len(first.corner) * len(second.corner) > MOST_PAIRS:
        return False
    corners = scene.vertices[scene.triangles].astype(np.float64)
    slack = TOUCHING * np.abs(scene.bounds).max()
    lower, upper = corners.min(axis=1), corners.max(axis=1)
    planes = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    planes /= np.linalg.norm(planes, axis=1, keepdims=True)
    heights = (planes * corners[:, 0]).sum(axis=1)
    # Which triangles are not behind each piece.
    ahead = [
        [
            (corners - corner) @ normal > slack
            for corner, normal in zip(one.corner, one.normals, strict=True)
        ]
        for one in (first, second)
    ]
    for own, own_ahead in zip(first.piece_corners, ahead[0], strict=True):
        for other, other_ahead in zip(second.piece_corners, ahead[1], strict=True):
            both = np.concatenate([own, other])
            inside = own_ahead.any(axis=1) & other_ahead.any(axis=1)
            inside &= (lower < both.max(axis=0) - slack).all(axis=1)
            inside &= (upper > both.min(axis=0) + slack).all(axis=1)
            above = planes[inside] @ both.T - heights[inside, None]
            if ((above > slack).any(axis=1) & (above < -slack).any(axis=1)).any():
                return False
    return True
