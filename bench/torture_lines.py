"""Networks whose lines meet, coincide, or almost do: half of the torture of exact integration."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

Generator = np.random.Generator
Network = tuple[list[np.ndarray], list[np.ndarray]]

# (a, b, c) of the square's diagonals and sides: a u + b v + c = 0.
DIAGONALS_AND_SIDES = (1, -1, 0), (1, 1, -1), (1, 0, 0), (0, 1, 0), (1, 0, -1), (0, 1, -1)
GRID_DIRECTIONS = (1, 0), (0, 1), (1, 1), (1, -1), (2, 1), (1, -2)
GRID_SHARES = 0.35, 0.35, 0.1, 0.1, 0.05, 0.05


def he(rng: Generator, widths: Sequence[int]) -> Network:
    """He weights; the first layer's lines pass through random points of the square."""
    layers = list(itertools.pairwise(widths))
    weights = [rng.standard_normal((n, m)) * (2 / m) ** 0.5 for m, n in layers]
    biases = [rng.standard_normal(n) * 0.3 for _, n in layers]
    biases[0] = -(weights[0] * rng.uniform(0, 1, weights[0].shape)).sum(1)
    return weights, biases


def default_init(rng: Generator, widths: Sequence[int]) -> Network:
    """PyTorch's own initialisation."""
    layers = list(itertools.pairwise(widths))
    weights = [rng.uniform(-1, 1, (n, m)) / m**0.5 for m, n in layers]
    return weights, [rng.uniform(-1, 1, n) / m**0.5 for m, n in layers]


def _pass_through(network: Network, rows: object, point: np.ndarray) -> None:
    """Shift the first layer's lines of `rows` so that they pass through `point`."""
    weights, biases = network
    biases[0][rows] = -(weights[0][rows] @ point)


def _zero_inner_biases(network: Network) -> Network:
    """Behind a pencil of lines, zero biases lead all further layers' lines through its point."""
    for bias in network[1][1:-1]:
        bias[:] = 0
    return network


def signs(rng: Generator, count: int | None = None) -> np.ndarray:
    return rng.choice([-1, 1], count)


def _factor(rng: Generator) -> float:
    return rng.uniform(0.3, 2) * signs(rng)


def _border_point(rng: Generator) -> np.ndarray:
    t = rng.uniform(0.02, 0.98)
    return np.array([[t, 0], [t, 1], [0, t], [1, t]][rng.integers(4)])


# ---------------------------------------------------------------------------- lines that meet in points


def concurrent(rng: Generator, widths: Sequence[int]) -> Network:
    """The first layer's lines meet in a random point."""
    network = he(rng, widths)
    _pass_through(network, slice(None), rng.uniform(0.05, 0.95, 2))
    return network


def concurrent_dyadic(rng: Generator, widths: Sequence[int]) -> Network:
    """They meet in a point, without any rounding."""
    network = he(rng, widths)
    network[0][0] = np.round(network[0][0] * 64) / 64
    _pass_through(network, slice(None), rng.integers(1, 64, 2) / 64)
    return network


def concurrent_all(rng: Generator, widths: Sequence[int]) -> Network:
    """All hidden layers' lines meet in a random point."""
    return _zero_inner_biases(concurrent(rng, widths))


def concurrent_all_dyadic(rng: Generator, widths: Sequence[int]) -> Network:
    """All hidden layers' lines meet in a point, without any rounding in the first layer."""
    return _zero_inner_biases(concurrent_dyadic(rng, widths))


def pencils(rng: Generator, widths: Sequence[int]) -> Network:
    """The first layer's lines meet in two to four points."""
    network = he(rng, widths)
    count = rng.integers(2, 5)
    points = rng.uniform(0.02, 0.98, (count, 2))
    owner = rng.integers(0, count, widths[1])
    for k in range(count):
        _pass_through(network, owner == k, points[k])
    return network


def pencils_all(rng: Generator, widths: Sequence[int]) -> Network:
    """The first layer's lines meet in two to four points; inner biases are zero."""
    return _zero_inner_biases(pencils(rng, widths))


