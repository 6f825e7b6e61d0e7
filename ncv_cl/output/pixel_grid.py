"""Shading points of sub-pixels become pixels, by a filter."""

from __future__ import annotations

import numpy as np

from ..points.points import ShadingPoints
from ..settings.filters import weights

# Points that are worked at together, and pixels whose layers are kept in double precision.
LARGE = 1 << 22


class PixelGrid:
    """The filter from sub-pixels to pixels.

    Parameters
    ----------
    points : ShadingPoints
    size : (int, int)
        Columns and rows of pixels.
    supersample : int
        Sub-pixels of a pixel along an axis.
    name : str
        Of `filters.RADIUS`.
    """

    def __init__(
        self, points: ShadingPoints, size: tuple[int, int], supersample: int, name: str = "box"
    ) -> None:
        self.width, self.height = size
        self.cells_a_pixel = supersample**2
        self._side = supersample
        self._cell = points.cell
        self._weights = None if name == "box" else weights(name, supersample)
        self.pixel = self.pixel_of(points.cell)

    def pixel_of(self, cell: np.ndarray) -> np.ndarray:
        """The pixels that sub-pixels lie in, by number."""
        columns = self.width * self._side
        row, column = cell // columns, cell % columns
        return (row // self._side) * self.width + column // self._side

    @property
    def layer_type(self) -> type:
        """Of layers' numbers: what files hold, where more would take much memory."""
        return np.float32 if self.width * self.height > LARGE else np.float64

    def plane(self, values: np.ndarray | None, points: slice) -> np.ndarray:
        """Sum of a channel (points,) in each pixel, or the number of points: float64 (height, width)."""
        return self._counted(values, self.pixel[points])

    def mean(self, values: np.ndarray, points: slice) -> np.ndarray:
        """One channel (points,), filtered: float64 (height, width). What is not there counts as zero."""
        if self._weights is None:
            return self.plane(values, points) / self.cells_a_pixel
        return self._filtered(self._weights, values, self._cell[points], 1)

    def variance_of_mean(self, values: np.ndarray, points: slice) -> np.ndarray:
        """Variance of `mean`, of the variances of points whose errors are independent.

        Those of neighbouring pixels are not independent where a filter is wider than a pixel.
        """
        if self._weights is None:
            # Variances add with the square of the weight.
            return self.plane(values, points) / self.cells_a_pixel / self.cells_a_pixel
        return self._filtered(self._weights, values, self._cell[points], 2)

    def mean_of_cells(self, values: np.ndarray, cells: np.ndarray) -> np.ndarray:
        """As `mean`, of values of sub-pixels that hold no point."""
        if self._weights is None:
            return self._counted(values, self.pixel_of(cells)) / self.cells_a_pixel
        return self._filtered(self._weights, values, cells, 1)

    def average(self, values: np.ndarray, points: slice, channels: int | None = None) -> np.ndarray:
        """`mean` of channels (channels, points): `layer_type` (height, width, channels).

        A single channel is repeated, if more are asked for.
        """
        shape = (self.height, self.width, channels or len(values))
        found: np.ndarray = np.empty(shape, self.layer_type)
        for channel, row in enumerate(values):
            wanted = slice(None) if len(values) == 1 else slice(channel, channel + 1)
            found[..., wanted] = self.mean(row, points)[..., None]
        return found

    def _counted(self, values: np.ndarray | None, pixel: np.ndarray) -> np.ndarray:
        found = np.bincount(pixel, values, self.width * self.height)
        return found.reshape(self.height, self.width).astype(np.float64, copy=False)

    def _filtered(
        self, weights: np.ndarray, values: np.ndarray, cells: np.ndarray, power: int
    ) -> np.ndarray:
        """Sums with weights to some power, over those of what lies in the picture."""
        rows, columns = self.height * self._side, self.width * self._side
        plane = np.zeros(rows * columns)
        plane[cells] = values
        along = self._along(weights, plane.reshape(rows, columns).T, power)
        return self._along(weights, along.T, power)

    def _along(self, weights: np.ndarray, plane: np.ndarray, power: int) -> np.ndarray:
        """Sub-pixels (n, m) filtered along the first axis, (n / side, m)."""
        reach = (len(weights) - self._side) // 2
        padded = np.zeros((len(plane) + 2 * reach, plane.shape[1]))
        padded[reach : reach + len(plane)] = plane
        inside = np.zeros((len(padded), 1))
        inside[reach : reach + len(plane)] = 1.0
        last = len(plane) - self._side + 1
        total = sum(w**power * padded[i : i + last : self._side] for i, w in enumerate(weights))
        share = sum(w * inside[i : i + last : self._side] for i, w in enumerate(weights))
        return total / share**power
