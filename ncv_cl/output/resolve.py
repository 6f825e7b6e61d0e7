"""From estimates at shading points to the pixels and layers of an image."""

from __future__ import annotations

import numpy as np

from ..integrands.emitted import emitted_light
from ..points.points import ShadingPoints, surface_window
from ..sampling.accumulate import Estimate
from ..scene.load import Scene
from ..settings.settings import Settings
from .background import background_directions
from .image import Image
from .pixel_grid import LARGE, PixelGrid

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
    emitted = emitted_light(scene, integrand, points)
    emits = emitted.any()
    beyond = _background(scene, settings, points)
    pixels, pixel_variance = (np.empty((grid.height, grid.width, 3), np.float32) for _ in range(2))
    for channel in range(3):
        # Of one channel all three are the same number.
        row = channel % len(mean)
        plane = grid.mean(mean[row], active)
        if emits:
            plane += grid.mean(emitted[:, channel], everything)
        if beyond is not None:
            plane += grid.mean_of_cells(beyond[1][:, channel], beyond[0])
        pixels[..., channel] = plane
        pixel_variance[..., channel] = grid.variance_of_mean(variance[row], active)
    del emitted, beyond
    surface, layers = points.surface, {}
    for layer, name in (("albedo", "albedo"), ("N", "normal")):
        with surface.mapped(window=surface_window(surface, name)) as rows:
            layers[layer] = grid.average(rows, everything)
    with surface.mapped(window=surface_window(surface, "position")) as position:
        layers["depth"] = _depth(scene, grid, position)
    if residual is not None and integral is not None:
        layers["G"] = grid.average(integral, active, 3)
        layers["residual"] = grid.average(residual.mean, active, 3)
    if direct is not None:
        layers["direct"] = grid.average(direct.mean, active, 3)
    return Image(pixels, pixel_variance, layers)


def _background(
    scene: Scene, settings: Settings, points: ShadingPoints
) -> tuple[np.ndarray, np.ndarray] | None:
    """Sub-pixels that show what is beyond the scene, and that, (n, 3); None where it is black."""
    if not points.background:
        return None
    cells, found = [], []
    supersample = settings.sampling.supersample
    for cell, towards in background_directions(scene.camera, points, settings.size, supersample):
        seen = settings.integrand.background(scene, towards)
        if seen is None:
            return None
        cells.append(cell)
        found.append(seen)
    return np.concatenate(cells), np.concatenate(found)


def _depth(scene: Scene, grid: PixelGrid, position: np.ndarray) -> np.ndarray:
    """Mean distance from the camera over a pixel's hits; 0 where nothing was hit."""
    camera = np.asarray(scene.camera.position, np.float32)[:, None]
    total = position.shape[1]
    distance = np.empty(total, np.float32)
    for first in range(0, total, LARGE):
        part = slice(first, first + LARGE)
        distance[part] = np.linalg.norm(position[:, part] - camera, axis=0)
    everything = slice(0, total)
    found = grid.plane(distance, everything)
    found /= np.maximum(grid.plane(None, everything), 1)
    return found.astype(grid.layer_type, copy=False)
