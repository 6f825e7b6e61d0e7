"""Seconds to equal error, all in: the control variate against Monte Carlo of three kinds.

To the error that Sobol Monte Carlo has at some numbers of samples, what every rival needs over what the
control variate needs: independent samples (their error is exactly the variance over the number, so one
short render tells), Sobol points, and Sobol points with samples allocated by a pilot; and `auto`.

Mean square errors are halved squared differences of two renders with different seeds: no reference is
needed, and none can be the worse of the two. Relative ones are over the square of the pixel's value,
with a floor (`references.relative_weight`): dark pixels count as much as bright ones. Seconds are the
lesser of the two renders'. Before anything is timed, plain Monte Carlo and the control variate are
tested to agree.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from pathlib import Path

from bench_curves import AUTO, DEFAULT, INDEPENDENT, METHODS, PILOT, SOBOL, stages
from crossover import Curve
from references import relative_weight, z_test
from training import CASES, SCENES

import ncv_cl as ncv
from ncv_cl.opencl.choose import choose_device
from ncv_cl.opencl.device import Device

# The control variate with samples where the error is largest over the pixel's value.
RELATIVE = "NCV, relative"
RELATIVE_OPTIONS = {"method": "ncv", "allocation": "relative"}
# Samples of the short render with independent samples, and of those that must agree.
FEW = 64


@dataclass(frozen=True)
class Plan:
    """Points a side; samples of Sobol Monte Carlo whose errors are aimed at; the control variate's."""

    size: int
    targets: tuple[int, ...]
    ours: tuple[int, ...]
    cases: tuple[tuple[str, str], ...] = CASES


FULL = Plan(256, (128, 1024), (16, 64, 256, 1024))
QUICK = Plan(48, (32, 64), (8, 32), CASES[1:2])


def measure(device: Device, scene_name: str, integrand: str, plan: Plan) -> dict:
    """All curves of one case, and the table made of them."""
    scene = ncv.load_scene(SCENES / f"{scene_name}.toml")
    size, ways = (plan.size, plan.size), METHODS | {RELATIVE: RELATIVE_OPTIONS}

    def render(method: str, spp: int, seed: int) -> ncv.Image:
        return ncv.render(scene, integrand, spp=spp, size=size, seed=seed, device=device, **ways[method])

    def point(method: str, spp: int) -> dict:
        first, second = (render(method, spp, seed) for seed in (1, 2))
        shorter = min(first, second, key=lambda image: image.stats["seconds"]["total"])
        a, b = first.pixels.astype(float), second.pixels.astype(float)
        squares = (a - b) ** 2 / 2
        return {
            "spp": spp,
            "seconds": shorter.stats["seconds"]["total"],
            "mse": float(squares.mean()),
            "relmse": float((squares * relative_weight((a + b) / 2)).mean()),
            "method": shorter.stats["method"],
            "stages": stages(shorter.stats["seconds"]),
        }

    plain, ours = (render(method, FEW, seed) for seed, method in enumerate((SOBOL, DEFAULT), 3))
    z, agree = z_test(plain.pixels, ours.pixels)
    if not agree:
        raise SystemExit(f"{scene_name} {integrand}: mc and ncv disagree by {z:.1f} deviations")
    spps = {INDEPENDENT: (FEW,), DEFAULT: plan.ours, RELATIVE: plan.ours}
    points = {
        name: [point(name, spp) for spp in spps.get(name, plan.targets)]
        for name in (INDEPENDENT, SOBOL, PILOT, DEFAULT, RELATIVE, AUTO)
    }
    curves = {name: Curve.of(rows) for name, rows in points.items()}
    relative = {
        name: Curve.of([row | {"mse": row["relmse"]} for row in rows]) for name, rows in points.items()
    }
    rows = [
        ratios(target, points, curves) | relative_ratios(target, points, relative)
        for target in plan.targets
    ]
    return {"scene": scene_name, "integrand": integrand, "rows": rows, "points": points}


def ratios(target: int, points: dict[str, list[dict]], curves: dict[str, Curve]) -> dict:
    """Seconds of each rival to the error of `target` Sobol samples, over the control variate's."""
    (sobol,) = (row for row in points[SOBOL] if row["spp"] == target)
    ours = float(curves[DEFAULT].seconds_to(sobol["mse"])[0])
    (few,) = points[INDEPENDENT]
    (auto,) = (row for row in points[AUTO] if row["spp"] == target)
    return {
        "samples of MC, Sobol": target,
        "mse": sobol["mse"],
        "seconds of NCV": ours,
        f"{INDEPENDENT} / NCV": few["seconds"] * few["mse"] / sobol["mse"] / ours,
        f"{SOBOL} / NCV": sobol["seconds"] / ours,
        f"{PILOT} / NCV": float(curves[PILOT].seconds_to(sobol["mse"])[0]) / ours,
        f"{SOBOL} / auto": float(curves[SOBOL].seconds_to(auto["mse"])[0]) / auto["seconds"],
        "auto chose": auto["method"],
    }


def relative_ratios(target: int, points: dict[str, list[dict]], curves: dict[str, Curve]) -> dict:
    """The same to the relative error of `target` Sobol samples, by either allocation."""
    (sobol,) = (row for row in points[SOBOL] if row["spp"] == target)
    return {"relmse": sobol["relmse"]} | {
        f"{SOBOL} / {name}, relative error": sobol["seconds"]
        / float(curves[name].seconds_to(sobol["relmse"])[0])
        for name in (DEFAULT, RELATIVE, AUTO)
    }


def findings(cases: list[dict]) -> list[str]:
    """A sentence a case, of the smallest error."""
    texts = []
    for case in cases:
        row = case["rows"][-1]
        name, samples = f"{case['scene']} {case['integrand']}", row["samples of MC, Sobol"]
        others = ", ".join(
            f"{method} {row[f'{method} / NCV']:.3g}" for method in (SOBOL, PILOT, INDEPENDENT)
        )
        texts.append(
            f"{name}: to the error of {samples} Sobol samples the control variate takes "
            f"{row['seconds of NCV']:.3g} s, and of its seconds others take: {others}."
        )
    return texts


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="small images and few samples")
    parser.add_argument("--json", metavar="FILE", help="write the results here")
    parser.add_argument("--device", metavar="D", help="as for ncv-cl render")
    options = parser.parse_args()
    device, plan = choose_device(options.device), QUICK if options.quick else FULL
    print(f"{device.identity}\n{plan.size} x {plan.size} points", flush=True)
    cases = []
    for scene, integrand in plan.cases:
        cases.append(measure(device, scene, integrand, plan))
        print(f"{scene} {integrand}")
        for row in cases[-1]["rows"]:
            cells = (f"{k} {v:.4g}" if isinstance(v, float) else f"{k} {v}" for k, v in row.items())
            print("  " + ", ".join(cells), flush=True)
    if options.json:
        results = {"device": device.identity, "size": plan.size, "cases": cases}
        results["findings"] = findings(cases)
        Path(options.json).write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
