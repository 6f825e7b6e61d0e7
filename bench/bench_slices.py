"""Ambient occlusion by slices against rays: error by number, and processor time to equal error.

    python bench/bench_slices.py errors    mean square error by samples, and its exponent
    python bench/bench_slices.py equal     processor seconds to the error of 1024 and 4096 Sobol rays
    python bench/bench_slices.py auto      choices of visibility "auto", and what they cost
    python bench/bench_slices.py network   what a control variate takes off the error of few slices
    python bench/bench_slices.py cost      what a slice costs in rays, and what slices.py takes it for
    python bench/bench_slices.py constants processor time a slice, and slices refused, by the constants
    python bench/bench_slices.py build     seconds to build the boxes, beside embree's, by triangles

Renders are timed by turns; of processor seconds the least count. The reference is made of 2048 slices,
and is compared with 4096 rays before anything is measured. A ratio of `auto` is the seconds of
rays or slices, whichever reach its error sooner, over its own: 1 is best. The default, `equal`, is what
the report shows; `--quick` and `--json` are for it.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from bench_lines import network
from crossover import Curve, against_the_better
from training import SCENES
from visibility_case import Case, cut_in_four

import ncv_cl as ncv
from ncv_cl.host.clock import Stopwatch
from ncv_cl.opencl.choose import choose_device
from ncv_cl.points.trace import Tracer
from ncv_cl.rendering.prepare import prepare
from ncv_cl.sampling.problem import Problem
from ncv_cl.settings.options import Sampling
from ncv_cl.settings.settings import Settings
from ncv_cl.visibility import tuning
from ncv_cl.visibility.slices import Slices

NAMES = ("knot", "occluders")
RAYS, SLICES = (64, 256, 1024), (16, 32, 64, 128)
CONSTANTS = (
    ("MOST_BLOCKED", (4, 8, 16, 32)),
    ("SAMPLED_TRIANGLES", (16, 64, 256)),
)
# Samples a point of `auto`, and of what it is compared with; numbers of slices.
ASKED = (4, 16, 32, 64, 128, 256, 512, 1024)
TAKEN = (2, 4, 8, 16, 32, 64, 128, 256)
# Scenes of `auto`, and radii over their diagonals. By an infinite radius nothing is open in `interior`.
RADII = {
    "cornell_box": (math.inf, 0.1),
    "interior": (0.1, 0.03),
    "knot": (math.inf, 0.1),
    "occluders": (math.inf, 0.1),
}
# Rays whose errors slices are to reach.
TARGETS, QUICK_TARGETS = (1024, 4096), (64,)
LADDER = (8, 16, 24, 32, 48, 64, 96, 128, 192, 256, 384, 512)


def errors(case: Case, seeds: int) -> None:
    for visibility, numbers in (("embree", RAYS), ("lines", SLICES)):
        case.print_errors(visibility, numbers, seeds)


def equal(case: Case, rounds: int, targets: tuple[int, ...] = TARGETS) -> list[dict]:
    """Print and return a row for each number of rays: slices to the same error, and seconds of both."""
    rows = []
    for rays in targets:
        goal = case.error(case.render("embree", rays, 5))
        for number in LADDER:
            reached = case.error(case.render("lines", number, 5))
            if reached <= goal:
                break
        least = dict.fromkeys(("embree", "lines"), np.inf)
        for seed in range(rounds):
            for visibility, spp in (("embree", rays), ("lines", number)):
                started = time.process_time()
                case.render(visibility, spp, seed)
                least[visibility] = min(least[visibility], time.process_time() - started)
        print(
            f"  error of {rays} rays {goal:.2e}: {number} slices ({reached:.2e}); processor "
            f"{least['embree']:.2f} / {least['lines']:.2f} = {least['embree'] / least['lines']:.2f}",
            flush=True,
        )
        rows.append({
            "scene": case.name, "rays": rays, "slices": number, "mse": goal, "mse_of_slices": reached,
            "processor_seconds": least["embree"], "processor_seconds_of_slices": least["lines"],
            "ratio": least["embree"] / least["lines"],
        })  # fmt: skip
    return rows


def diagonal(scene: ncv.Scene) -> float:
    return float(np.linalg.norm(np.ptp(scene.vertices[scene.triangles].reshape(-1, 3), axis=0)))


def auto(names: Sequence[str], size: int, rounds: int, sampler: str) -> None:
    """The choices of "auto" by samples; each way's curve of errors and seconds is measured as well."""
    for name in names:
        for share in RADII[name]:
            radius = share * diagonal(ncv.load_scene(SCENES / f"{name}.toml"))
            case = Case(name, ncv.AmbientOcclusion(radius), size, 2048)
            asked = {"points": ASKED, "lines": TAKEN, "auto": ASKED}
            found = measured(case, asked, rounds, sampler)
            curves = {way: Curve.of(found[way]) for way in ("points", "lines")}
            for row in against_the_better(found["auto"], curves):
                ratios = ", ".join(f"{way} {ratio:.2f}" for way, ratio in row["ratios"].items())
                print(
                    f"  radius {share:.2g} {sampler} {row['spp']}: {row['method']}; "
                    f"ratio {row['ratio']:.2f} ({ratios})",
                    flush=True,
                )


