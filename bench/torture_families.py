"""Families of networks that break exact integration: lines that meet, coincide or almost do, and numbers
that cancel or span many decades.

A family maps a generator and widths (2, hidden..., channels) to one network in float64. What rounding to
float32 does to a coincidence is part of the torture.
"""

from __future__ import annotations

import itertools
import zlib
from collections.abc import Callable, Sequence

import numpy as np
import torture_lines as lines
from torture_lines import Generator, Network, he, signs

Family = Callable[[Generator, Sequence[int]], Network]


def torture_networks(family: str, widths: Sequence[int], seed: int, count: int, dtype: type) -> Network:
    """The first `count` networks of a family, with a points axis.

    A network depends on family, widths, seed and its index alone, not on `count`; `dtype` rounds it.
    """
    name = zlib.crc32(family.encode())
    drawn = [
        FAMILIES[family](np.random.default_rng([seed, name, *widths, index]), widths)
        for index in range(count)
    ]
    weights, biases = zip(*drawn, strict=True)
    return (
        [np.stack(layer).astype(dtype) for layer in zip(*weights, strict=True)],
        [np.stack(layer).astype(dtype) for layer in zip(*biases, strict=True)],
    )


def bias_tiny(rng: Generator, widths: Sequence[int]) -> Network:
    """Biases of 1e-30 to 1e-4."""
    weights, biases = he(rng, widths)
    for k, bias in enumerate(biases):
        if k or rng.random() < 0.5:
            bias[:] = 10.0 ** rng.uniform(-30, -4, len(bias)) * signs(rng, len(bias))
    return weights, biases


def bias_huge(rng: Generator, widths: Sequence[int]) -> Network:
    """Some biases of one layer are 10 to 1e6 times too large."""
    weights, biases = he(rng, widths)
    bias = biases[rng.integers(0, len(biases))]
    chosen = rng.random(len(bias)) < 0.4
    bias[chosen] *= 10.0 ** rng.uniform(1, 6, chosen.sum())
    return weights, biases


def lines_far(rng: Generator, widths: Sequence[int]) -> Network:
    """Steep neurons: up to 1e5 times, their lines still through the square."""
    weights, biases = he(rng, widths)
    for weight, bias in zip(weights[:-1], biases[:-1], strict=True):
        factor = 10.0 ** rng.uniform(0, 5, len(bias))
        weight *= factor[:, None]
        bias *= factor
    return weights, biases


def decades4(rng: Generator, widths: Sequence[int]) -> Network:
    """Every number is scaled by 1e-4 to 1e4."""
    weights, biases = he(rng, widths)
    for array in (*weights, *biases):
        array *= 10.0 ** rng.uniform(-4, 4, array.shape)
    return weights, biases


def decades9(rng: Generator, widths: Sequence[int]) -> Network:
    """Neurons are scaled by 1e-9 to 1e9, which the next layer undoes."""
    weights, biases = he(rng, widths)
    previous = np.ones(2)
    for weight, bias in zip(weights, biases, strict=True):
        factor = 10.0 ** rng.uniform(-9, 9, len(bias))
        weight *= factor[:, None]
        weight /= previous
        bias *= factor
        previous = factor
    return weights, biases


def rescaled30(rng: Generator, widths: Sequence[int]) -> Network:
    """Hidden neurons are scaled by 1e-15 to 1e15, which the next layer undoes."""
    weights, biases = he(rng, widths)
    for k in range(len(weights) - 1):
        factor = 10.0 ** rng.uniform(-15, 15, len(biases[k]))
        weights[k] *= factor[:, None]
        biases[k] *= factor
        weights[k + 1] /= factor
    return weights, biases


def cancel_out(rng: Generator, widths: Sequence[int]) -> Network:
    """Pairs of almost equal neurons of the last hidden layer have opposite output weights."""
    weights, biases = he(rng, widths)
    *_, last, output = weights
    for i in range(0, len(last) - 1, 2):
        size = 10.0 ** rng.uniform(-7, -2)
        last[i + 1] = last[i] * (1 + size * rng.standard_normal(last[i].shape))
        biases[-2][i + 1] = biases[-2][i]
        output[:, i + 1] = -output[:, i]
    return weights, biases