def border_pencil(rng: Generator, widths: Sequence[int]) -> Network:
    """The first layer's lines meet on a side of the square."""
    network = he(rng, widths)
    _pass_through(network, slice(None), _border_point(rng))
    return network


def border_pencil_all(rng: Generator, widths: Sequence[int]) -> Network:
    """All hidden layers' lines meet on a side of the square."""
    return _zero_inner_biases(border_pencil(rng, widths))


def border_pencils(rng: Generator, widths: Sequence[int]) -> Network:
    """The first layer's lines meet in two to four points on the sides."""
    network = he(rng, widths)
    count = rng.integers(2, 5)
    owner = rng.integers(0, count, widths[1])
    for k in range(count):
        _pass_through(network, owner == k, _border_point(rng))
    return network


def corner_pencil(rng: Generator, widths: Sequence[int]) -> Network:
    """The first layer's lines meet in a corner of the square, half the time all layers'."""
    network = he(rng, widths)
    _pass_through(network, slice(None), rng.integers(0, 2, 2).astype(float))
    return _zero_inner_biases(network) if rng.random() < 0.5 else network


def near_pencil(rng: Generator, widths: Sequence[int]) -> Network:
    """A pencil missed by 1e-9 to 1e-3."""
    network = concurrent(rng, widths)
    network[1][0] += 10.0 ** rng.uniform(-9, -3) * rng.standard_normal(widths[1])
    return _zero_inner_biases(network) if rng.random() < 0.5 else network


def near_border_pencil(rng: Generator, widths: Sequence[int]) -> Network:
    """A pencil on a side, which half of the lines miss by 1e-9 to 1e-3."""
    network = border_pencil(rng, widths)
    size = 10.0 ** rng.uniform(-9, -3)
    network[1][0] += size * rng.standard_normal(widths[1]) * rng.integers(0, 2, widths[1])
    return network


def fan(rng: Generator, widths: Sequence[int]) -> Network:
    """A regular star of lines through a point, mostly with zero inner biases."""
    network = he(rng, widths)
    angle = np.pi * np.arange(widths[1]) / widths[1] + rng.uniform(0, np.pi)
    network[0][0] = _directions(angle) * rng.uniform(0.5, 2, widths[1])[:, None]
    _pass_through(network, slice(None), rng.uniform(0.1, 0.9, 2))
    return _zero_inner_biases(network) if rng.random() < 0.7 else network


def tangents(rng: Generator, widths: Sequence[int]) -> Network:
    """Lines tangent to a circle: many meet almost, between them are thin faces."""
    weights, biases = he(rng, widths)
    angle = 2 * np.pi * rng.random(widths[1])
    radius, centre = 10.0 ** rng.uniform(-7, -0.5), rng.uniform(0.2, 0.8, 2)
    factor = rng.uniform(0.5, 2, widths[1])
    weights[0] = _directions(angle)
    biases[0] = (-(weights[0] @ centre) - radius) * factor
    weights[0] *= factor[:, None]
    return weights, biases


def _directions(angle: np.ndarray) -> np.ndarray:
    return np.stack([np.cos(angle), np.sin(angle)], 1)


# ------------------------------------------------------- lines at corners, on grids, beside each other


def corners(rng: Generator, widths: Sequence[int]) -> Network:
    """Lines through the square's corners; a fifth are diagonals and sides."""
    weights, biases = he(rng, widths)
    corner = rng.integers(0, 2, (widths[1], 2)).astype(float)
    biases[0] = -(weights[0] * corner).sum(1)
    for row in np.flatnonzero(rng.random(widths[1]) < 0.2):
        *normal, offset = DIAGONALS_AND_SIDES[rng.integers(6)]
        factor = _factor(rng)
        weights[0][row], biases[0][row] = np.array(normal) * factor, offset * factor
    return weights, biases


