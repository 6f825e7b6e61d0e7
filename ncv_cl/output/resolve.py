"""From estimates at shading points to the pixels and layers of an image."""

from __future__ import annotations

import numpy as np

from ..integrands.emitted import emitted_light
from ..points.background import background_directions
from ..points.points import ShadingPoints
from ..sampling.accumulate import Estimate
from ..scene.load import Scene
from ..settings.filters import weights
from ..settings.settings import Settings
from .image import Image

# Below this weight the training samples' estimate is left out, since it would change nothing visible.
SMALLEST_SHARE = 0.01


def estimate_of(
    plain: Estimate, residual: Estimate | None, integral: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """Each point's estimate and its variance, float64 (channels, points).

    With a network the estimate is G + <f - g>, where g is already scaled by its control coefficient:
    unbiased for every network.
    """
    if residual is None or integral is None:
        return plain.mean, plain.variance_of_mean
    return integral + residual.mean, residual.variance_of_mean


def with_direct(
    mean: np.ndarray, variance: np.ndarray, direct: Estimate | None
) -> tuple[np.ndarray, np.ndarray]:
    """The two with direct light added, if that is estimated apart: its samples are independent."""
    if direct is None:
        return mean, variance
    return mean + direct.mean, variance + direct.variance_of_mean


def combine(
    mean: np.ndarray,
    variance: np.ndarray,
    training: Estimate | None,
    samples: float,
    by_count: bool = False,
) -> tuple[np.ndarray, np.ndarray]:
    """Average the training samples' estimate with the one of `mean` and `variance`.

    Parameters
    ----------
    samples : float
        Samples a point behind `mean`, as they were asked for.
    by_count : bool
        Weigh the two by their numbers of samples, as on the slides' last page, m / (m + n) <MC> + n / (m
        + n) (G + <f - g>), which is unbiased. The same is done where no `variance` is known (NaN). Else
        the weights are the inverse mean square errors over the image; the training samples' error is
        estimated from their difference to the other estimate. This is one weight for the whole image:
        consistent, with a bias of order one over the number of points.
    """
    if training is None:
        return mean, variance
    sampled = training.samples > 0
    compared = sampled & np.isfinite(variance).all(axis=0)
    error = own = np.nan
    if compared.any():
        error = float(np.mean(variance[:, compared]))
        difference = float(np.mean((training.mean - mean)[:, compared] ** 2))
        own = max(difference - error, 0.0)
    if by_count or not compared.any():
        share = training.samples / (training.samples + samples)
    else:
        weight = error / (own + error) if own > 0 else 0.0
        share = np.where(sampled, weight if weight >= SMALLEST_SHARE else 0.0, 0.0)
    training_variance = _variance_as_seen(training, compared, own)
    return (
        share * training.mean + (1 - share) * mean,
        np.where(share > 0, share**2 * training_variance, 0.0) + (1 - share) ** 2 * variance,
    )


def _variance_as_seen(training: Estimate, compared: np.ndarray, error: float) -> np.ndarray:
    """Variances of the training samples' means, scaled to this error of the `compared` points.

    The samples are stratified, so their error is the measured one and not that of independent samples. A
    point with a single sample, which has no variance, gets the mean square error itself.
    """
    spread = training.variance / np.maximum(training.samples, 1)
    expected = spread[:, compared & training.known]
    ratio = error / float(np.mean(expected)) if expected.any() else 0.0
    return np.where(training.known, ratio * spread, error)


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
        columns = self.width * supersample
        row, column = points.cell // columns, points.cell % columns
        self.pixel = (row // supersample) * self.width + column // supersample
        self.cells_a_pixel = supersample**2
        self._side = supersample
        self._cell = points.cell
        self._weights = None if name == "box" else weights(name, supersample)

    def sum(self, values: np.ndarray, points: slice) -> np.ndarray:
        """Sum (channels, points) over each pixel's points: float64 (height, width, channels)."""
        pixel, pixels = self.pixel[points], self.width * self.height
        planes = [np.bincount(pixel, weights=row, minlength=pixels) for row in values]
        return np.stack(planes, axis=-1).reshape(self.height, self.width, -1)

    def average(self, values: np.ndarray, points: slice) -> np.ndarray:
        """As `sum`, filtered: what is not there counts as zero."""
        if self._weights is None:
            return self.sum(values, points) / self.cells_a_pixel
        return self._filtered(values, points, 1)

    def variance(self, values: np.ndarray, points: slice) -> np.ndarray:
        """Variances of averages of points whose errors are independent, as `average` takes them.

        Those of neighbouring pixels are not independent where a filter is wider than a pixel.
        """
        if self._weights is None:
            return self.average(values, points) / self.cells_a_pixel
        return self._filtered(values, points, 2)

    def _filtered(self, values: np.ndarray, points: slice, power: int) -> np.ndarray:
        """Sums with weights to some power, over those of what lies in the picture."""
        rows, columns = self.height * self._side, self.width * self._side
        planes = []
        for row in values:
            plane = np.zeros(rows * columns)
            plane[self._cell[points]] = row
            along = self._along(plane.reshape(rows, columns).T, power)
            planes.append(self._along(along.T, power))
        return np.stack(planes, axis=-1)

    def _along(self, plane: np.ndarray, power: int) -> np.ndarray:
        """Sub-pixels (n, m) filtered along the first axis, (n / side, m)."""
        reach = (len(self._weights) - self._side) // 2
        padded = np.zeros((len(plane) + 2 * reach, plane.shape[1]))
        padded[reach : reach + len(plane)] = plane
        inside = np.zeros((len(padded), 1))
        inside[reach : reach + len(plane)] = 1.0
        last = len(plane) - self._side + 1
        total = sum(w**power * padded[i : i + last : self._side] for i, w in enumerate(self._weights))
        share = sum(w * inside[i : i + last : self._side] for i, w in enumerate(self._weights))
        return total / share**power


def resolve_image(
    scene: Scene,
    settings: Settings,
    points: ShadingPoints,
    plain: Estimate,
    training: Estimate | None = None,
    residual: Estimate | None = None,
    integral: np.ndarray | None = None,
    by_count: bool = False,
    direct: Estimate | None = None,
) -> Image:
    """The image of the estimates, with its layers.

    Parameters
    ----------
    plain, training, residual : Estimate
        Of f from the render's own samples, of f from the training samples, of f − g.
    integral : ndarray, optional
        float (channels, points.active), G of each active point.
    by_count : bool
        As `combine` takes it.
    direct : Estimate, optional
        Of direct light that the other estimates leave out.
    """
    integrand, samples = settings.integrand, float(settings.spp)
    sampling = settings.sampling
    grid = PixelGrid(points, settings.size, sampling.supersample, sampling.filter)
    active, everything = slice(0, points.active), slice(0, points.total)
    own = combine(*estimate_of(plain, residual, integral), training, samples, by_count)
    mean, variance = with_direct(*own, direct)
    pixels = grid.average(mean, active) + np.zeros(3)
    # Errors of a pixel's points are independent: variances add with the square of the weight.
    pixel_variance = grid.variance(variance, active) + np.zeros(3)

    emitted = emitted_light(scene, integrand, points)
    if emitted.any():
        pixels += grid.average(emitted.T, everything)
    _add_background(pixels, scene, settings, points)

    layers = {
        "albedo": grid.average(points.rows("albedo"), everything),
        "N": grid.average(points.rows("normal"), everything),
        "depth": _depth(scene, grid, points),
    }
    if residual is not None and integral is not None:
        layers["G"] = grid.average(integral, active) + np.zeros(3)
        layers["residual"] = grid.average(residual.mean, active) + np.zeros(3)
    if direct is not None:
        layers["direct"] = grid.average(direct.mean, active) + np.zeros(3)
    return Image(pixels, pixel_variance, layers)


def _add_background(pixels: np.ndarray, scene: Scene, settings: Settings, points: ShadingPoints) -> None:
    """Add what is seen beyond the scene to pixels, float64 (height, width, 3)."""
    if not points.background:
        return
    supersample, flat = settings.sampling.supersample, pixels.reshape(-1, 3)
    width = settings.size[0]
    columns = width * supersample
    parts = background_directions(scene.camera, points, settings.size, supersample)
    for cell, towards in parts:
        seen = settings.integrand.background(scene, towards)
        if seen is None:
            return
        pixel = cell // columns // supersample * width + cell % columns // supersample
        np.add.at(flat, pixel, seen / supersample**2)


def _depth(scene: Scene, grid: PixelGrid, points: ShadingPoints) -> np.ndarray:
    """Mean distance from the camera over a pixel's hits; 0 where nothing was hit."""
    offset = points.rows("position") - np.asarray(scene.camera.position, np.float32)[:, None]
    everything = slice(0, points.total)
    distances = grid.sum(np.linalg.norm(offset, axis=0)[None], everything)
    hits = grid.sum(np.ones((1, points.total)), everything)
    return (distances / np.maximum(hits, 1))[..., 0]
