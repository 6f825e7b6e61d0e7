"""View factors of a furnace with a baffle, and what the closed forms say without it."""

from __future__ import annotations

import sys

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

import ncv_cl as ncv

NAMES = ["floor", "roof", "left", "right", "back", "front", "baffle", "-baffle"]


def wall(name: str, corner: tuple, edge1: tuple, edge2: tuple) -> ncv.TriangleMesh:
    """A rectangle whose front is on the side of edge1 × edge2."""
    corner, edge1, edge2 = (np.array(vector, float) for vector in (corner, edge1, edge2))
    corners = np.array([corner, corner + edge1, corner + edge1 + edge2, corner + edge2])
    return ncv.TriangleMesh(corners, np.array([[0, 1, 2], [0, 2, 3]]), "brick", name=name)


def furnace(*more: ncv.TriangleMesh) -> ncv.Scene:
    """2 m long, 1 m high and wide, its walls facing inwards."""
    walls = [
        wall("floor", (0, 0, 0), (0, 0, 1), (2, 0, 0)),
        wall("roof", (0, 1, 0), (2, 0, 0), (0, 0, 1)),
        wall("left", (0, 0, 0), (0, 1, 0), (0, 0, 1)),
        wall("right", (2, 0, 0), (0, 0, 1), (0, 1, 0)),
        wall("back", (0, 0, 0), (2, 0, 0), (0, 1, 0)),
        wall("front", (0, 0, 1), (0, 1, 0), (2, 0, 0)),
    ]
    camera = ncv.Camera((1, 0.5, 0.99), (1, 0.5, 0), 90)
    return ncv.build_scene(camera, {"brick": ncv.Material(0.5)}, [*walls, *more])


def draw(output: str) -> None:
    empty = ncv.view_factors(furnace(), NAMES[:6])
    baffle = wall("baffle", (1, 0, 0.2), (0, 0.7, 0), (0, 0, 0.6))
    found = ncv.view_factors(furnace(baffle), NAMES, points=512)
    print("from     to       with the baffle         without it")
    for i, j in ((0, 1), (0, 3), (2, 3), (4, 5), (6, 3)):
        without = f"{empty.values[i, j]:.6f}" if max(i, j) < 6 else "-"
        value = f"{found.values[i, j]:.6f} ± {found.standard_error[i, j]:.0e}"
        print(f"{NAMES[i]:<8} {NAMES[j]:<8} {value:<23} {without}")
    print("row sums, which should be 1:", found.row_sums.round(5))
    figure, axes = plt.subplots(figsize=(7, 6), constrained_layout=True)
    axes.imshow(found.values, cmap="YlOrRd", vmin=0, vmax=0.4)
    for (i, j), value in np.ndenumerate(found.values):
        axes.text(j, i, f"{value:.4f}", ha="center", va="center", fontsize=8)
    axes.set(xticks=range(8), yticks=range(8), xticklabels=NAMES, yticklabels=NAMES)
    axes.set(xlabel="to", ylabel="from", title="view factors with the baffle")
    figure.savefig(output, dpi=100)


if __name__ == "__main__":
    draw(sys.argv[1] if len(sys.argv) > 1 else "furnace.png")
