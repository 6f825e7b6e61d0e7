"""What smooth edges cost: points a pixel and filters, at as many samples a pixel.

For each scene, `supersample` k with spp / k² samples a point, and each filter: processor seconds, the
root mean square error against a picture of 12 × 12 points a pixel by the same filter, and how much of it
is noise, by the picture's own variance. Errors are those of display values, (x / (1 + x))^(1 / 2.2), so
that no lamp counts for more than its edge shows.

    python bench/bench_filters.py [--size 64 48] [--spp 64] [--quick] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import numpy as np

import ncv_cl as ncv

SCENES = Path(__file__).parent.parent / "scenes"
CASES = [("occluders", "direct"), ("knot", "ao"), ("cornell_box", "gi")]
SIDES = (1, 2, 4)
FILTERS = ("box", "tent", "blackman-harris")
FINE, FINE_SPP = 12, 16
REPEATS = 3


def shown(pixels: np.ndarray) -> np.ndarray:
    """Display values of radiance."""
    positive = np.maximum(pixels, 0.0)
    return (positive / (1.0 + positive)) ** (1 / 2.2)


def noise(image: ncv.Image) -> float:
    """Root mean square of display values' standard deviations."""
    pixels, step = np.maximum(image.pixels, 0.0), 1e-4
    slope = (shown(pixels + step) - shown(pixels)) / step
    return float(np.sqrt(np.mean(slope**2 * image.variance)))


def measure(scene: str, integrand: str, size: tuple[int, int], spp: int) -> list[dict]:
    """Print and return a row for every number of points and filter."""
    rows = []
    path = SCENES / f"{scene}.toml"
    base = {"method": "mc", "size": size}
    references = {
        name: shown(
            ncv.render(path, integrand, spp=FINE_SPP, supersample=FINE, filter=name, **base).pixels
        )
        for name in FILTERS
    }
    for side in SIDES:
        own = max(1, spp // side**2)
        for name in FILTERS if side > 1 else ("box",):
            seconds, errors, noises = [], [], []
            for seed in range(REPEATS):
                begun = time.process_time()
                image = ncv.render(
                    path, integrand, spp=own, seed=seed + 1, supersample=side, filter=name, **base
                )
                seconds.append(time.process_time() - begun)
                errors.append(np.mean((shown(image.pixels) - references[name]) ** 2))
                noises.append(noise(image))
            print(
                f"{scene:12} {integrand:7} {side} x {side} points of {own:3}, {name:16} "
                f"{min(seconds):6.2f} s, error {np.sqrt(np.mean(errors)):.4f}, "
                f"noise {np.mean(noises):.4f}",
                flush=True,
            )
            rows.append({
                "scene": scene, "integrand": integrand, "supersample": side, "spp": own, "filter": name,
                "processor_seconds": min(seconds), "error": float(np.sqrt(np.mean(errors))),
                "noise": float(np.mean(noises)),
            })  # fmt: skip
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", type=int, nargs=2, default=(64, 48))
    parser.add_argument("--spp", type=int, default=64)
    parser.add_argument("--quick", action="store_true", help="one scene, small")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the rows here")
    options = parser.parse_args()
    size, spp = ((12, 9), 16) if options.quick else (tuple(options.size), options.spp)
    rows = []
    for scene, integrand in CASES[:1] if options.quick else CASES:
        rows += measure(scene, integrand, size, spp)
    if options.json:
        found = {"size": size, "spp": spp, "rows": rows}
        options.json.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
