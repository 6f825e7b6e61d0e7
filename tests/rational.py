"""Exact integrals of ReLU networks in rational arithmetic, and networks that are hard to integrate.

Nothing here is shared with the kernels: cells are cut one by one, last-layer neurons by clipping.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Iterator, Sequence

import numpy as np
from gmpy2 import mpq

Polygon = list[tuple[mpq, mpq]]
Affine = tuple[mpq, mpq, mpq]
Network = tuple[list[np.ndarray], list[np.ndarray]]

UNIT_SQUARE: Polygon = [(mpq(0), mpq(0)), (mpq(1), mpq(0)), (mpq(1), mpq(1)), (mpq(0), mpq(1))]


def exact_integral(
    weights: Sequence[np.ndarray], biases: Sequence[np.ndarray], negative_slope: float = 0.0
) -> tuple[list[mpq], list[mpq]]:
    """The integral of one network over the unit square, and what rounding is measured against.

    Returns
    -------
    G : list of mpq, one a channel
    scale : list of mpq, one a channel
        Sum over the last hidden layer of |w_j| times the integral of |activation(z_j)|, plus |b|.
    """
    matrices, offsets = (
        [(a.tobytes(), a.dtype.str, a.shape) for a in part] for part in (weights, biases)
    )
    return _exact_integral(tuple(matrices), tuple(offsets), negative_slope)


# Each network is integrated by both methods in both precisions; its exact value takes longest of all.
@functools.lru_cache(maxsize=256)
def _exact_integral(
    weights: tuple[tuple, ...], biases: tuple[tuple, ...], negative_slope: float
) -> tuple[list[mpq], list[mpq]]:
    """`exact_integral` of arrays as (bytes, dtype, shape), which can be looked up."""
    arrays = [[np.frombuffer(*a[:2]).reshape(a[2]) for a in part] for part in (weights, biases)]
    slope = mpq(negative_slope)
    matrices = [[[mpq(float(x)) for x in row] for row in w] for w in arrays[0]]
    offsets = [[mpq(float(x)) for x in b] for b in arrays[1]]
    first = [(row[0], row[1], c) for row, c in zip(matrices[0], offsets[0], strict=True)]
    if len(matrices) == 1:
        values = [_integral(UNIT_SQUARE, affine) for affine in first]
        # Here u and v take the place of the hidden neurons; each integrates to a half.
        return values, [(abs(a) + abs(b)) / 2 + abs(c) for a, b, c in first]
    width = len(offsets[-2])
    above = [mpq(0)] * width
    below = [mpq(0)] * width
    for polygon, lines in _cells(UNIT_SQUARE, first, matrices, offsets, slope, 1):
        for j, line in enumerate(lines):
            positive, negative = _clip(polygon, line)
            above[j] += _integral(positive, line)
            below[j] -= _integral(negative, line)
    results = []
    scales = []
    for row, b in zip(matrices[-1], offsets[-1], strict=True):
        results.append(b + sum(w * (p - slope * n) for w, p, n in zip(row, above, below, strict=True)))
        parts = zip(row, above, below, strict=True)
        scales.append(abs(b) + sum(abs(w) * (p + abs(slope) * n) for w, p, n in parts))
    return results, scales


def exact_cell_count(weights: Sequence[np.ndarray], biases: Sequence[np.ndarray]) -> int:
    """Into how many cells with area a network cuts the unit square."""
    matrices = [[[mpq(float(x)) for x in row] for row in w] for w in weights]
    offsets = [[mpq(float(x)) for x in b] for b in biases]
    first = [(row[0], row[1], c) for row, c in zip(matrices[0], offsets[0], strict=True)]
    # One layer more, so that the last hidden one is cut as well.
    more = [*matrices, [[mpq(0)] * len(offsets[-1])]]
    return sum(1 for _ in _cells(UNIT_SQUARE, first, more, [*offsets, [mpq(0)]], mpq(0), 1))


def relative_errors(
    values: np.ndarray, weights: Sequence[np.ndarray], biases: Sequence[np.ndarray], slope: float = 0.0
) -> np.ndarray:
    """|G - exact| / scale of one network's channels; 0 where both are 0."""
    exact, scales = exact_integral(weights, biases, slope)
    errors = []
    for value, truth, scale in zip(values, exact, scales, strict=True):
        error = abs(mpq(float(value)) - truth)
        errors.append(0.0 if error == 0 else np.inf if scale == 0 else float(error / scale))
    return np.array(errors)


