"""Direct light along lines against points: error by number, seconds to equal error, and tuned constants.

    python bench/bench_lines.py errors       mean square error by samples, and its exponent
    python bench/bench_lines.py equal        seconds to the error of 1024 and 4096 Sobol points (default)
    python bench/bench_lines.py network      what a control variate takes off the error of few lines
    python bench/bench_lines.py constants    processor time a line by constants of visibility/tuning.py
    python bench/bench_lines.py large        scenes of many triangles: from how many samples lines pay
    python bench/bench_lines.py rates        million lines and slices a second, in both shapes

Renders are timed by turns; of wall clock and processor seconds the medians count. The reference is made
of 8192 lines, and is compared with 4096 points that embree traced before anything is measured; in large
scenes of 1024 and 512. Of these are the shipped ones whose triangles are cut, and mesh files on a plane
(--meshes). `--quick` and `--json` are those of `equal`, the only one whose numbers the report shows.
"""

from __future__ import annotations

import argparse
import json
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from training import SCENES
from visibility_case import Case, cut_in_four

import ncv_cl as ncv
from ncv_cl.host.clock import Stopwatch
from ncv_cl.integrands import DirectLight, Integrand
from ncv_cl.opencl.choose import choose_device
from ncv_cl.opencl.device import GPU_LANES, Device, open_device
from ncv_cl.rendering.prepare import prepare
from ncv_cl.sampling.problem import Problem
from ncv_cl.settings.options import Sampling
from ncv_cl.settings.settings import Settings
from ncv_cl.visibility import tuning

NAMES = ("cornell_box", "occluders", "knot", "interior")
NUMBERS = (16, 64, 256, 1024)
LADDER = (16, 24, 32, 48, 64, 80, 96, 128, 160, 192, 256, 320, 384, 512, 768, 1024)
# Shipped scenes that are cut, and least numbers of triangles to which scenes are cut.
LARGE_NAMES = ("occluders", "knot")
LEAST_TRIANGLES = (1, 100_000, 500_000)
MESH_SCENE = """
[camera]
position = [0, 1.6, 3.2]
target = [0, 0.5, 0]
vertical_fov = 40
[materials.grey]
albedo = 0.5
[[quads]]
corner = [-6, 0, -6]
edge1 = [0, 0, 12]
edge2 = [12, 0, 0]
material = "grey"
[[meshes]]
file = "{file}"
material = "grey"
scale = {scale}
translate = [{x}, {y}, {z}]
[[lights]]
corner = [-1.5, 3.5, -1]
edge1 = [2, 0, 0]
edge2 = [0, 0, 2]
radiance = [14, 13, 11]
"""
FEW_LINES = (4, 8, 16, 32, 64, 128, 256)
CONSTANTS = {
    "MOST_GAPS": (2, 4, 8, 16),
    "LINE_BLOCKS": (4, 8, 16, 32),
    "SORTED_FROM": (2, 6, 12, 24, 48),
}


# Points whose errors lines are to reach.
TARGETS, QUICK_TARGETS = (1024, 4096), (64,)


def errors(case: Case, seeds: int) -> None:
    for visibility in ("embree", "lines"):
        case.print_errors(visibility, NUMBERS, seeds)


def equal(case: Case, rounds: int, targets: tuple[int, ...] = TARGETS) -> list[dict]:
    """Print and return a row for each number of points: lines to the same error, and seconds of both."""
    known: dict[int, float] = {}
    rows = []
    for points in targets:
        goal = case.error(case.render("points", points, 5))
        for number in LADDER:
            known.setdefault(number, case.error(case.render("lines", number, 5)))
            if known[number] <= goal:
                break
        rivals = {"points": points, "lines": number}
        seconds = {name: [] for name in rivals}
        for seed in range(rounds):
            for name, spp in rivals.items():
                started = time.perf_counter(), time.process_time()
                stages = case.render(name, spp, seed).stats["seconds"]
                ended = time.perf_counter(), time.process_time()
                seconds[name].append((ended[0] - started[0], ended[1] - started[1]))
        (wall, processor), ours = (
            [statistics.median(one) for one in zip(*seconds[name], strict=True)] for name in rivals
        )
        print(
            f"  error of {points} points {goal:.2e}: {number} lines ({known[number]:.2e}); "
            f"wall {wall:.2f} / {ours[0]:.2f} = {wall / ours[0]:.1f}, "
            f"processor {processor:.2f} / {ours[1]:.2f} = {processor / ours[1]:.1f}"
        )
        print("    of lines:", {k: round(v, 3) for k, v in stages.items() if v >= 1e-3}, flush=True)
        rows.append({
            "scene": case.name, "points": points, "lines": number, "mse": goal,
            "mse_of_lines": known[number], "processor_seconds": processor,
            "processor_seconds_of_lines": ours[1], "ratio": processor / ours[1],
            "ratio_of_wall_clock": wall / ours[0],
        })  # fmt: skip
    return rows


