"""Where the camera sees nothing of the scene."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ..points.points import CAMERA, ShadingPoints, camera_record
from ..scene.load import Camera

# Directions that are made at a time.
PART = 1 << 18


def background_directions(
    camera: Camera, points: ShadingPoints, size: tuple[int, int], supersample: int
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Sub-pixels that hold no point, in parts: their numbers, and the camera's directions through them.

    Yields
    ------
    (ndarray, ndarray)
        int64 (n,), in row-major order on the supersampled grid, and float64 (n, 3), unit vectors.
    """
    width, height = size
    columns, rows = width * supersample, height * supersample
    empty = np.ones(columns * rows, bool)
    empty[points.cell] = False
    record = camera_record(camera, width, height).astype(np.float64)
    forward, right, up = (record[CAMERA[name]] for name in ("forward", "right", "up"))
    cells = np.flatnonzero(empty)
    for first in range(0, len(cells), PART):
        part = cells[first : first + PART]
        # As camera_direction in points.cl.
        x = (part % columns + 0.5) / columns * 2 - 1
        y = 1 - (part // columns + 0.5) / rows * 2
        towards = forward + x[:, None] * right + y[:, None] * up
        yield part, towards / np.linalg.norm(towards, axis=1, keepdims=True)
