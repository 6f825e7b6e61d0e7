"""The scenes of every feature as one sheet: textures, sky and sun, lights of all shapes, glass.

Where Mitsuba 3 is installed each picture that it can make is beside its own, of the same run and scene,
and a table says how far their means are apart, and with what standard error. Nothing else is needed.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

import ncv_cl as ncv

ROOT = Path(__file__).parent.parent
sys.path.append(str(ROOT / "bench"))
from compare_mitsuba import DIRECT, compare, show  # noqa: E402
from mitsuba_scene import MitsubaScene, import_mitsuba  # noqa: E402

SCENES = (
    ("textured_room", "gi", "textures, holes, vertex colours"),
    ("sky_room", "gi", "sky and sun through a window"),
    ("lit_mesh", "direct", "a mesh, a sphere and a spot that shine"),
    ("lit_mesh", "gi", "and what comes by way of surfaces"),
    ("glass", "gi", "smooth and rough glass, a pane, a conductor"),
)
# Renders of each, whose spread is the error of their mean.
BATCHES = 4
# Most edges of a path. Mitsuba counts panes, ours does not: so many that what is cut off does not count.
DEPTH = 24


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", default="gallery.png", metavar="FILE")
    parser.add_argument(
        "--size", type=int, default=160, metavar="N", help="columns (default %(default)s)"
    )
    parser.add_argument(
        "--spp", type=int, default=128, help="samples of a sub-pixel (default %(default)s)"
    )
    options = parser.parse_args()
    mitsuba = import_mitsuba()
    size = options.size, options.size * 3 // 4
    figure, axes = plt.subplots(2 if mitsuba else 1, len(SCENES), squeeze=False,
                                figsize=(3.2 * len(SCENES), 5.4 if mitsuba else 2.9))  # fmt: skip
    for column, (name, integrand, what) in zip(axes.T, SCENES, strict=True):
        scene = ncv.load_scene(ROOT / "scenes" / f"{name}.toml")
        ours = rendered(scene, integrand, size, options.spp)
        column[0].set_title(f"{name}, {integrand}\n{what}", fontsize=8)
        pictures = [ours.mean(axis=0)]
        try:
            theirs = MitsubaScene(mitsuba, scene) if mitsuba else None
        except NotImplementedError as error:
            print(f"{name}: not compared with Mitsuba: {error}")
            theirs = None
        if theirs is not None:
            paths = {"type": "path", "max_depth": DEPTH, "rr_depth": DEPTH}
            method = DIRECT if integrand == "direct" else paths
            seeds = range(BATCHES)
            found = np.stack([theirs.radiance(method, size, 2, options.spp, seed) for seed in seeds])
            show({"scene": name, "integrand": integrand, **compare(ours, found, options.spp)})
            pictures.append(found.mean(axis=0))
        for axis, picture in zip(column, pictures, strict=False):
            axis.imshow(np.clip(picture, 0, 1) ** (1 / 2.2))
        for axis in column:
            axis.set_axis_off()
    if mitsuba:
        figure.text(0.005, 0.67, "ncv_cl", rotation=90, fontsize=9)
        figure.text(0.005, 0.2, f"Mitsuba {mitsuba.__version__}", rotation=90, fontsize=9)
    figure.tight_layout(rect=(0.012, 0, 1, 1))
    figure.savefig(options.output, dpi=130)
    print(f"wrote {options.output}")


def rendered(scene: ncv.Scene, integrand: str, size: tuple[int, int], spp: int) -> np.ndarray:
    """Pictures of several seeds, float64 (batches, height, width, 3)."""
    own = ncv.DirectLight() if integrand == "direct" else ncv.GlobalIllumination(DEPTH)
    images = [
        ncv.render(scene, own, spp=spp, size=size, supersample=2, seed=seed) for seed in range(BATCHES)
    ]
    return np.stack([image.pixels.astype(np.float64) for image in images])


if __name__ == "__main__":
    main()
