"""What a baked map costs: seconds of a texel and how far two bakes differ, by number of samples.

The floor of the Cornell box: ambient occlusion, direct light and global illumination, which ends at the
same map by `--method mc` and by `auto`. The error is the root of half the mean squared difference of two
bakes with different seeds, over the map's mean. Seconds are the processor time of the process.

    python bench/bench_bake.py [--quick] [--json FILE] [--size 128]
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import numpy as np
from training import SCENES

import ncv_cl as ncv
from ncv_cl.opencl.choose import choose_device

INTEGRANDS = ("ao", "direct", "gi")
SPPS, QUICK_SPPS = (16, 64, 256), (4,)
# The floor of scenes/cornell_box.toml.
WIDTH, DEPTH = 556.0, 559.2


def floor() -> ncv.UVMesh:
    """Two triangles over the whole map."""
    return ncv.UVMesh(
        vertices=np.array([[0, 0, 0], [0, 0, DEPTH], [WIDTH, 0, DEPTH], [WIDTH, 0, 0]], float),
        triangles=np.array([[0, 1, 2], [0, 2, 3]]),
        uv=np.array([[0, 0], [0, 1], [1, 1], [1, 0.0]]),
    )


def measure(scene: ncv.Scene, integrand: str, size: int, spp: int, method: str) -> dict[str, object]:
    """One row: least seconds of two bakes, and their difference."""
    maps, seconds = [], []
    for seed in (1, 2):
        began = time.process_time()
        image = ncv.bake(
            scene, floor(), size, integrand=integrand, spp=spp, seed=seed, method=method, samples=1
        )
        seconds.append(time.process_time() - began)
        maps.append(image.pixels.astype(float))
    error = float(np.sqrt(np.mean((maps[0] - maps[1]) ** 2) / 2) / np.mean(maps))
    return {
        "integrand": integrand,
        "method": method,
        "spp": spp,
        "processor_seconds": min(seconds),
        "texels_a_second": size**2 / min(seconds),
        "relative_error": error,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", type=int, default=128, help="texels a side (default %(default)s)")
    parser.add_argument("--quick", action="store_true", help="a small map, few samples")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the rows here")
    options = parser.parse_args()
    size, spps = (16, QUICK_SPPS) if options.quick else (options.size, SPPS)
    scene = ncv.load_scene(SCENES / "cornell_box.toml")
    rows = []
    for integrand in INTEGRANDS:
        for method in ("mc", "auto"):
            # The first bake compiles kernels.
            ncv.bake(scene, floor(), 8, integrand=integrand, spp=4, method=method, samples=1)
            for spp in spps:
                rows.append(measure(scene, integrand, size, spp, method))
                print(rows[-1], flush=True)
    if options.json:
        found = {"device": choose_device(None).identity, "size": size, "rows": rows}
        options.json.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
