"""Run time against error of whole renders, beside what uniform Sobol points take to the same error.

For every case: plain Monte Carlo with independent samples, with Sobol points, with Sobol points
allocated by a pilot; the control variate in several forms. Errors are against a reference of another
seed, whose own variance is subtracted. Between measured points, error is interpolated in logarithms and
time in samples; what lies outside the measured range is marked as extrapolated (*). Everything of a
render is timed, training included, but not the compilation of kernels. Times are medians over
interleaved repeats.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import ncv_cl as ncv
from ncv_cl.choose import choose_device
from ncv_cl.device import Device

SCENES = Path(__file__).parent.parent / "scenes"
CASES = (("cornell_box", "direct"), ("occluders", "direct"), ("occluders", "ao"), ("knot", "ao"))
METHODS = {
    "Sobol": {"method": "mc"},
    "Sobol, pilot allocation": {"method": "mc", "allocation": "pilot"},
    "slides": {"method": "ncv", "preset": "slides", "train_spp": 16},
    "ncv": {"method": "ncv"},
    "ncv, uniform": {"method": "ncv", "density": "none", "allocation": "uniform"},
}
REFERENCE_SEED = 2**40


@dataclass(frozen=True)
class Point:
    """One method at one number of samples.

    Attributes
    ----------
    spp : int
    seconds : float
        Median of the repeats.
    mse : float
        Against the reference, its own variance subtracted; mean of the repeats, each with its own seed.
    claimed : float
        What the renders say their mean square error is.
    stages : dict
        Seconds a stage, of the last repeat.
    """

    spp: int
    seconds: float
    mse: float
    claimed: float
    stages: dict[str, float]


class Case:
    """A scene and integrand at one size, with its reference."""

    def __init__(
        self, device: Device, scene: str, integrand: str, size: int, reference_spp: int
    ) -> None:
        self.device, self.integrand, self.size = device, integrand, size
        self.scene = ncv.load_scene(SCENES / f"{scene}.toml")
        image = self._render(reference_spp, REFERENCE_SEED, method="ncv")
        self.reference, self.reference_mse = (
            image.pixels.astype(np.float64),
            float(image.variance.mean()),
        )

    def _render(self, spp: int, seed: int, **options: object) -> ncv.Image:
        size = (self.size, self.size)
        return ncv.render(
            self.scene, self.integrand, spp=spp, size=size, seed=seed, device=self.device, **options
        )

    def measure(self, spps: dict[str, tuple[int, ...]], repeats: int) -> dict[str, list[Point]]:
        """Every method at each of its numbers of samples, interleaved."""
        for name in spps:
            # Kernels are compiled outside the clock.
            self._render(min(spps[name]), 1, **METHODS[name])
        runs: dict[tuple[str, int], list] = {}
        for repeat in range(repeats):
            for name, numbers in spps.items():
                for spp in numbers:
                    image = self._render(spp, 10 + repeat, **METHODS[name])
                    error = np.mean((image.pixels - self.reference) ** 2) - self.reference_mse
                    seconds = image.stats["seconds"]
                    runs.setdefault((name, spp), []).append(
                        (seconds["total"], float(error), float(image.variance.mean()), seconds)
                    )
        found: dict[str, list[Point]] = {}
        for (name, spp), one in runs.items():
            seconds, errors, claimed, stages = zip(*one, strict=True)
            found.setdefault(name, []).append(
                Point(
                    spp,
                    float(np.median(seconds)),
                    float(np.mean(errors)),
                    float(np.mean(claimed)),
                    stages[-1],
                )
            )
        return found

    def independent(self, seconds_a_sample: float, mse: float) -> float:
        """Seconds that independent samples need to reach `mse`: their error is exactly variance / n."""
        image = self._render(64, 5, method="mc", sampler="independent")
        return float(image.variance.mean()) * 64 / mse * seconds_a_sample


def seconds_to(points: list[Point], mse: float) -> tuple[float, bool]:
    """Seconds a method takes to reach an error, and whether that is within what was measured."""
    spp = np.log([point.spp for point in points])
    error = np.log([max(point.mse, 1e-30) for point in points])
    slope, offset = np.polyfit(error, spp, 1)
    if error.min() <= np.log(mse) <= error.max():
        order = np.argsort(error)
        needed = np.exp(np.interp(np.log(mse), error[order], spp[order]))
        inside = True
    else:
        needed, inside = np.exp(slope * np.log(mse) + offset), False
    a_sample, fixed = np.polyfit([p.spp for p in points], [p.seconds for p in points], 1)
    return float(max(fixed, min(p.seconds for p in points) * 0.5) + a_sample * needed), inside


def report(case: Case, found: dict[str, list[Point]], targets: tuple[int, ...]) -> dict:
    """Print a case's tables; returns its rows."""
    rows = []
    for name, points in found.items():
        for p in points:
            print(
                f"  {name:24} {p.spp:5} spp {p.seconds:8.2f} s   MSE {p.mse:.3e}"
                f"   claimed {p.claimed:.3e}"
            )
    sobol = {p.spp: p for p in found["Sobol"]}
    last = max(sobol)
    a_sample = sobol[last].seconds / last
    for target in targets:
        mse, seconds = sobol[target].mse, sobol[target].seconds
        line = [f"  error of {target} Sobol samples, {seconds:.2f} s; seconds of Sobol over seconds of:"]
        for name, points in found.items():
            # One number of samples says nothing of another.
            if name != "Sobol" and len(points) > 1:
                own, inside = seconds_to(points, mse)
                line.append(f"{name} {seconds / own:.2f}{'' if inside else '*'}")
                rows.append(
                    {"target": target, "method": name, "speedup": seconds / own, "measured": inside}
                )
        own, _ = seconds_to(found["ncv"], mse)
        independent = case.independent(a_sample, mse) / own
        line.append(f"independent over ncv {independent:.0f}")
        rows.append({"target": target, "method": "independent / ncv", "speedup": independent})
        print(" | ".join(line))
    return {"points": {n: [vars(p) for p in ps] for n, ps in found.items()}, "speedups": rows}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="small images, few samples, one repeat")
    parser.add_argument("--size", type=int, help="pixels a side (default 512; quick: 64)")
    parser.add_argument("--repeats", type=int, default=1)
    parser.add_argument("--json", metavar="FILE", help="write the results here")
    parser.add_argument("--plot", metavar="FILE", help="write a plot here (needs matplotlib)")
    parser.add_argument("--device", metavar="D", help="as for ncv-cl render")
    options = parser.parse_args()
    device = choose_device(options.device)
    size = options.size or (64 if options.quick else 512)
    if options.quick:
        spps = {name: (16, 64) for name in METHODS}
        targets, reference_spp = (64,), 256
    else:
        spps = {
            "Sobol": (16, 128, 256, 1024),
            "Sobol, pilot allocation": (128, 512, 1024),
            "slides": (64, 256),
            "ncv": (16, 64, 256, 512),
            "ncv, uniform": (64, 256),
        }
        targets, reference_spp = (128, 256, 1024), 1024
    print(f"{device.identity}\n{size} x {size} points")
    results = {}
    for scene, integrand in CASES:
        print(f"{scene} {integrand}", flush=True)
        case = Case(device, scene, integrand, size, reference_spp)
        found = case.measure(spps, options.repeats)
        results[f"{scene} {integrand}"] = report(case, found, targets)
    if options.json:
        text = json.dumps({"device": device.identity, "size": size, "cases": results}, indent=1)
        Path(options.json).write_text(text + "\n", encoding="utf-8")
    if options.plot:
        plot(results, device.identity, options.plot)


def plot(results: dict, device: str, path: str) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, len(results), figsize=(4 * len(results), 4))
    for axis, (name, case) in zip(axes, results.items(), strict=True):
        for method, points in case["points"].items():
            axis.plot([p["seconds"] for p in points], [p["mse"] for p in points], "o-", label=method)
        axis.set(title=name, xlabel="seconds, all in", xscale="log", yscale="log")
        axis.grid(True, which="both", alpha=0.3)
    axes[0].set_ylabel("mean square error")
    axes[0].legend(fontsize=7)
    figure.suptitle(device, fontsize=7)
    figure.tight_layout()
    figure.savefig(path, dpi=100)


if __name__ == "__main__":
    main()
