"""Run time against error of whole renders: every method, from 4 to 1024 samples a point.

For every scene and integrand: plain Monte Carlo with independent samples, with Sobol points, and with
Sobol points allocated by a pilot; the control variate by the slides' preset, by the default and by the
default without density and allocation; and `auto`. Everything of a render is timed, training included,
but not the compilation of kernels. Before a method is timed, its image must agree with the reference
(a Z-test on the mean); one that does not is reported and left out. Repeats are interleaved, each with
its own seed; seconds are medians, errors means, both with their spread.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from crossover import Curve, against_the_better, crossover
from references import Reference, reference
from training import CASES, SCENES

import ncv_cl as ncv
from ncv_cl.integrands import INTEGRANDS
from ncv_cl.opencl.choose import choose_device
from ncv_cl.opencl.device import Device

INDEPENDENT, SOBOL, PILOT = "MC, independent", "MC, Sobol", "MC, Sobol, pilot"
SLIDES, DEFAULT, NO_DENSITY, AUTO = "NCV, slides", "NCV", "NCV, no density", "auto"
# Plain Monte Carlo as it is without lines on the lights: what the others are held against.
METHODS = {
    INDEPENDENT: {"method": "mc", "sampler": "independent", "visibility": "points"},
    SOBOL: {"method": "mc", "visibility": "points"},
    PILOT: {"method": "mc", "allocation": "pilot", "visibility": "points"},
    SLIDES: {"method": "ncv", "preset": "slides"},
    NO_DENSITY: {"method": "ncv", "density": "none", "allocation": "uniform"},
    DEFAULT: {"method": "ncv"},
    AUTO: {"method": "auto"},
}
# Beside the cases that training is measured on: a scene without occluders, and gloss. Global
# illumination has parts of its own.
MORE_CASES = (("plane_light", "direct"), ("knot", "direct"))
# One a scene, where time is short.
QUICK_CASES = (
    ("cornell_box", "direct"),
    ("knot", "ao"),
)
LEFT_OUT = {
    "stratified": "the renderer has independent and Sobol points; stratified points are among the "
    "methods of the planar experiments",
}
VALIDATION_SPP = 64
# Renders shorter than this are repeated more often.
SHORT_SECONDS = 1.0
# Where `auto` is held against the better of the other two.
FEWEST_FOR_AUTO = 16
# Stages of a render, by what the slides' table calls them; what is in no stage is "other".
STAGES = {
    "render": ("scene", "points", "sample", "trace", "resolve"),
    "train": ("train", "alpha", "density"),
    "integration": ("fold", "integrate"),
    "inference": ("estimate",),
}


@dataclass(frozen=True)
class Plan:
    """How much is measured: points a side, samples, repeats, and samples of the references."""

    size: int
    spps: tuple[int, ...]
    repeats: int
    reference_spp: int
    # Of renders shorter than SHORT_SECONDS, if that is more.
    short_repeats: int = 0


FULL = Plan(128, (4, 16, 64, 256, 1024), 1, 1 << 13, 3)
QUICK = Plan(48, (4, 16, 64), 1, 1 << 12)


def run(quick: bool) -> dict:
    """Measure on the device of `choose_device`; returns what --json writes."""
    return measure(choose_device(), QUICK if quick else FULL, cases_of(quick))


def cases_of(quick: bool) -> list[tuple[str, str]]:
    """The (scene, integrand) pairs to measure that this version renders."""
    wanted = QUICK_CASES if quick else (*CASES, *MORE_CASES)
    return [case for case in wanted if case[1] in INTEGRANDS]


def measure(device: Device, plan: Plan, cases: list[tuple[str, str]]) -> dict:
    """All cases; a case that fails says why and leaves the others."""
    results = []
    for scene, integrand in cases:
        print(f"{scene} {integrand}", flush=True)
        row: dict[str, object] = {"scene": scene, "integrand": integrand}
        try:
            row |= Case(device, scene, integrand, plan).measure()
        except RuntimeError as error:
            row["failed"] = str(error)
            print(f"  {error}")
        results.append(row)
    return {
        "device": device.identity,
        "size": plan.size,
        "spps": plan.spps,
        "repeats": plan.repeats,
        "short_repeats": plan.short_repeats,
        "left_out": LEFT_OUT | unmeasured(cases),
        "cases": results,
    }


def unmeasured(cases: list[tuple[str, str]]) -> dict[str, str]:
    """Which of the full run's cases are not among `cases`, and why."""
    reasons = {True: "not asked for in this run", False: "this version has no such integrand"}
    every = (*CASES, *MORE_CASES)
    return {f"{s} {i}": reasons[i in INTEGRANDS] for s, i in every if (s, i) not in cases}


