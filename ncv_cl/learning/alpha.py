"""The control coefficients α of the points: α g is subtracted from f in place of g."""

from __future__ import annotations

import math

import numpy as np

from ..network.fold import FoldedNetwork
from ..opencl.memory import HostArray
from ..opencl.program import build
from ..points.points import ShadingPoints
from . import tuning
from .train import TrainingSamples


def can_scale(folded: FoldedNetwork) -> bool:
    """Whether every point has an output layer of its own, which its coefficient can multiply."""
    return {"W3", "B3"} <= set(folded.network.description.modulated)


def control_coefficients(
    folded: FoldedNetwork, samples: TrainingSamples, points: ShadingPoints, columns: int
) -> np.ndarray:
    """α for every point and channel, float32 (channels, points.active).

    The variance of f − α g is least for α = Cov(f, g) / Var(g). Both are estimated from the training
    samples, since coefficients from the residual's own samples would bias it. They are pooled over tiles
    of the image, since a point has few training samples, or none.

    Parameters
    ----------
    folded : FoldedNetwork
    samples : TrainingSamples
    points : ShadingPoints
    columns : int
        Sub-pixels of a row of the image.
    """
    covariance, variance = _column_moments(folded, samples)
    cell = points.cell[: points.active].astype(np.int64)
    side = _tile_side(len(cell), samples.count * samples.samples)
    tiles_a_row = -(-columns // side)
    tile = cell // columns // side * tiles_a_row + cell % columns // side
    number = int(tile.max(initial=0)) + 1
    own_tile = tile[samples.order.read()]
    seen = np.bincount(own_tile, minlength=number) * float(samples.samples)
    found = np.empty((len(variance), len(cell)), np.float32)
    for channel, (product, square) in enumerate(zip(covariance, variance, strict=True)):
        products = np.bincount(own_tile, product, number)
        squares = np.bincount(own_tile, square, number)
        best = np.where(squares > 0, products / np.maximum(squares, 1e-30), 1.0)
        shrunk = 1.0 + (best - 1.0) * seen / (seen + tuning.PSEUDO_SAMPLES)
        bounded = np.minimum(shrunk, tuning.LARGEST_COEFFICIENT)
        found[channel] = np.where(shrunk < tuning.SMALLEST_COEFFICIENT, 0.0, bounded)[tile]
    return found


def scale(folded: FoldedNetwork, alpha: np.ndarray) -> None:
    """Multiply each point's g by its α; integration and inference skip points whose α is zero."""
    program = build(folded.device, ("common", "mlp", "alpha"), folded.network.description.defines())
    count = alpha.shape[1]
    groups = folded.groups
    program.kernel("scale_outputs")(
        count,
        count=count,
        alpha=HostArray.of(folded.device, alpha),
        w3=groups["W3"],
        b3=groups["B3"],
    )
    folded.device.queue.finish()


def _column_moments(folded: FoldedNetwork, samples: TrainingSamples) -> np.ndarray:
    """float64 (2, channels, columns): sums of (f − f̄)(g − ḡ) and of (g − ḡ)²."""
    device, description = folded.device, folded.network.description
    program = build(device, ("common", "mlp", "alpha"), description.defines())
    stride = samples.u.shape[1]
    moments = HostArray(device, (2, description.channels, stride), np.float32)
    program.kernel("column_moments")(
        samples.count,
        count=samples.count,
        stride=stride,
        samples=samples.samples,
        order=samples.order,
        all_u=samples.u,
        all_v=samples.v,
        all_targets=samples.target,
        **folded.arrays,
        moments=moments,
    )
    return moments.read()[..., : samples.count].astype(np.float64)


def _tile_side(points: int, samples: int) -> int:
    """Sub-pixels along a side of a tile that holds `tuning.SAMPLES_A_TILE` of `samples`."""
    return max(1, math.ceil(math.sqrt(tuning.SAMPLES_A_TILE * points / max(samples, 1))))