def cancel_in(rng: Generator, widths: Sequence[int]) -> Network:
    """Hidden neurons in pairs whose contributions to the next layer cancel, large as they are."""
    weights, biases = he(rng, widths)
    for weight, bias, following in zip(weights[:-1], biases[:-1], weights[1:], strict=True):
        size = 10.0 ** rng.uniform(0, 3)
        for i in range(0, len(bias) - 1, 2):
            weight[i + 1] = weight[i] * (1 + 1e-3 * rng.standard_normal(weight[i].shape))
            bias[i + 1] = bias[i]
            following[:, i] *= size
            following[:, i + 1] = -following[:, i] * (1 + 1e-2 * rng.standard_normal(len(following)))
    return weights, biases


def duplicates(rng: Generator, widths: Sequence[int]) -> Network:
    """Neurons that are multiples of their neighbours, parallel to them, constant or without a bias."""
    weights, biases = he(rng, widths)
    for weight, bias in zip(weights[:-1], biases[:-1], strict=True):
        for i in range(1, len(bias)):
            kind = rng.random()
            if kind < 0.3:
                factor = rng.choice([1, -1, 2, -0.5])
                weight[i], bias[i] = weight[i - 1] * factor, bias[i - 1] * factor
            elif kind < 0.4:
                weight[i] = weight[i - 1]
            elif kind < 0.5:
                weight[i] = 0
            elif kind < 0.55:
                bias[i] = 0
    return weights, biases


def dead(rng: Generator, widths: Sequence[int]) -> Network:
    """Most neurons of one hidden layer are never active."""
    weights, biases = he(rng, widths)
    bias = biases[rng.integers(0, len(biases) - 1)]
    chosen = rng.random(len(bias)) < 0.7
    bias[chosen] = -rng.uniform(1, 50, chosen.sum())
    return weights, biases


def sparse(rng: Generator, widths: Sequence[int]) -> Network:
    """Six of ten weights are zero."""
    weights, biases = he(rng, widths)
    for weight in weights:
        weight *= rng.random(weight.shape) < 0.4
    return weights, biases


def integers(rng: Generator, widths: Sequence[int]) -> Network:
    """Small integers and halves: exact coincidences in every layer."""
    layers = list(itertools.pairwise(widths))
    weights = [rng.integers(-2, 3, (n, m)).astype(float) for m, n in layers]
    return weights, [rng.integers(-2, 3, n).astype(float) / 2 for _, n in layers]


def integers_mix(rng: Generator, widths: Sequence[int]) -> Network:
    """Offsets of thirds, fifths and sevenths: coincidences that no float represents."""
    layers = list(itertools.pairwise(widths))
    weights = [rng.integers(-3, 4, (n, m)).astype(float) for m, n in layers]
    return weights, [rng.integers(-3, 4, n) / rng.choice([3, 5, 7]) for _, n in layers]


# Lines first, then numbers.
FAMILIES: dict[str, Family] = {
    family.__name__: family
    for family in (
        *(he, lines.default_init, lines.concurrent, lines.concurrent_dyadic, lines.concurrent_all),
        *(lines.concurrent_all_dyadic, lines.pencils, lines.pencils_all, lines.border_pencil),
        *(lines.border_pencil_all, lines.border_pencils, lines.corner_pencil, lines.near_pencil),
        *(lines.near_border_pencil, lines.fan, lines.tangents, lines.corners, lines.near_corner),
        *(lines.grid, lines.grid_dyadic, lines.near_parallel, lines.near_parallel_two),
        *(lines.near_coincident, lines.slivers),
        *(bias_tiny, bias_huge, lines_far, decades4, decades9, rescaled30, cancel_out, cancel_in),
        *(duplicates, dead, sparse, integers, integers_mix),
    )
}