class Case:
    """A scene and integrand at one size, with its reference."""

    def __init__(self, device: Device, scene: str, integrand: str, plan: Plan) -> None:
        self.device, self.integrand, self.plan = device, integrand, plan
        self.scene = ncv.load_scene(SCENES / f"{scene}.toml")
        self.reference: Reference = reference(
            device, self.scene, integrand, plan.size, plan.reference_spp
        )

    def render(self, method: str, spp: int, seed: int) -> ncv.Image:
        size = (self.plan.size, self.plan.size)
        options = METHODS[method]
        return ncv.render(
            self.scene, self.integrand, spp=spp, size=size, seed=seed, device=self.device, **options
        )

    def measure(self) -> dict:
        own_mse, own_relmse = self.reference.own_errors()
        methods = {name: {"validation": self._validate(name)} for name in METHODS}
        valid = [name for name, found in methods.items() if found["validation"]["valid"]]
        for name, points in self._points(valid).items():
            methods[name]["points"] = points
            for p in points:
                print(
                    f"  {name:16} {p['spp']:5} spp {p['seconds']:8.3f} s   MSE {p['mse']:.3e}   "
                    f"relMSE {p['relmse']:.3e}   {p['method']}",
                    flush=True,
                )
        curves = curves_of(methods)
        return {
            "reference": {
                "spp": self.reference.spp,
                "seconds": self.reference.seconds,
                "cached": self.reference.cached,
                "mse": own_mse,
                "relmse": own_relmse,
                "z": self.reference.agreement,
            },
            "methods": methods,
            "crossovers": crossovers(curves),
            "auto": auto_rows(methods, curves),
            "equal_error": self._equal_error(curves),
        }

    def _validate(self, method: str) -> dict:
        """The Z-test; kernels are compiled by it, outside of any clock."""
        image = self.render(method, VALIDATION_SPP, 5)
        z, valid = self.reference.agrees(image.pixels)
        if not valid:
            print(f"  {method}: {z:.1f} deviations from the reference; not timed")
        return {"spp": VALIDATION_SPP, "z": z, "valid": valid}

    def _points(self, methods: list[str]) -> dict[str, list[dict]]:
        """Every method at every number of samples, repeats interleaved."""
        runs: dict[str, dict[int, list]] = {name: {n: [] for n in self.plan.spps} for name in methods}
        for repeat in range(max(self.plan.repeats, self.plan.short_repeats)):
            for spp in self.plan.spps:
                for name in methods:
                    own = runs[name][spp]
                    # One core's hiccup is much of a short render, which is cheap to repeat.
                    if repeat < self.plan.repeats or own[0]["seconds"] < SHORT_SECONDS:
                        own.append(self._one(name, spp, 10 + repeat))
        return {name: [summary(spp, one) for spp, one in runs[name].items()] for name in methods}

    def _one(self, method: str, spp: int, seed: int) -> dict:
        image = self.render(method, spp, seed)
        mse, relmse = self.reference.errors(image.pixels)
        return {
            "seconds": image.stats["seconds"]["total"],
            "mse": mse,
            "relmse": relmse,
            "claimed": float(image.variance.mean()),
            "samples": image.stats["samples_per_point"],
            "method": image.stats["method"],
            "stages": stages(image.stats["seconds"]),
        }

    def _equal_error(self, curves: dict[str, Curve]) -> dict[str, dict]:
        """The slides' last table: each method at the samples that take it to one error."""
        if SOBOL not in curves or DEFAULT not in curves:
            return {}
        plain, ours = curves[SOBOL], curves[DEFAULT]
        error = max(plain.errors[-1], ours.errors[-1])
        wanted = {SOBOL: plain, SLIDES: curves.get(SLIDES), DEFAULT: ours}
        rows = {}
        for name, curve in wanted.items():
            # No further than the curve was measured: what is asked must be near what is known.
            if curve is None or curve.errors[-1] > error * 1.01:
                continue
            spp = max(1, round(float(curve.samples_to(error)[0])))
            runs = [self._one(name, spp, 100 + repeat) for repeat in range(self.plan.repeats)]
            rows[name] = summary(spp, runs)
        return rows