def point_network(network: Network, point: int) -> Network:
    """The network of one point, without points axes."""
    weights, biases = network
    return (
        [w[point] if w.ndim == 3 else w for w in weights],
        [b[point] if b.ndim == 2 else b for b in biases],
    )


def _cells(
    polygon: Polygon,
    lines: list[Affine],
    matrices: list[list[list[mpq]]],
    offsets: list[list[mpq]],
    slope: mpq,
    layer: int,
) -> Iterator[tuple[Polygon, list[Affine]]]:
    """The cells of all hidden layers but the last, each with the last one's affine functions."""
    if layer == len(matrices) - 1:
        yield polygon, lines
        return
    pieces: list[tuple[Polygon, list[mpq]]] = [(polygon, [])]
    for line in lines:
        cut = []
        for piece, slopes in pieces:
            positive, negative = _clip(piece, line)
            cut += [(positive, [*slopes, mpq(1)])] if positive else []
            cut += [(negative, [*slopes, slope])] if negative else []
        pieces = cut
    for piece, slopes in pieces:
        following = [
            _combine([w * s for w, s in zip(row, slopes, strict=True)], lines, b)
            for row, b in zip(matrices[layer], offsets[layer], strict=True)
        ]
        yield from _cells(piece, following, matrices, offsets, slope, layer + 1)


def _combine(factors: list[mpq], lines: list[Affine], b: mpq) -> Affine:
    used = [(f, line) for f, line in zip(factors, lines, strict=True) if f != 0]
    a_u = sum((f * line[0] for f, line in used), mpq(0))
    a_v = sum((f * line[1] for f, line in used), mpq(0))
    return a_u, a_v, sum((f * line[2] for f, line in used), b)


def _clip(polygon: Polygon, line: Affine) -> tuple[Polygon, Polygon]:
    """The parts of a convex polygon where a u + b v + c is >= 0 and <= 0; empty if without area."""
    a, b, c = line
    values = [a * u + b * v + c for u, v in polygon]
    if all(value >= 0 for value in values):
        return polygon, []
    if all(value <= 0 for value in values):
        return [], polygon
    positive: Polygon = []
    negative: Polygon = []
    for k, (corner, value) in enumerate(zip(polygon, values, strict=True)):
        following, next_value = polygon[(k + 1) % len(polygon)], values[(k + 1) % len(polygon)]
        if value >= 0:
            positive.append(corner)
        if value <= 0:
            negative.append(corner)
        if value * next_value < 0:
            t = value / (value - next_value)
            crossing = tuple(p + t * (q - p) for p, q in zip(corner, following, strict=True))
            positive.append(crossing)
            negative.append(crossing)
    return positive, negative


def _integral(polygon: Polygon, affine: Affine) -> mpq:
    total = mpq(0)
    for (u1, v1), (u2, v2) in itertools.pairwise(polygon[1:]):
        u0, v0 = polygon[0]
        area = ((u1 - u0) * (v2 - v0) - (u2 - u0) * (v1 - v0)) / 2
        centre = affine[0] * (u0 + u1 + u2) / 3 + affine[1] * (v0 + v1 + v2) / 3 + affine[2]
        total += area * centre
    return total


# ---- networks --------------------------------------------------------------------------------------


def random_network(
    widths: Sequence[int], points: int | None = None, seed: int = 0, dtype: type = np.float32
) -> Network:
    """He weights; the first layer's lines pass through random points of the square."""
    rng = np.random.default_rng(seed)
    leading = () if points is None else (points,)
    weights, biases = [], []
    for k, (inputs, outputs) in enumerate(itertools.pairwise(widths)):
        w = rng.normal(size=(*leading, outputs, inputs)) * np.sqrt(2 / inputs)
        through = rng.uniform(0, 1, size=(*leading, outputs, inputs))
        b = -(w * through).sum(-1) if k == 0 else rng.normal(size=(*leading, outputs)) * 0.3
        weights.append(w.astype(dtype))
        biases.append(b.astype(dtype))
    return weights, biases


