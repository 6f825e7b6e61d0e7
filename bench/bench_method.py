"""From how many samples on a control variate pays: the thresholds of method "auto".

Plain Monte Carlo and the control variate render the shipped scenes at several sizes and numbers of
samples, both with the same seeds, in turns, kernels compiled before, with visibility "auto": plain Monte
Carlo along lines and by slices where these pay. A picture's error is the mean
variance over renders of different seeds, so no reference is needed. Seconds are the processor time of
the process (all threads), the least over the seeds: a busy machine changes it little. `--wall` takes
elapsed time instead, for a quiet machine or a GPU.

A method's ratio at a number of samples: the seconds of whichever of the two reaches its picture's error
sooner (`crossover.Curve`), over its own; 1 is best. The threshold of a kind of integrand is the number
of samples of the image, samples a point times lit points (samples a point of paths that kernels trace),
that makes the worst ratio of the rule's choices as good as it can be. It is a power of two, and infinite
where the control variate never pays.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from crossover import Curve
from training import SCENES

import ncv_cl as ncv
from ncv_cl.estimation import tuning
from ncv_cl.estimation.method import kind_of
from ncv_cl.integrands import INTEGRANDS
from ncv_cl.opencl.choose import choose_device
from ncv_cl.opencl.device import Device

# Scene, integrand, and another visibility than "auto".
CASES = (
    ("cornell_box", "direct"),
    ("interior", "direct"),
    ("occluders", "direct"),
    ("knot", "direct"),
    ("occluders", "ao"),
    ("knot", "ao"),
    ("occluders", "ao", "points"),
    ("knot", "ao", "points"),
    ("cornell_box", "gi"),
    ("interior", "gi"),
)
METHODS = ("mc", "ncv")


@dataclass(frozen=True)
class Plan:
    """Samples a point, by points a side; samples of the image at most, by what they cost."""

    spps: dict[int, tuple[int, ...]]
    most: dict[str, int]


SMALL = (4, 16, 64, 256, 1024)
FULL = Plan(
    {64: (*SMALL, 4096, 16384), 256: SMALL, 768: (16, 64)},
    {"direct": 1 << 26, "ao": 1 << 26, "gi": 1 << 24, "independent": 1 << 22},
)
QUICK = Plan({64: SMALL[1:]}, {"direct": 1 << 22, "ao": 1 << 22, "gi": 1 << 18, "independent": 1 << 20})
SEEDS = (0, 1)


def measure(
    device: Device,
    case: tuple[str, ...],
    size: int,
    sampler: str,
    plan: Plan,
    clock: Callable[[], float],
) -> list[dict]:
    """One row a number of samples: both methods' seconds, errors and ratios."""
    name, integrand, visibility = (*case, "auto")[:3]
    scene = ncv.load_scene(SCENES / f"{name}.toml")
    options = {"size": (size, size), "device": device, "sampler": sampler, "visibility": visibility}

    def render(method: str, spp: int, seed: int) -> tuple[float, ncv.Image]:
        began = clock()
        image = ncv.render(scene, integrand, method, spp, seed=seed, **options)
        return clock() - began, image

    for method in METHODS:
        # Of so many that slices are taken, if they ever are.
        _, image = render(method, max(spp for spp in plan.spps[size] if spp <= 256), 0)
    points = image.stats["points"]
    most = min(plan.most[integrand], plan.most.get(sampler, math.inf))
    spps = [spp for spp in plan.spps[size] if spp * points <= most]
    runs = {(method, spp): [] for method in METHODS for spp in spps}
    for seed in SEEDS:
        for method, spp in runs:
            seconds, image = render(method, spp, seed)
            runs[method, spp].append((seconds, image.pixels.astype(np.float64)))
    found = {
        method: [{"spp": spp, "stages": {}, **summary(runs[method, spp])} for spp in spps]
        for method in METHODS
    }
    return [
        {
            "scene": name,
            "integrand": integrand,
            "visibility": visibility,
            "sampler": sampler,
            "size": size,
            "spp": spp,
            "samples": spp * points,
            "by_kernels": image.stats["rays_traced"] == 0,
            **{f"{m} seconds": found[m][i]["seconds"] for m in METHODS},
            **{f"{m} mse": found[m][i]["mse"] for m in METHODS},
            **ratios(found, i),
        }
        for i, spp in enumerate(spps)
    ]


def summary(runs: list[tuple[float, np.ndarray]]) -> dict[str, float]:
    """The least seconds, and the mean variance of one picture's pixels."""
    seconds, pixels = zip(*runs, strict=True)
    return {"seconds": min(seconds), "mse": float(np.var(pixels, axis=0, ddof=1).mean())}