def near_corner(rng: Generator, widths: Sequence[int]) -> Network:
    """Lines that cut off 1e-9 to 1e-4 of a corner, or run that close beside a side."""
    weights, biases = he(rng, widths)
    count = widths[1]
    corner = rng.integers(0, 2, (count, 2)).astype(float)
    missed = 10.0 ** rng.uniform(-9, -4, count) * signs(rng, count)
    biases[0] = -(weights[0] * corner).sum(1) + missed
    for row in np.flatnonzero(rng.random(count) < 0.3):
        weights[0][row, rng.integers(2)] *= 10.0 ** rng.uniform(-9, -4)
        biases[0][row] = -(weights[0][row] @ corner[row])
    return weights, biases


def grid(rng: Generator, widths: Sequence[int]) -> Network:
    """Lines of few directions through a grid's points."""
    network = he(rng, widths)
    steps = rng.integers(2, 12)
    for row in range(widths[1]):
        direction = GRID_DIRECTIONS[rng.choice(6, p=GRID_SHARES)]
        point = rng.integers(0, steps + 1, 2) / steps
        network[0][0][row] = np.array(direction) * _factor(rng)
        _pass_through(network, row, point)
    return network


def grid_dyadic(rng: Generator, widths: Sequence[int]) -> Network:
    """Lines through a grid's points without any rounding, half the time with zero inner biases."""
    network = grid(rng, widths)
    for row in range(widths[1]):
        direction = GRID_DIRECTIONS[rng.integers(4)]
        point = rng.integers(0, 9, 2) / 8
        network[0][0][row] = np.array(direction) * (2.0 ** rng.integers(-1, 2) * signs(rng))
        _pass_through(network, row, point)
    return _zero_inner_biases(network) if rng.random() < 0.5 else network


def near_parallel(rng: Generator, widths: Sequence[int]) -> Network:
    """A pencil of almost parallel lines, whose point is in, on or out of the square."""
    network = he(rng, widths)
    count = widths[1]
    angle, spread = rng.uniform(0, np.pi), 10.0 ** rng.uniform(-8, -2)
    angles = angle + spread * rng.standard_normal(count)
    network[0][0] = _directions(angles) * (rng.uniform(0.3, 3, count) * signs(rng, count))[:, None]
    _pass_through(network, slice(None), rng.uniform(-0.5, 1.5, 2))
    return network


def near_parallel_two(rng: Generator, widths: Sequence[int]) -> Network:
    """Two such pencils, sometimes with zero inner biases."""
    network, other = near_parallel(rng, widths), near_parallel(rng, widths)
    chosen = rng.random(widths[1]) < 0.5
    for part, theirs in zip(network, other, strict=True):
        part[0][chosen] = theirs[0][chosen]
    return _zero_inner_biases(network) if rng.random() < 0.3 else network


def near_coincident(rng: Generator, widths: Sequence[int]) -> Network:
    """Lines no or a few ulps of float32 apart, and multiples of them."""
    weights, biases = he(rng, widths)
    lines = np.concatenate([weights[0], biases[0][:, None]], 1).astype(np.float32)
    different = rng.integers(1, 4)
    for row in range(different, widths[1]):
        line = lines[row % different].copy()
        for _ in range(rng.integers(0, 4)):
            k = rng.integers(3)
            line[k] = np.nextafter(line[k], np.float32(rng.choice([-9, 9])))
        lines[row] = line * np.float32(rng.choice([1, -1, 2, 3, -0.7]))
    weights[0], biases[0] = lines[:, :2].astype(float), lines[:, 2].astype(float)
    return weights, biases


def slivers(rng: Generator, widths: Sequence[int]) -> Network:
    """Lines 1e-8 to 1e-3 apart, at small angles."""
    weights, biases = he(rng, widths)
    line = np.concatenate([weights[0][0], biases[0][:1]])
    apart = 10.0 ** rng.uniform(-8, -3, (widths[1], 1)) * rng.standard_normal((widths[1], 3))
    weights[0], biases[0] = (line + apart)[:, :2], (line + apart)[:, 2]
    return weights, biases