def trained_network(widths: Sequence[int], seed: int = 0, steps: int = 400) -> Network:
    """Fitted by Adam to a bright disk behind an occluding half-plane, as in direct light."""
    rng = np.random.default_rng(seed)
    weights, biases = (list(map(np.float64, part)) for part in random_network(widths, None, seed))
    parameters = [*weights, *biases]
    layers = len(weights)
    mean = [np.zeros_like(p) for p in parameters]
    square = [np.zeros_like(p) for p in parameters]
    for step in range(1, steps + 1):
        x = rng.uniform(size=(256, 2))
        inside = ((x - 0.5) ** 2).sum(-1) < 0.1
        target = np.where(inside & (x[:, 0] + 0.3 * x[:, 1] < 0.7), 1.0, 0.1)[:, None]
        hidden = [x]
        for k in range(layers):
            z = hidden[-1] @ parameters[k].T + parameters[layers + k]
            hidden.append(np.maximum(z, 0) if k < layers - 1 else z)
        delta = 2 * (hidden[-1] - target) / len(x)
        gradients = [np.zeros(0)] * len(parameters)
        for k in reversed(range(layers)):
            gradients[k] = delta.T @ hidden[k]
            gradients[layers + k] = delta.sum(0)
            delta = (delta @ parameters[k]) * (hidden[k] > 0)
        for p, g, m, s in zip(parameters, gradients, mean, square, strict=True):
            m += 0.1 * (g - m)
            s += 0.01 * (g * g - s)
            p -= 0.01 * (m / (1 - 0.9**step)) / (np.sqrt(s / (1 - 0.99**step)) + 1e-8)
    return [p.astype(np.float32) for p in weights], [p.astype(np.float32) for p in biases]


def _with_first_lines(
    widths: Sequence[int],
    lines: Callable[[np.random.Generator, int], np.ndarray],
    points: int,
    seed: int,
) -> Network:
    """Random networks whose first layer's rows (a, b, c) come from `lines`."""
    rng = np.random.default_rng(seed)
    weights, biases = random_network(widths, points, seed)
    for p in range(points):
        rows = lines(rng, widths[1]).astype(np.float32)
        weights[0][p] = rows[:, :2]
        biases[0][p] = rows[:, 2]
    return weights, biases


def _through(rng: np.random.Generator, count: int, u: float, v: float) -> np.ndarray:
    directions = rng.normal(size=(count, 2)).astype(np.float32)
    return np.column_stack([directions, -(directions @ np.array([u, v]))])


def _parallel(rng: np.random.Generator, count: int) -> np.ndarray:
    direction = rng.normal(size=2)
    offsets = -(direction @ rng.uniform(size=(2, count)))
    rows = np.column_stack([np.tile(direction, (count, 1)), offsets])
    rows[1::3] = rows[0::3][: len(rows[1::3])]
    rows[2::3] = -rows[0::3][: len(rows[2::3])]
    return rows


def _borders(rng: np.random.Generator, count: int) -> np.ndarray:
    special = [
        *((1, 0, 0), (0, 1, 0), (1, 0, -1), (0, 1, -1)),
        *((-1, 0, 0), (1, -1, 0), (1, 1, -1), (1, 2, 0), (-1, -2, 3), (3, -1, 0)),
    ]
    rows = np.array(special, float)[rng.permutation(len(special))]
    return np.resize(rows, (count, 3)) * rng.uniform(0.5, 2, size=(count, 1))


def _one_ulp_apart(rng: np.random.Generator, count: int) -> np.ndarray:
    row = _through(rng, 1, *rng.uniform(0.3, 0.7, 2))[0].astype(np.float32)
    rows = np.tile(row, (count, 1))
    for k in range(1, count):
        rows[k] = rows[k - 1]
        rows[k, k % 3] = np.nextafter(rows[k, k % 3], np.float32(np.inf))
    return rows


def _slivers(rng: np.random.Generator, count: int) -> np.ndarray:
    rows = np.tile(_through(rng, 1, *rng.uniform(0.3, 0.7, 2)), (count, 1))
    return rows + 10.0 ** rng.uniform(-7, -5, size=(count, 1)) * rng.normal(size=(count, 3))


