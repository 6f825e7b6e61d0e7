"""Ambient occlusion by slices against rays: error by number, and processor time to equal error.

    python bench/bench_slices.py errors    mean square error by samples, and its exponent
    python bench/bench_slices.py equal     processor seconds to the error of 1024 and 4096 Sobol rays
    python bench/bench_slices.py constants processor time a slice, and slices refused, by the constants
    python bench/bench_slices.py build     seconds to build the boxes, beside embree's, by triangles

Renders are timed by turns; of processor seconds the least count. The reference is made of 2048 slices,
and is compared with 4096 rays before anything is measured.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace

import numpy as np
from training import SCENES
from visibility_case import Case

import ncv_cl as ncv
from ncv_cl.host.clock import Stopwatch
from ncv_cl.opencl.choose import choose_device
from ncv_cl.points.trace import Tracer
from ncv_cl.rendering.prepare import prepare
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
LADDER = (8, 16, 24, 32, 48, 64, 96, 128, 192, 256, 384, 512)


def errors(case: Case, seeds: int) -> None:
    for visibility, numbers in (("embree", RAYS), ("lines", SLICES)):
        case.print_errors(visibility, numbers, seeds)


def equal(case: Case, rounds: int) -> None:
    for rays in (1024, 4096):
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


def drawing(name: str, size: int, rounds: int) -> tuple[float, int]:
    """Least processor nanoseconds of 64 slices a point, each, and how many of a draw were refused."""
    scene, spp, least = ncv.load_scene(SCENES / f"{name}.toml"), 64, np.inf
    settings = Settings(ncv.AmbientOcclusion(), "mc", spp, (size, size), 0, Sampling(visibility="lines"))
    problem = prepare(choose_device(None), scene, settings, None, Stopwatch())
    for _ in range(rounds):
        problem.source.rays.off_lines = 0
        started = time.process_time()
        for part, samples in problem.source.parts(range(problem.points.active), range(spp)):
            problem.source.draw(part, samples, 0)
        least = min(least, time.process_time() - started)
    return 1e9 * least / (spp * problem.points.active), problem.source.rays.off_lines


def constants(size: int, rounds: int) -> None:
    for constant, values in CONSTANTS:
        chosen = getattr(tuning, constant)
        for value in values:
            setattr(tuning, constant, value)
            row = [f"{name} %.0f ns, %d refused" % drawing(name, size, rounds) for name in NAMES]
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


def cut_in_four(scene: ncv.Scene) -> ncv.Scene:
    """Every triangle by the middles of its edges; no corner is shared."""
    a, b, c = scene.vertices[scene.triangles].transpose(1, 0, 2)
    ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
    corners = np.stack([a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca], axis=1).reshape(-1, 3)
    indices = np.arange(len(corners), dtype=np.uint32).reshape(-1, 3)
    return replace(
        scene,
        vertices=corners,
        vertex_normals=np.zeros_like(corners),
        triangles=indices,
        triangle_material=np.repeat(scene.triangle_material, 4),
        triangle_light=np.repeat(scene.triangle_light, 4),
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("part", choices=("errors", "equal", "constants", "build"))
    parser.add_argument("--scenes", nargs="+", default=NAMES)
    parser.add_argument("--size", type=int, default=96)
    parser.add_argument("--rounds", type=int, default=3, help="seeds, or timed runs of each")
    options = parser.parse_args()
    if options.part == "build":
        build(options.rounds)
        return
    if options.part == "constants":
        constants(options.size, options.rounds)
        return
    for name in options.scenes:
        {"errors": errors, "equal": equal}[options.part](
            Case(name, "ao", options.size, 2048), options.rounds
        )


if __name__ == "__main__":
    main()
