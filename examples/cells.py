"""The method in one picture: a shadow f, a small ReLU network g fitted to it with its cells, and f - g.

g is fitted by Adam in numpy, so that nothing is hidden; renders do the same in kernels. Its integral is
the sum over the cells, in each of which it is affine; the printed line compares it with that of a grid.
"""

from __future__ import annotations

import argparse
import itertools

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

import ncv_cl as ncv

# Neurons of each of the two hidden layers, places along an axis that the fit sees, and steps.
WIDTH, GRID, STEPS = 16, 32, 3000
RATE, DECAYS, LEAST = 0.01, (0.9, 0.999), 1e-8

Layers = list[tuple[np.ndarray, np.ndarray]]


def shadow(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Light that falls off across the square, with the shadow of a disc in it."""
    return np.where(np.hypot(u - 0.6, v - 0.45) < 0.28, 0.0, 1 - 0.5 * u * v)


def fit(at: np.ndarray, wanted: np.ndarray, seed: int = 0) -> Layers:
    """Weights and biases of a network fitted to values (n,) at places (n, 2)."""
    rng = np.random.default_rng(seed)
    sizes = [2, WIDTH, WIDTH, 1]
    values = []
    for inputs, outputs in itertools.pairwise(sizes):
        values += [
            rng.normal(0, np.sqrt(2 / inputs), (outputs, inputs)),
            rng.uniform(-0.5, 0.5, outputs),
        ]
    means, squares = ([np.zeros_like(one) for one in values] for _ in range(2))
    for step in range(1, STEPS + 1):
        rate = RATE * 0.5 * (1 + np.cos(np.pi * step / STEPS))
        for value, mean, square, slope in zip(
            values, means, squares, gradients(values, at, wanted), strict=True
        ):
            mean += (1 - DECAYS[0]) * (slope - mean)
            square += (1 - DECAYS[1]) * (slope**2 - square)
            unbiased = mean / (1 - DECAYS[0] ** step), square / (1 - DECAYS[1] ** step)
            value -= rate * unbiased[0] / (np.sqrt(unbiased[1]) + LEAST)
    return list(zip(values[::2], values[1::2], strict=True))


def gradients(values: list[np.ndarray], at: np.ndarray, wanted: np.ndarray) -> list[np.ndarray]:
    """Of half the mean square error, by backpropagation."""
    kept = [at.T]
    for weights, biases in zip(values[:-2:2], values[1:-2:2], strict=True):
        kept.append(np.maximum(weights @ kept[-1] + biases[:, None], 0))
    slope = (values[-2] @ kept[-1] + values[-1][:, None] - wanted) / len(wanted)
    found = []
    for layer in range(len(kept) - 1, -1, -1):
        found += [slope.sum(axis=1), slope @ kept[layer].T]
        slope = (values[2 * layer].T @ slope) * (kept[layer] > 0)
    return found[::-1]


def evaluate(layers: Layers, at: np.ndarray) -> np.ndarray:
    """g at places (n, 2)."""
    hidden = at.T
    for weights, biases in layers[:-1]:
        hidden = np.maximum(weights @ hidden + biases[:, None], 0)
    return (layers[-1][0] @ hidden + layers[-1][1][:, None])[0]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", default="cells.png", metavar="FILE")
    options = parser.parse_args()
    middles = (np.arange(GRID) + 0.5) / GRID
    u, v = np.meshgrid(middles, middles)
    at = np.stack([u.ravel(), v.ravel()], axis=1)
    layers = fit(at, shadow(*at.T))
    weights, biases = ([layer[k] for layer in layers] for k in (0, 1))
    cells, whole = ncv.subdivide(weights, biases), ncv.integrate(weights, biases)[0, 0]
    fine = (np.arange(512) + 0.5) / 512
    places = np.stack([axis.ravel() for axis in np.meshgrid(fine, fine)], axis=1)
    f, g = shadow(*places.T).reshape(512, 512), evaluate(layers, places).reshape(512, 512)
    print(f"{len(cells.faces)} cells; exact integral {whole:.6f}, by a grid {g.mean():.6f}")
    print(f"variance of f {f.var():.4f}, of f - g {(f - g).var():.4f}")
    draw(f, g, cells, options.output)
    print(f"wrote {options.output}")


def draw(f: np.ndarray, g: np.ndarray, cells: ncv.Subdivision, path: str) -> None:
    """Three squares beside each other; edges of the first layer are thick."""
    figure, axes = plt.subplots(1, 3, figsize=(9, 3.3))
    common = {"origin": "lower", "extent": (0, 1, 0, 1), "cmap": "viridis"}
    for axis, image, title in zip(
        axes, (f, g, f - g), ("f", "g, affine in each cell", "f − g"), strict=True
    ):
        shown = axis.imshow(image, **common, vmin=-1 if title == "f − g" else 0, vmax=1)
        axis.set(title=title, xticks=[], yticks=[])
        figure.colorbar(shown, ax=axis, fraction=0.046, pad=0.03)
    ends = cells.vertices[cells.edges]
    for layer, width in ((1, 1.4), (2, 0.5)):
        for end in ends[cells.edge_layer == layer]:
            axes[1].plot(*end.T, color="white", linewidth=width)
    figure.tight_layout()
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    main()