def stages(seconds: dict[str, float]) -> dict[str, float]:
    """Seconds by the slides' names of stages."""
    found = {
        group: sum(seconds.get(stage, 0.0) for stage in members) for group, members in STAGES.items()
    }
    return {**found, "other": max(0.0, seconds["total"] - sum(found.values()))}


def summary(spp: int, runs: list[dict]) -> dict:
    """One row of several runs: median seconds, mean errors, and the spread of both."""
    row: dict[str, object] = {"spp": spp, "method": runs[-1]["method"]}
    for name, middle in (("seconds", np.median), ("mse", np.mean), ("relmse", np.mean)):
        values = [one[name] for one in runs]
        row[name] = float(middle(values))
        row[f"{name}_range"] = [float(min(values)), float(max(values))]
    for name in ("claimed", "samples"):
        row[name] = float(np.mean([one[name] for one in runs]))
    row["stages"] = {
        name: float(np.median([one["stages"][name] for one in runs])) for name in runs[0]["stages"]
    }
    return row


def curves_of(methods: dict[str, dict]) -> dict[str, Curve]:
    """The curves of the methods that were timed."""
    found = {}
    for name, one in methods.items():
        if any(p["mse"] > 0 for p in one.get("points", [])):
            found[name] = Curve.of(one["points"])
    return found


def crossovers(curves: dict[str, Curve]) -> dict[str, dict]:
    """Of the default control variate against each form of plain Monte Carlo."""
    if DEFAULT not in curves:
        return {}
    plain = [name for name in (INDEPENDENT, SOBOL, PILOT) if name in curves]
    return {name: crossover(curves[name], curves[DEFAULT]).as_dict() for name in plain}


def auto_rows(methods: dict[str, dict], curves: dict[str, Curve]) -> list[dict]:
    """How `auto` fared against the better of Sobol Monte Carlo and the control variate."""
    if AUTO not in curves or SOBOL not in curves or DEFAULT not in curves:
        return []
    points = [p for p in methods[AUTO]["points"] if p["spp"] >= FEWEST_FOR_AUTO]
    return against_the_better(points, {name: curves[name] for name in (SOBOL, DEFAULT)})


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="small images, few samples")
    parser.add_argument("--json", metavar="FILE", help="write the results here")
    parser.add_argument("--device", metavar="D", help="as for ncv-cl render")
    parser.add_argument("--size", type=int, help=f"points a side (default {FULL.size})")
    parser.add_argument("--repeats", type=int, help=f"of each render (default {FULL.repeats})")
    parser.add_argument("--reference-spp", type=int, help=f"default {FULL.reference_spp}")
    parser.add_argument("--case", action="append", metavar="SCENE:INTEGRAND", help="default: all")
    options = parser.parse_args()
    base = QUICK if options.quick else FULL
    plan = Plan(
        options.size or base.size,
        base.spps,
        options.repeats or base.repeats,
        options.reference_spp or base.reference_spp,
        base.short_repeats,
    )
    cases = [tuple(case.split(":")) for case in options.case or ()] or cases_of(options.quick)
    results = measure(choose_device(options.device), plan, cases)
    if options.json:
        Path(options.json).write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
    return 1 if any("failed" in case for case in results["cases"]) else 0


if __name__ == "__main__":
    sys.exit(main())