def ratios(found: dict[str, list[dict]], number: int) -> dict[str, float]:
    """For each method, by its name: the sooner one's seconds to its error, over its own."""
    plain, ours = METHODS
    result = {}
    for method, other in ((plain, ours), (ours, plain)):
        own = found[method][number]
        needed = float(Curve.of(found[other]).seconds_to(own["mse"])[0])
        result[method] = min(needed / own["seconds"], 1.0)
    return result


def choice(rows: list[dict], threshold: float, number: str = "samples") -> list[float]:
    """Ratios of what a threshold of this number chooses."""
    return [row["ncv" if row[number] >= threshold else "mc"] for row in rows]


def threshold_of(rows: list[dict], number: str = "samples") -> float:
    """The power of two, or infinity, whose worst ratio is the best; of equal ones, the best mean."""
    most = max(row[number] for row in rows)
    first = 14 if number == "samples" else 2
    candidates = [*(2.0**k for k in range(first, int(math.log2(most)) + 1)), math.inf]

    def worth(threshold: float) -> tuple[float, float]:
        ratios = choice(rows, threshold, number)
        return min(ratios), float(np.log(ratios).sum())

    return max(candidates, key=worth)


def show(rows: list[dict]) -> None:
    """Print the table, and each kind's threshold."""
    for row in rows:
        print(line(row))
    kinds = [kind_of_row(row) for row in rows]
    for kind in dict.fromkeys(kinds):
        own = [row for row, its in zip(rows, kinds, strict=True) if its == kind]
        counted = "spp" if kind == "QUICK_PATHS_THAT_PAY" else "samples"
        threshold = threshold_of(own, counted)
        number = "math.inf" if threshold == math.inf else f"1 << {math.log2(threshold):.0f}"
        print(f"{kind} = {number}")
        now = getattr(tuning, kind)
        for name, limit in (("this", threshold), ("tuning.py", now), ("mc", math.inf), ("ncv", 0)):
            got = choice(own, limit, counted)
            print(f"  {name:9}: ratio {min(got):.2f} at worst, {np.exp(np.mean(np.log(got))):.2f} mean")


def write(file: Path, device: Device, rows: list[dict]) -> None:
    """Write rows to a file, in place of those of the same cases that it holds."""
    names = ("scene", "integrand", "visibility")
    cases = {tuple(row[name] for name in names) for row in rows}
    old = json.loads(file.read_text(encoding="utf-8"))["rows"] if file.exists() else []
    kept = [row for row in old if tuple(row[name] for name in names) not in cases]
    results = {"device": device.identity, "rows": kept + rows}
    file.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")


def kind_of_row(row: dict) -> str:
    """The number that a row tells; by visibility "auto" slices are there, taken or not."""
    integrand = INTEGRANDS[row["integrand"]]()
    sliced = integrand.sliced and row["visibility"] == "auto"
    return kind_of(integrand, row["sampler"], sliced, row.get("by_kernels", False))


def line(row: dict) -> str:
    """A row of the table."""
    visibility = "" if row["visibility"] == "auto" else f" {row['visibility']}"
    name = f"{row['scene']} {row['integrand']}{visibility} {row['sampler']} {row['size']}^2"
    cells = [
        f"{m} {row[f'{m} seconds']:6.2f} s {row[f'{m} mse']:.2e} ratio {row[m]:.2f}" for m in METHODS
    ]
    return f"{name:38} {row['spp']:5} spp {row['samples']:8.2g} samples: {', '.join(cells)}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="small images and few samples")
    parser.add_argument("--most", type=float, default=math.inf, metavar="N", help="samples of an image")
    parser.add_argument("--json", metavar="FILE", help="write the results here, over those of the cases")
    parser.add_argument("--table", metavar="FILE", help="what --json wrote, instead of measuring")
    parser.add_argument("--wall", action="store_true", help="elapsed time, not that of processors")
    parser.add_argument("--device", metavar="D", help="as for ncv-cl render")
    parser.add_argument(
        "--case", action="append", metavar="SCENE:INTEGRAND[:VISIBILITY]", help="default: all"
    )
    options = parser.parse_args()
    if options.table:
        show(json.loads(Path(options.table).read_text(encoding="utf-8"))["rows"])
        return
    device, plan = choose_device(options.device), QUICK if options.quick else FULL
    plan = Plan(plan.spps, {kind: min(most, options.most) for kind, most in plan.most.items()})
    clock = time.perf_counter if options.wall else time.process_time
    cases = [tuple(case.split(":")) for case in options.case or ()] or CASES
    rows = []
    for case in cases:
        for sampler in ("sobol", "independent"):
            for size in plan.spps:
                rows += measure(device, case, size, sampler, plan, clock)
                print(f"{case[0]} {case[1]} {sampler} {size}", flush=True)
        if options.json:
            write(Path(options.json), device, rows)
    print(device.identity)
    show(rows)


if __name__ == "__main__":
    main()