def _scaled(network: Network, decades: float, seed: int) -> Network:
    """Neurons scaled by random powers of ten, undone by the next layer but for another random power."""
    rng = np.random.default_rng(seed)
    weights, biases = ([a.copy() for a in part] for part in network)
    for k in range(len(weights) - 1):
        factors = (10.0 ** rng.uniform(-decades, decades, size=biases[k].shape)).astype(np.float32)
        weights[k] *= factors[..., None]
        biases[k] *= factors
        weights[k + 1] /= factors[..., None, :]
    return weights, biases


def _dead(network: Network, layer: int) -> Network:
    network[1][layer][...] = -100
    network[0][layer][...] *= 0.01
    return network


def hard_networks(points: int = 3) -> dict[str, Network]:
    """The stress table: networks by name, with a points axis."""
    shape = (2, 8, 8, 2)
    deep = (2, 5, 5, 5, 1)

    def batch(networks: list[Network]) -> Network:
        return tuple(
            [np.stack(a) for a in zip(*part, strict=True)] for part in zip(*networks, strict=True)
        )

    def first(lines: Callable[[np.random.Generator, int], np.ndarray], seed: int) -> Network:
        return _with_first_lines((2, 9, 8, 2), lines, points, seed)

    zero_bias = random_network(shape, points, 5)
    for b in zero_bias[1][:-1]:
        b[...] = 0
    constant = random_network(shape, points, 6)
    for w in constant[0]:
        w[...] = 0
    denormal = random_network(shape, points, 7)
    denormal[0][0][:, ::2] *= np.float32(1e-41)
    denormal[1][0][:, ::2] *= np.float32(1e-41)
    tiny = random_network(shape, points, 8)
    for array in (*tiny[0], *tiny[1]):
        array *= np.float32(1e-30)
    huge = random_network(shape, points, 9)
    for k, factor in ((0, 1e30), (1, 1e15), (2, 1e-30)):
        huge[0][k] *= np.float32(factor)
    huge[1][0] *= np.float32(1e30)
    huge[1][1] *= np.float32(1e30)
    return {
        "trained 8x16": batch([trained_network((2, 8, 16, 1), s) for s in range(points)]),
        "trained 16x16": batch([trained_network((2, 16, 16, 3), s, 300) for s in range(points)]),
        "trained 12x8x8": batch([trained_network((2, 12, 8, 8, 1), s) for s in range(points)]),
        "random 16x16": random_network((2, 16, 16, 3), points, 1),
        "random 4 layers": random_network((2, 4, 4, 4, 4, 2), points, 2),
        "zero biases": zero_bias,
        "zero biases, deep": _zero_hidden_biases(random_network(deep, points, 3)),
        "through the centre": first(lambda rng, n: _through(rng, n, 0.5, 0.5), 10),
        "through one point": first(lambda rng, n: _through(rng, n, 0.3, 0.7), 11),
        "parallel and opposite": first(_parallel, 12),
        "borders and corners": first(_borders, 13),
        "one ulp apart": first(_one_ulp_apart, 14),
        "slivers": first(_slivers, 15),
        "scaled 1e4": _scaled(random_network(shape, points, 16), 4, 16),
        "scaled 1e15": _scaled(random_network(shape, points, 17), 15, 17),
        "scaled 1e15, deep": _scaled(random_network(deep, points, 18), 9, 18),
        "all weights 1e-30": tiny,
        "growing to 1e30": huge,
        "dead first layer": _dead(random_network(shape, points, 19), 0),
        "dead last layer": _dead(random_network(shape, points, 20), 1),
        "width 1": random_network((2, 1, 1, 1), points, 21),
        "width 1, deep": random_network((2, 1, 1, 1, 1, 1), points, 22),
        "constant": constant,
        "denormal lines": denormal,
        "no hidden layer": random_network((2, 3), points, 23),
        "one hidden layer": random_network((2, 20, 3), points, 24),
    }


def _zero_hidden_biases(network: Network) -> Network:
    for b in network[1][:-1]:
        b[...] = 0
    return network
