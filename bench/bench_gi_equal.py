"""Global illumination to equal error: processor seconds of plain path tracing over those of others.

In the shipped scenes that are lit indirectly, and in rooms that are made here: furnished, lit around a
corner, nearly white, glossy, lit through a door. To the errors that plain Monte Carlo with Sobol points
has at some number of samples, direct light and paths by the same samples: the mean square error, and the
relative one, the mean over pixels of (error / (value + a hundredth of the mean))². The errors are the
mean variance over renders of different seeds, so no reference is needed. Seconds are the processor time
of the process, the least over the seeds; kernels are compiled before.

`--allocations` compares allocations at one number of samples instead; printed is what plain Monte Carlo
would need to each error, over what they need, by errors times seconds.

`--sharing` tells whether points should share their paths (MOST_OWN of ncv_cl/sampling/tuning.py), in
scenes of held_out.py, too. Printed is the part of paths' noise that stays each point's own, in the mean
over blocks; of each method the variance without sharing over that with it, the seconds likewise, and
the product of both: above 1 sharing pays.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import numpy as np
from bench_tuning import set_to
from crossover import Curve
from held_out import HELD_OUT
from rooms import ROOMS
from training import SCENES

import ncv_cl as ncv
from ncv_cl.estimation.pilot import DARK_SHARE
from ncv_cl.opencl.choose import choose_device
from ncv_cl.opencl.device import Device
from ncv_cl.sampling.own_noise import OwnNoise

SHIPPED = ("cornell_box", "interior")
BASE = {"method": "mc", "split_direct": "off"}
OTHERS = {
    "auto": {"method": "auto"},
    "mc": {"method": "mc"},
    "ncv, relative": {"method": "ncv", "allocation": "relative"},
}
# What the report shows; others are measured by name.
CASES = (*SHIPPED, "office", "door")
ALLOCATIONS = {
    name: {"method": "ncv", "allocation": name} for name in ("uniform", "magnitude", "relative")
}
ERRORS = ("mse", "relative")
# By MOST_OWN: none, or all.
SHARING = {"alone": 0.0, "shared": 1.0}
SHARERS = (*SHIPPED, "occluders", "knot", *ROOMS, "polished room", "rough room", "room, 4 lamps")
SHARERS = (*SHARERS, "terrain", "foliage")


class Case:
    """A scene, and renders of it."""

    def __init__(self, device: Device, name: str, size: int, seeds: int) -> None:
        self.name, self._seeds = name, seeds
        made = {**ROOMS, **HELD_OUT}
        self._scene = made[name]() if name in made else ncv.load_scene(SCENES / f"{name}.toml")
        self._common = {"integrand": "gi", "size": (size, size), "device": device}

    def measure(self, wanted: dict[tuple[str, int], dict[str, object]]) -> dict[tuple[str, int], dict]:
        """Seconds and errors by name and samples, all seeds of all in turns."""
        runs: dict[tuple[str, int], list[tuple[float, np.ndarray]]] = {key: [] for key in wanted}
        for (_, spp), options in wanted.items():
            self._render(min(spp, 4), 0, **options)
        for seed in range(1, self._seeds + 1):
            for (name, spp), own in runs.items():
                began = time.process_time()
                image = self._render(spp, seed, **wanted[name, spp])
                own.append((time.process_time() - began, image.pixels.astype(np.float64)))
        value = np.mean([pixels for own in runs.values() for _, pixels in own], axis=0)
        scale = np.maximum(value, 0) + DARK_SHARE * value.mean()
        found = {}
        for (name, spp), own in runs.items():
            variance = np.var([pixels for _, pixels in own], axis=0, ddof=1)
            found[name, spp] = {
                "spp": spp,
                "seconds": min(seconds for seconds, _ in own),
                "mse": float(variance.mean()),
                "relative": float((variance / scale**2).mean()),
                "least": float(min(pixels.min() for _, pixels in own)),
            }
        return found

    def _render(
        self, spp: int, seed: int, most_own: float | None = None, **options: object
    ) -> ncv.Image:
        """A render, by another MOST_OWN where that is given."""
        options = {"spp": spp, "seed": seed, **self._common, **options}
        if most_own is None:
            return ncv.render(self._scene, **options)
        with set_to("MOST_OWN", most_own):
            return ncv.render(self._scene, **options)

    def own_parts(self) -> list[float]:
        """What sharing leaves of the noise of each block of points."""
        found: list[float] = []
        part = OwnNoise.part

        def seen(own: OwnNoise, *of: object) -> float:
            found.append(part(own, *of))
            return found[-1]

        OwnNoise.part = seen
        try:
            self._render(4, 0, method="mc")
        finally:
            OwnNoise.part = part
        return found


def to_equal_error(case: Case, spp: int) -> dict[str, float]:
    """Print and return seconds of the base over those of others, to each of its errors."""
    wanted = {("base", spp): BASE}
    for name, options in OTHERS.items():
        wanted |= {(name, n): options for n in (spp // 4, spp)}
    found = case.measure(wanted)
    base, gains = found["base", spp], {}
    for name in OTHERS:
        for error in ERRORS:
            rows = [
                row | {"mse": row[error], "stages": {}} for (n, _), row in found.items() if n == name
            ]
            gains[f"{name} {error}"] = base["seconds"] / float(Curve.of(rows).seconds_to(base[error])[0])
    cells = ", ".join(f"{name} {gain:.2f}" for name, gain in gains.items())
    print(f"{case.name:12} base {base['seconds']:.2f} s, over: {cells}", flush=True)
    return gains


def compare_allocations(case: Case, spp: int) -> dict[str, float]:
    """Print and return the base's errors times seconds over those by each allocation."""
    found = case.measure({("base", 2 * spp): BASE} | {(n, spp): o for n, o in ALLOCATIONS.items()})
    base, gains = found["base", 2 * spp], {}
    for name in ALLOCATIONS:
        row = found[name, spp]
        for error in ERRORS:
            gains[f"{name} {error}"] = base[error] * base["seconds"] / (row[error] * row["seconds"])
        gains[f"{name} least"] = row["least"]
    print(f"{case.name:12} " + ", ".join(f"{n} {gain:.3g}" for n, gain in gains.items()), flush=True)
    return gains


