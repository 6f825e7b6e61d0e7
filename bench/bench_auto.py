"""What "auto" chose in scenes that no number was tuned on, what was best, and what the choice cost.

Scenes are made by a seed (held_out.py). Each is rendered by method and visibility "auto", and by the
ways that "auto" chooses among: points, lines or slices, with a control variate and without. Errors are
variances over renders of different seeds; seconds are the processor time of the process, the least over
the seeds; all ways take turns. Renders of few samples, which take some milliseconds, have more seeds.
A choice's ratio: the seconds of the way that reaches its error first (`crossover.Curve`), over its own.
1 is best; below 0.95 from 16 samples on the rule is wrong.

Global illumination has no lines of its own: its direct light is apart (`--split-direct`) or not.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from crossover import Curve, against_the_better
from held_out import HELD_OUT

import ncv_cl as ncv
from ncv_cl.opencl.choose import choose_device
from ncv_cl.opencl.device import Device

AUTO = "auto"
# Ways by integrand: options of a render.
WAYS: dict[str, dict[str, dict[str, object]]] = {
    "direct": {
        "points": {"method": "mc", "visibility": "points"},
        "lines": {"method": "mc", "visibility": "lines"},
        "points, network": {"method": "ncv", "visibility": "points"},
    },
    "ao": {
        "points": {"method": "mc", "visibility": "points"},
        "slices": {"method": "mc", "visibility": "lines"},
        "points, network": {"method": "ncv", "visibility": "points"},
    },
    "gi": {
        "one part": {"method": "mc", "split_direct": "off"},
        "two parts": {"method": "mc"},
        "network": {"method": "ncv"},
    },
}
# The ways that train, of which fewer numbers of samples are rendered.
NETWORKS = ("points, network", "network")
ENOUGH = 0.95
# Of ambient occlusion, scene units: rooms are closed.
RADIUS = 1.5
# Kernels are compiled by a render of so many samples; slices are looked into from there on.
WARM_SAMPLES = 64


@dataclass(frozen=True)
class Plan:
    """Points a side by integrand, numbers of samples, and renders of each at least."""

    sizes: dict[str, int]
    spps: tuple[int, ...]
    seeds: int

    def renders(self, spp: int) -> int:
        """How many of so many samples."""
        return max(self.seeds, min(MOST_SEEDS, SEEDS_OF_SAMPLES // spp))


# Paths are noisy, and take the time of many lines.
FULL = Plan({"direct": 96, "ao": 96, "gi": 64}, (16, 64, 256), 2)
QUICK = Plan({"direct": 48, "ao": 48, "gi": 32}, (16, 64), 2)
MOST_SEEDS, SEEDS_OF_SAMPLES = 6, 128
# Slices are few, and ways of fewer samples reach what "auto" does by more: both sides of its numbers.
FACTORS = (0.25, 1, 4)


def wanted_of(integrand: str, plan: Plan) -> dict[tuple[str, int], dict[str, object]]:
    """Options by way and number of samples."""
    wanted: dict[tuple[str, int], dict[str, object]] = {(AUTO, spp): {} for spp in plan.spps}
    for name, options in WAYS[integrand].items():
        few = integrand == "gi" or name in NETWORKS
        factors = (1,) if few else FACTORS
        numbers = {max(1, int(spp * factor)) for spp in plan.spps for factor in factors}
        wanted |= {(name, number): options for number in sorted(numbers)}
    return wanted


def measure(device: Device, scene: ncv.Scene, integrand: str, plan: Plan) -> list[dict]:
    """A row of `against_the_better` for each number of samples."""
    asked = ncv.AmbientOcclusion(RADIUS) if integrand == "ao" else integrand
    size = plan.sizes[integrand]
    common = {"integrand": asked, "size": (size, size), "device": device}
    wanted = wanted_of(integrand, plan)
    runs: dict[tuple[str, int], list[tuple[float, np.ndarray]]] = {}
    left_out, plans = set(), {}
    most = max(plan.renders(spp) for _, spp in wanted)
    # The first of few samples compiles kernels.
    for seed in range(most + 1):
        for (name, spp), options in wanted.items():
            if name in left_out or seed > plan.renders(spp):
                continue
            number = spp if seed else min(spp, WARM_SAMPLES)
            began = time.process_time()
            try:
                image = ncv.render(scene, spp=number, seed=seed, **common, **options)
            except ValueError as error:
                # A way that this scene does not allow, such as lines to many lights.
                print(f"  without {name}: {error}")
                left_out.add(name)
                continue
            if seed:
                own = runs.setdefault((name, spp), [])
                own.append((time.process_time() - began, image.pixels.astype(np.float64)))
                if name == AUTO:
                    plans[spp] = image.stats["auto"]
    rows = {key: summary(own) | {"spp": key[1], "stages": {}} for key, own in runs.items()}
    others = {
        name: Curve.of([row for (own, _), row in rows.items() if own == name])
        for name in WAYS[integrand]
        if name not in left_out
    }
    own = [rows[AUTO, spp] | {"method": plans[spp]["method"]} for spp in plan.spps]
    return [
        row | {"chosen": way_of(runs, row["spp"]), "best": row["better"]} | plans[row["spp"]]
        for row in against_the_better(own, others)
    ]


def way_of(runs: dict[tuple[str, int], list[tuple[float, np.ndarray]]], spp: int) -> str:
    """The name of the way that "auto" took: the one whose picture is the same, bit for bit."""
    _, own = runs[AUTO, spp][0]
    same = [name for (name, n), found in runs.items() if n == spp and np.array_equal(found[0][1], own)]
    # Of slices there are fewer than of samples that were asked for.
    return next((name for name in same if name != AUTO), "slices")


def summary(runs: list[tuple[float, np.ndarray]]) -> dict[str, object]:
    """The least and largest seconds, and the mean variance of one picture's pixels."""
    seconds, pixels = zip(*runs, strict=True)
    mse = float(np.var(pixels, axis=0, ddof=1).mean())
    return {"seconds": min(seconds), "seconds_range": [min(seconds), max(seconds)], "mse": mse}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenes", nargs="*", help=f"of {', '.join(HELD_OUT)}; default: all")
    parser.add_argument("--integrand", action="append", choices=tuple(WAYS), help="default: all")
    parser.add_argument("--quick", action="store_true", help="one scene, small")
    parser.add_argument("--json", metavar="FILE", help="write the results here")
    parser.add_argument("--device", metavar="D", help="as for ncv-cl render")
    options = parser.parse_args()
    device, plan = choose_device(options.device), QUICK if options.quick else FULL
    print(device.identity)
    names = options.scenes or (["terrain"] if options.quick else list(HELD_OUT))
    results = []
    for name in names:
        scene = HELD_OUT[name]()
        for integrand in options.integrand or WAYS:
            for row in measure(device, scene, integrand, plan):
                results.append({"scene": name, "integrand": integrand, **row})
                cells = ", ".join(f"{way} {ratio:.2f}" for way, ratio in row["ratios"].items())
                print(
                    f"{name:19} {integrand:6} {row['spp']:4} spp: {row['chosen']}, ratio "
                    f"{min(row['ratio'], 1):.2f}, best {row['best']} ({cells})",
                    flush=True,
                )
    ratios = np.minimum([row["ratio"] for row in results], 1)
    wrong = int(np.count_nonzero(ratios < ENOUGH))
    print(
        f"ratio {ratios.min():.2f} at worst, {np.exp(np.log(ratios).mean()):.2f} mean; "
        f"{wrong} of {len(ratios)} below {ENOUGH}"
    )
    if options.json:
        found = {"device": device.identity, "sizes": plan.sizes, "rows": results}
        Path(options.json).write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
