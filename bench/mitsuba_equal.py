"""Seconds to the error of Mitsuba's 1024 samples: direct light, a white sky, global illumination.

    DRJIT_LIBLLVM_PATH=libLLVM.so python bench/mitsuba_equal.py

Mitsuba needs an LLVM of 16 or newer; that of a Rust toolchain will do. It has no ambient occlusion, and
renders white Lambert surfaces under a sky of radiance 1 instead, paths of one bounce. Its images are
drawn in its usual way, by independent samples with one camera ray each, and by multi-jittered samples,
in passes of 64. Ours are those of `auto`, for both method and visibility. Counted are whole calls on
loaded scenes with compiled kernels, in turn; of elapsed and of processor seconds the least. An error is
the mean variance of pixels over seeds, of the same integrals in both, those of camera rays through
pixels' centres.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from compare_mitsuba import DIRECT, PATH, SCENES, SKY, limit_threads, our_integrand
from crossover import Curve
from mitsuba_scene import MitsubaScene, import_mitsuba
from mitsuba_speed import in_passes
from rooms import ROOMS

import ncv_cl as ncv
from ncv_cl.opencl.choose import choose_device
from ncv_cl.opencl.device import Device

CASES = (
    ("cornell_box", "direct"),
    ("occluders", "direct"),
    ("cornell_box", "ao"),
    ("occluders", "ao"),
    ("knot", "ao"),
    ("cornell_box", "gi"),
    ("interior", "gi"),
    ("office", "gi"),
    ("white", "gi"),
)
SAMPLERS = ("independent", "multijitter")
TARGET, A_PASS = 1024, 64
OUR_SAMPLES = {"direct": (4, 8, 16, 32, 64, 128), "ao": (16, 64, 128, 256, 512, 1024)}
OUR_SAMPLES["gi"] = (4, 16, 64, 128)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", type=int, default=128, help="pixels a side")
    parser.add_argument("--rounds", type=int, default=3, help="images of each kind")
    parser.add_argument("--threads", type=int, default=2, help="threads for either (default 2)")
    parser.add_argument("--case", action="append", metavar="SCENE:INTEGRAND", help="default: all")
    parser.add_argument("--device", metavar="D", help="as for ncv-cl render")
    parser.add_argument("--json", metavar="FILE", help="write the results here")
    options = parser.parse_args()
    limit_threads(options.threads)
    mitsuba = import_mitsuba()
    if mitsuba is None or not mitsuba.variant().startswith("llvm"):
        print("this needs Mitsuba and LLVM 16 or newer: pip install mitsuba, and set DRJIT_LIBLLVM_PATH")
        return 2
    device = choose_device(options.device)
    print(f"Mitsuba {mitsuba.__version__} {mitsuba.variant()}, {options.threads} threads")
    print(device.identity)
    rows = []
    for name, integrand in [tuple(case.split(":")) for case in options.case or ()] or CASES:
        scene = ROOMS[name]() if name in ROOMS else ncv.load_scene(SCENES / f"{name}.toml")
        theirs = MitsubaScene(mitsuba, scene, white_under_sky=integrand == "ao")
        rows += compare(theirs, name, integrand, options.size, options.rounds, device)
    if options.json:
        report = {"mitsuba": mitsuba.__version__, "variant": mitsuba.variant(), "rows": rows}
        report |= {"device": device.identity, "threads": options.threads, "size": options.size}
        Path(options.json).write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    return 0


def compare(
    theirs: MitsubaScene, name: str, integrand: str, size: int, rounds: int, device: Device
) -> list[dict]:
    """A row for each of Mitsuba's samplers: both renderers' seconds to its error."""
    method = {"direct": DIRECT, "ao": SKY, "gi": PATH}[integrand]
    shape = (size, size)

    def ours(spp: int, seed: int) -> np.ndarray:
        image = ncv.render(
            theirs.source, our_integrand(integrand), spp=spp, size=shape, seed=seed, device=device
        )
        return image.pixels

    works: dict[str, Callable[[int], object]] = {
        sampler: in_passes(theirs, method, sampler, shape, TARGET, A_PASS) for sampler in SAMPLERS
    }
    for spp in OUR_SAMPLES[integrand]:
        works[f"ours {spp}"] = lambda seed, spp=spp: ours(spp, seed)
    wall, processor, images = timed(works, rounds)
    errors = {key: float(np.var(images[key], axis=0, ddof=1).mean()) for key in works if "ours" in key}
    rows = []
    for sampler in SAMPLERS:
        stack = [theirs.radiance(method, shape, 1, TARGET, seed, sampler) for seed in range(rounds)]
        error = float(np.var(stack, axis=0, ddof=1).mean())
        row = {"scene": name, "integrand": integrand, "sampler": sampler, "mse": error}
        line = f"{name} {integrand}, error {error:.2e} of {TARGET} {sampler}:"
        for kind, seconds in (("wall", wall), ("processor", processor)):
            points = [
                {"spp": n, "seconds": seconds[f"ours {n}"], "mse": errors[f"ours {n}"], "stages": {}}
                for n in OUR_SAMPLES[integrand]
            ]
            needed = float(Curve.of(points).seconds_to(error)[0])
            row[kind] = {"mitsuba": seconds[sampler], "ours": needed}
            line += f" {kind} {seconds[sampler]:.2f} / {needed:.3f} s = {seconds[sampler] / needed:.1f}"
        print(line, flush=True)
        rows.append(row)
    return rows


def timed(
    works: dict[str, Callable[[int], object]], rounds: int
) -> tuple[dict[str, float], dict[str, float], dict[str, list[np.ndarray]]]:
    """Least elapsed and processor seconds of each, run in turn after a warm-up, and what they return."""
    wall, processor = dict.fromkeys(works, np.inf), dict.fromkeys(works, np.inf)
    images: dict[str, list[np.ndarray]] = {name: [] for name in works}
    for seed in range(rounds + 1):
        for name, work in works.items():
            began = time.perf_counter(), time.process_time()
            image = np.asarray(work(seed), np.float64)
            ended = time.perf_counter(), time.process_time()
            if seed > 0:
                wall[name] = min(wall[name], ended[0] - began[0])
                processor[name] = min(processor[name], ended[1] - began[1])
                images[name].append(image)
    return wall, processor, images


if __name__ == "__main__":
    sys.exit(main())