def compare_sharing(case: Case, spp: int) -> dict[str, float]:
    """Print and return the part that stays each point's own, and what sharing does by method."""
    wanted = {
        (f"{method} {name}", spp): {"method": method, "most_own": most}
        for method in ("mc", "ncv")
        for name, most in SHARING.items()
    }
    found, gains = case.measure(wanted), {"own": float(np.mean(case.own_parts()))}
    for method in ("mc", "ncv"):
        alone, shared = (found[f"{method} {name}", spp] for name in SHARING)
        for name in ("mse", "seconds"):
            gains[f"{method} {name}"] = alone[name] / shared[name]
        gains[f"{method} gain"] = gains[f"{method} mse"] * gains[f"{method} seconds"]
    print(f"{case.name:14} " + ", ".join(f"{n} {gain:.2f}" for n, gain in gains.items()), flush=True)
    return gains


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("cases", nargs="*", metavar="SCENE", help=f"default: {', '.join(CASES)}")
    parser.add_argument("--quick", action="store_true", help="one scene, small, few samples")
    parser.add_argument("--spp", type=int, help="default: 512, of allocations 128, of sharing 64")
    parser.add_argument("--size", type=int, default=80, help="points a side (default %(default)s)")
    parser.add_argument("--seeds", type=int, default=2, help="renders of each (default %(default)s)")
    other = parser.add_mutually_exclusive_group()
    other.add_argument("--allocations", action="store_true", help="compare allocations instead")
    other.add_argument("--sharing", action="store_true", help="with shared paths, and without, instead")
    parser.add_argument("--json", metavar="FILE", help="write the results here")
    parser.add_argument("--device", metavar="D", help="as for ncv-cl render")
    options = parser.parse_args()
    device = choose_device(options.device)
    print(device.identity)
    function, spp, cases = to_equal_error, 512, CASES
    if options.allocations:
        function, spp = compare_allocations, 128
    if options.sharing:
        function, spp, cases = compare_sharing, 64, SHARERS
    results = {}
    if options.quick:
        options.cases, options.size, options.spp = SHIPPED[:1], 24, 32
    for name in options.cases or cases:
        case = Case(device, name, options.size, options.seeds)
        results[name] = function(case, options.spp or spp)
    for number in next(iter(results.values())):
        own = [found[number] for found in results.values()]
        if min(own) > 0:
            print(f"{number}: mean {np.exp(np.log(own).mean()):.2f}, least {min(own):.2f}")
    if options.json:
        found = {"device": device.identity, "size": options.size, "cases": results}
        Path(options.json).write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