def measured(
    case: Case, asked: dict[str, tuple[int, ...]], rounds: int, sampler: str
) -> dict[str, list[dict]]:
    """Rows of each way by its numbers of samples, as `Curve` takes them; all are rendered in turn."""
    every = [(way, number) for way, numbers in asked.items() for number in numbers]
    seconds, errors, slices = ({one: [] for one in every} for _ in range(3))
    for seed in range(rounds + 1):
        for one in every:
            started = time.process_time()
            image = case.render(*one, seed, sampler=sampler)
            # The first turn compiles kernels.
            if seed > 0:
                seconds[one].append(time.process_time() - started)
                errors[one].append(case.error(image))
                slices[one].append(image.stats.get("slices", {}).get("a_point", 0))
    found: dict[str, list[dict]] = {way: [] for way in asked}
    for way, number in every:
        own = seconds[way, number]
        taken = slices[way, number][0]
        found[way].append({
            "spp": number,
            "seconds": min(own),
            "seconds_range": (min(own), max(own)),
            "mse": float(np.mean(errors[way, number])),
            "stages": {},
            "method": f"{taken} slices" if taken else "rays",
        })  # fmt: skip
    return found


def costs(size: int, rounds: int) -> None:
    """What draws take of slices and of rays, in the shipped scenes and of their triangles in four."""
    for name, radii in RADII.items():
        scene = ncv.load_scene(SCENES / f"{name}.toml")
        for cuts in range(3):
            for share in radii:
                integrand = ncv.AmbientOcclusion(share * diagonal(scene))
                slices, problem = draw_time(scene, integrand, "lines", size, 16, rounds)
                rays, _ = draw_time(scene, integrand, "embree", size, 64, rounds)
                cost = Slices(problem.device, scene).cost(problem.points, integrand.radius)
                print(
                    f"{name} {len(scene.triangles)}, radius {share:.2g}: slice {slices:.0f} ns, "
                    f"ray {rays:.0f} ns, ratio {slices / rays:.1f}; {cost.leaves:.1f} leaves, "
                    f"taken for {cost.rays:.1f} rays, {cost.refused:.4f} refused",
                    flush=True,
                )
            if cuts < 2:
                scene = cut_in_four(scene)


def draw_time(
    scene: ncv.Scene, integrand: ncv.AmbientOcclusion, visibility: str, size: int, spp: int, rounds: int
) -> tuple[float, Problem]:
    """Least processor nanoseconds of a sample, of `spp` a point; and what was drawn."""
    least = np.inf
    settings = Settings(integrand, "mc", spp, (size, size), 0, Sampling(visibility=visibility))
    problem = prepare(choose_device(None), scene, settings, None, Stopwatch())
    for _ in range(rounds):
        problem.source.rays.off_lines = 0
        started = time.process_time()
        for part, samples in problem.source.parts(range(problem.points.active), range(spp)):
            problem.source.draw(part, samples, 0)
        least = min(least, time.process_time() - started)
    return 1e9 * least / (spp * problem.points.active), problem


def constants(size: int, rounds: int) -> None:
    for constant, values in CONSTANTS:
        chosen = getattr(tuning, constant)
        for value in values:
            setattr(tuning, constant, value)
            row = []
            for name in NAMES:
                scene = ncv.load_scene(SCENES / f"{name}.toml")
                time_each, problem = draw_time(scene, ncv.AmbientOcclusion(), "lines", size, 64, rounds)
                row.append(f"{name} {time_each:.0f} ns, {problem.source.rays.off_lines} refused")
            print(f"{constant} {value}: {'; '.join(row)}", flush=True)
        setattr(tuning, constant, chosen)


def build(rounds: int) -> None:
    device = choose_device(None)
    scene = ncv.load_scene(SCENES / "occluders.toml")
    for cuts in range(4):
        least = dict.fromkeys((Slices, Tracer), np.inf)
        for _ in range(rounds):
            for kind, arguments in ((Slices, (device, scene)), (Tracer, (scene,))):
                started = time.process_time()
                kind(*arguments)
                least[kind] = min(least[kind], time.process_time() - started)
        print(
            f"{len(scene.triangles)} triangles: boxes {least[Slices]:.3f} s, "
            f"embree {least[Tracer]:.3f} s",
            flush=True,
        )
        if cuts < 3:
            scene = cut_in_four(scene)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parts = {"errors": errors, "network": network}
    whole: dict[str, Callable[[argparse.Namespace], None]] = {
        "auto": lambda options: auto(
            options.scenes or tuple(RADII), options.size, options.rounds, options.sampler
        ),
        "cost": lambda options: costs(options.size, options.rounds),
        "constants": lambda options: constants(options.size, options.rounds),
        "build": lambda options: build(options.rounds),
        "equal": _equal,
    }
    parser.add_argument("part", nargs="?", choices=(*parts, *whole), default="equal")
    parser.add_argument("--scenes", nargs="+", choices=tuple(RADII))
    parser.add_argument("--size", type=int, default=96)
    parser.add_argument("--rounds", type=int, default=3, help="seeds, or timed runs of each")
    parser.add_argument("--sampler", choices=("sobol", "independent"), default="sobol")
    parser.add_argument("--quick", action="store_true", help="`equal` in one scene, small")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the rows of `equal` here")
    options = parser.parse_args()
    if options.part in whole:
        whole[options.part](options)
        return
    for name in options.scenes or NAMES:
        parts[options.part](Case(name, "ao", options.size, 2048), options.rounds)


def _equal(options: argparse.Namespace) -> None:
    names, size, rounds, reference = options.scenes or NAMES, options.size, options.rounds, 2048
    targets = QUICK_TARGETS if options.quick else TARGETS
    if options.quick:
        names, size, rounds, reference = NAMES[:1], 24, 1, 256
    rows = [
        row
        for name in names
        for row in equal(Case(name, "ao", size, reference, judged=2 * reference), rounds, targets)
    ]
    if options.json:
        found = {"device": choose_device(None).identity, "size": size, "rows": rows}
        options.json.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
