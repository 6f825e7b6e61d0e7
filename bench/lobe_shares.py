"""What the lobe's share of direct light's square follows: prints the numbers behind LOBE_* again.

First, by independent samples on Veach's plates, each in four parts: variance, and second moment, by the
lights' samples alone, by the lobe's, by halves, and by the rule, over the better of the first two. Then
the mean square error of glossy pictures under Sobol points, by choices of the rule's constants.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from ncv_cl import render
from ncv_cl.integrands import tuning
from ncv_cl.output.image import Image

SCENES = Path(__file__).parent.parent / "scenes"
SHIPPED = tuning.LOBE_SHARES, tuning.LOBE_GAIN, tuning.LOBE_NEED
EIGHTHS = tuple(k / 8 for k in range(8))
# Shares, gain and need.
WAYS = {
    "lights": ((0.0,), 1.0, 1.0),
    "lobe": ((1.0,), 1.0, 1.0),
    "halves": ((0.5,), 1.0, 1.0),
    "shipped": SHIPPED,
}
RULES = {
    "lights": WAYS["lights"],
    "any gain": (SHIPPED[0], 1.0, 1.0),
    "gain 1.5": (SHIPPED[0], 1.5, SHIPPED[2]),
    "gain 2": (SHIPPED[0], 2.0, SHIPPED[2]),
    "shipped": SHIPPED,
    "gain 4": (SHIPPED[0], 4.0, 16.0),
    "gain 8": (SHIPPED[0], 8.0, 32.0),
    "all eighths": (EIGHTHS, *SHIPPED[1:]),
    "at most a half": ((0.0, 0.5), *SHIPPED[1:]),
}


def picture(name: str, way: tuple, spp: int, size: tuple[int, int], sampler: str, seed: int) -> Image:
    """A plain Monte Carlo picture of direct light by one way to share the square."""
    tuning.LOBE_SHARES, tuning.LOBE_GAIN, tuning.LOBE_NEED = way
    return render(
        SCENES / f"{name}.toml", "direct", "mc", sampler, spp=spp, size=size, seed=seed,
        allocation="uniform",
    )  # fmt: skip


def plates(spp: int, size: tuple[int, int]) -> None:
    """Variances and second moments a sample, by plate and quarter of the picture's width."""
    images = {k: picture("veach_plates", way, spp, size, "independent", 1) for k, way in WAYS.items()}
    variance = {k: spp * image.variance.mean(axis=-1) for k, image in images.items()}
    moment = {k: variance[k] + (image.pixels**2).mean(axis=-1) for k, image in images.items()}
    layers = images["shipped"].layers
    # Each plate has a normal of its own: from rough to smooth they are steeper. Lights look down.
    tilt = np.round(layers["N"][..., 1], 3)
    metal = (layers["albedo"].max(axis=-1) == 0) & (tilt > 0)
    quarter = np.arange(size[0]) * 4 // size[0]
    print("plates: variance and second moment over the better of lights and lobe")
    for plate in np.unique(tilt[metal]):
        for part in range(4):
            here = metal & (tilt == plate) & (quarter == part)
            row = [f"tilt {plate:.3f}, part {part}:"]
            for numbers in (variance, moment):
                mean = {k: image[here].mean() for k, image in numbers.items()}
                best = min(mean["lights"], mean["lobe"])
                row.append("  ".join(f"{k} {x / best:.3g}" for k, x in mean.items()))
            print("   |   ".join(row))


def rules(name: str, size: tuple[int, int], seeds: int) -> None:
    """Mean square errors of Sobol points by each rule, at several numbers of samples."""
    reference = picture(name, WAYS["halves"], 1 << 15, size, "sobol", 99).pixels
    for rule, way in RULES.items():
        errors = [
            np.mean([
                (picture(name, way, spp, size, "sobol", seed).pixels - reference) ** 2
                for seed in range(seeds)
            ])
            for spp in (64, 256, 1024)
        ]  # fmt: skip
        print(f"{name}, {rule}: " + "  ".join(f"{error:.3g}" for error in errors))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--spp", type=int, default=4096, help="samples of the plates' variances")
    parser.add_argument("--seeds", type=int, default=6)
    arguments = parser.parse_args()
    plates(arguments.spp, (64, 48))
    for scene in ("veach_plates", "knot", "occluders"):
        rules(scene, (64, 48), arguments.seeds)