def network(case: Case, seeds: int) -> None:
    methods = {
        "mc": {},
        "ncv, uniform": {"method": "ncv", "density": "none", "allocation": "uniform", "train_spp": 16},
        "ncv": {"method": "ncv", "train_spp": 16},
    }
    for sampler in ("sobol", "independent"):
        for spp in (4, 16, 64):
            row = []
            for name, options in methods.items():
                started = time.process_time()
                images = [
                    case.render("lines", spp, s, **{"sampler": sampler, **options}) for s in range(seeds)
                ]
                seconds = (time.process_time() - started) / seeds
                row.append(f"{name} {np.mean([case.error(i) for i in images]):.2e} ({seconds:.2f} s)")
            print(f"  {sampler} {spp}: {'; '.join(row)}", flush=True)


def prepared(
    scene: ncv.Scene,
    size: int,
    visibility: str = "lines",
    integrand: Integrand | None = None,
    device: Device | None = None,
) -> tuple[Problem, float]:
    """A scene's problem, and processor seconds to prepare it; of direct light by default."""
    integrand = integrand or DirectLight()
    settings = Settings(integrand, "mc", 1, (size, size), 0, Sampling(visibility=visibility))
    started = time.process_time()
    problem = prepare(device or choose_device(None), scene, settings, None, Stopwatch())
    return problem, time.process_time() - started


def drawing(problem: Problem, spp: int, rounds: int) -> tuple[float, float]:
    """Least processor nanoseconds a sample, and what part of the samples no line was found for."""
    source, least = problem.source, np.inf
    for _ in range(rounds):
        started = time.process_time()
        for part, samples in source.parts(range(problem.points.active), range(spp)):
            source.draw(part, samples, 0)
        least = min(least, time.process_time() - started)
    rays = source.rays
    return 1e9 * least / (spp * problem.points.active), rays.off_lines / max(rays.on_device, 1)


def constants(size: int, rounds: int) -> None:
    for constant, values in CONSTANTS.items():
        chosen = getattr(tuning, constant)
        for value in values:
            setattr(tuning, constant, value)
            row = []
            for name in NAMES[:3]:
                for spp in (64, 256):
                    scene = ncv.load_scene(SCENES / f"{name}.toml")
                    nanoseconds, refused = drawing(prepared(scene, size)[0], spp, rounds)
                    row.append(f"{name} {spp}: {nanoseconds:.1f} ns, {refused:.0e} refused")
            print(f"{constant} {value}: {'; '.join(row)}", flush=True)
        setattr(tuning, constant, chosen)


def rates(size: int, rounds: int) -> None:
    """Processor time counts, so a rate is that of one core."""
    cpu = choose_device(None)
    gpu_shape = open_device(cpu.cl_device, cpu.index, 1, GPU_LANES)
    for device in (cpu, gpu_shape):
        print(f"VEC {device.vector_width}, LANES {device.lanes}, million a second of one core:")
        for name in NAMES:
            scene, row = ncv.load_scene(SCENES / f"{name}.toml"), []
            for what, integrand in (("lines", DirectLight()), ("slices", ncv.AmbientOcclusion())):
                problem = prepared(scene, size, "lines", integrand, device)[0]
                for spp in (16, 64, 256):
                    row.append(f"{what} {spp}: {1e3 / drawing(problem, spp, rounds)[0]:.2f}")
            print(f"  {name} {', '.join(row)}", flush=True)


def large_scenes(meshes: list[Path]) -> Iterator[tuple[str, ncv.Scene]]:
    shipped = {name: ncv.load_scene(SCENES / f"{name}.toml") for name in LARGE_NAMES}
    for name, scene in {**shipped, **{mesh.stem: on_a_plane(mesh) for mesh in meshes}}.items():
        for least in LEAST_TRIANGLES:
            while len(scene.triangles) < least:
                scene = cut_in_four(scene)
            yield name, scene


