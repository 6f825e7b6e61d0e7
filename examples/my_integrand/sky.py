"""An integrand of your own: the light of a sky that is brighter above than below.

As a script it renders one of the shipped scenes twice; on the command line the same is

    ncv-cl render scenes/knot.toml --integrand examples/my_integrand/sky.py:Sky -o sky.png
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

import ncv_cl as ncv

KNOT = Path(__file__).parents[2] / "scenes" / "knot.toml"


class Sky(ncv.Integrand):
    """Light of a sky without sun on Lambert surfaces.

    Parameters
    ----------
    above, below : (float, float, float)
        Linear RGB radiance straight up and straight down; in between it is mixed by height.
    up : (float, float, float)
        A unit vector.
    """

    name = "sky"
    files = ("sky.cl",)  # beside this file
    channels = 3
    inputs = ("position", "normal", "albedo")  # what the function of (u, v) depends on
    demodulated = True  # learn it over its mean without shadows

    def __init__(self, above=(0.5, 0.8, 1.6), below=(0.3, 0.25, 0.2), up=(0.0, 1.0, 0.0)):
        self.above, self.below, self.up = above, below, up

    def data(self, scene: ncv.Scene) -> np.ndarray:
        return np.array([*self.up, *self.below, *self.above], np.float32)


def main(folder: Path) -> None:
    for method in ("mc", "ncv"):
        image = ncv.render(KNOT, Sky(), method, spp=64, size=(128, 128))
        image.write(folder / f"sky_{method}.png")
        print(f"{method}: mean square error {image.stats['estimated_mse']:.2g}")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))