def on_a_plane(mesh: Path) -> ncv.Scene:
    """A mesh of extent one on a plane, under a light."""
    with mesh.open(encoding="utf-8") as lines:
        corners = np.array([line.split()[1:4] for line in lines if line.startswith("v ")], float)
    lower, upper = corners.min(axis=0), corners.max(axis=0)
    scale = 1 / (upper - lower).max()
    move = -scale * (lower + upper) / 2
    move[1] = -scale * lower[1]
    places = dict(zip("xyz", move, strict=True))
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "scene.toml")
        text = MESH_SCENE.format(file=mesh.resolve(), scale=scale, **places)
        file.write_text(text, encoding="utf-8")
        return ncv.load_scene(file, allow_outside=True)


def large(name: str, scene: ncv.Scene, size: int, rounds: int) -> None:
    """Lists, seconds, and from how many samples a point on lines reach their error before points do."""
    kinds = ("embree", "points", "lines")
    found = {kind: prepared(scene, size, kind) for kind in kinds}
    occluders = found["lines"][0].source.occluders
    every = np.arange(found["lines"][0].points.active)
    print(
        f"{name}, {len(scene.triangles)} triangles: {occluders.unknown} of {len(every)} points without "
        f"a list, {occluders.mean_count:.0f} occluders on average; prepared in "
        + ", ".join(f"{found[kind][1]:.2f} s ({kind})" for kind in kinds),
        flush=True,
    )
    case = Case(name, "direct", size, 1024, scene, 512)
    errors = [case.error(case.render("points", number, 5)) for number in NUMBERS]
    ratios = []
    for spp in FEW_LINES:
        error = np.mean([case.error(case.render("lines", spp, seed)) for seed in range(2)])
        # As many points as have this error; beyond those measured by their power.
        points = np.exp(np.interp(-np.log(error), -np.log(errors), np.log(NUMBERS)))
        points *= max(1.0, errors[-1] / error) ** (1 / 1.5)
        took = {kind: drawing(found[kind][0], spp, rounds)[0] for kind in kinds}
        ratios.append(points * min(took["embree"], took["points"]) / (spp * took["lines"]))
        row = ", ".join(f"{kind} {took[kind]:.0f} ns" for kind in kinds)
        print(f"  {spp} a point: {row}; lines have the error of {points:.0f} points: {ratios[-1]:.2f}")
    enough = np.exp(np.interp(0.0, np.log(ratios), np.log(FEW_LINES)))
    print(f"  lines pay from {enough:.0f} samples: {occluders.mean_count / enough:.0f} occluders each")


def main() -> None:
    parts: dict[str, Callable[[Case, int], None]] = {"errors": errors, "network": network}
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    every = ("equal", *parts, "constants", "large", "rates")
    parser.add_argument("part", nargs="?", choices=every, default="equal")
    parser.add_argument("--scenes", nargs="+", default=NAMES)
    parser.add_argument("--meshes", nargs="*", type=Path, default=[], help="OBJ files for `large`")
    parser.add_argument("--size", type=int, default=96)
    parser.add_argument("--rounds", type=int, default=3, help="seeds, or timed renders of each")
    parser.add_argument("--quick", action="store_true", help="`equal` in one scene, small")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the rows of `equal` here")
    options = parser.parse_args()
    if options.part == "equal":
        _equal(options)
        return
    if options.part in ("constants", "rates"):
        {"constants": constants, "rates": rates}[options.part](options.size, options.rounds)
        return
    if options.part == "large":
        for name, scene in large_scenes(options.meshes):
            large(name, scene, options.size, options.rounds)
        return
    for name in options.scenes:
        parts[options.part](Case(name, "direct", options.size, 8192), options.rounds)


def _equal(options: argparse.Namespace) -> None:
    names, size, rounds, reference = options.scenes, options.size, options.rounds, 8192
    targets = QUICK_TARGETS if options.quick else TARGETS
    if options.quick:
        names, size, rounds, reference = NAMES[:1], 24, 1, 512
    rows = [
        row
        for name in names
        for row in equal(Case(name, "direct", size, reference, judged=reference // 2), rounds, targets)
    ]
    if options.json:
        found = {"device": choose_device(None).identity, "size": size, "rows": rows}
        options.json.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
