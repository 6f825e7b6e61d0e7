"""Do others find the same light, and in what time: Mitsuba 3, Radiance, and programs for view factors.

Mitsuba renders every scene of the gallery by `path`, and by `direct` where it shows direct light:
independent samples, 5 edges before roulette, its usual way. Rows compare the mean of all pixels, over
seeds, and the seconds to the error of Mitsuba's picture (the mean variance of pixels; ours between
measured numbers of samples, in logarithms). Radiance's rtrace and ours find direct light at sensors;
view factors are compared with known values (view_factor_peers.py). Seconds are processor seconds of
whole calls on loaded scenes with compiled kernels, the least of several runs. Peers that are not
installed are named and left out; Mitsuba needs an LLVM of 16 or newer for its seconds
(`DRJIT_LIBLLVM_PATH`).
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType

import bench_sensors
import numpy as np
import view_factor_peers
from compare_mitsuba import DIRECT, SCENES, limit_threads
from crossover import Curve
from mitsuba_equal import timed
from mitsuba_scene import MitsubaScene, import_mitsuba
from mitsuba_speed import in_passes

import ncv_cl as ncv
from ncv_cl.opencl.choose import choose_device
from ncv_cl.opencl.device import Device

CASES = (
    ("cornell_box", "direct"),
    ("occluders", "direct"),
    ("knot", "direct"),
    ("interior", "direct"),
    ("lit_mesh", "direct"),
    ("cornell_box", "gi"),
    ("occluders", "gi"),
    ("knot", "gi"),
    ("interior", "gi"),
    ("sky_room", "gi"),
    ("lit_mesh", "gi"),
    ("glass", "gi"),
)
# Most edges of a path. Mitsuba counts panes, ours does not: so many that what is cut off does not count.
DEPTH = 24
PATH = {"type": "path", "max_depth": DEPTH, "rr_depth": 5}
A_PASS = 64
# Parts that rtrace cuts lights into, over their distance; and lines on each light of ours.
PART, LINES = 0.02, 64


class Plan:
    """Sizes of a run."""

    def __init__(self, quick: bool) -> None:
        self.quick = quick
        self.cases = CASES[:1] if quick else CASES
        self.size = (16, 16) if quick else (96, 96)
        self.samples, self.ours, self.rounds = (
            (A_PASS, (4, 16), 2) if quick else (256, (4, 16, 64, 256), 3)
        )
        self.sensors = 200 if quick else 20_000


def by_us(
    scene: ncv.Scene, integrand: str, spp: int, seed: int, plan: Plan, device: Device
) -> np.ndarray:
    """Pixels of one render."""
    own = ncv.DirectLight() if integrand == "direct" else ncv.GlobalIllumination(DEPTH)
    return ncv.render(scene, own, spp=spp, size=plan.size, seed=seed, device=device).pixels


def compile_ours(plan: Plan, device: Device) -> None:
    """Have all kernels compiled: an OpenCL runtime that compiles beside Mitsuba's LLVM may crash."""
    for name, integrand in plan.cases:
        scene = ncv.load_scene(SCENES / f"{name}.toml")
        for spp in plan.ours:
            by_us(scene, integrand, spp, 0, plan, device)


def by_mitsuba(
    mitsuba: ModuleType, name: str, integrand: str, plan: Plan, device: Device
) -> dict[str, object]:
    """The row of one scene; `note` says why there is none."""
    method = DIRECT if integrand == "direct" else PATH
    row: dict[str, object] = {
        "peer": f"Mitsuba {method['type']}",
        "scene": name,
        "quantity": f"mean radiance, {integrand}",
    }
    scene = ncv.load_scene(SCENES / f"{name}.toml")
    try:
        theirs = MitsubaScene(mitsuba, scene)
    except NotImplementedError as error:
        return row | {"note": str(error)}
    works: dict[str, Callable[[int], object]] = {
        "theirs": in_passes(theirs, method, "independent", plan.size, plan.samples, A_PASS)
    }
    for spp in plan.ours:
        works[f"ours {spp}"] = lambda seed, spp=spp: by_us(scene, integrand, spp, seed, plan, device)
    _, seconds, images = timed(works, plan.rounds)
    stack = np.stack(
        [theirs.radiance(method, plan.size, 1, plan.samples, seed) for seed in range(plan.rounds + 1)]
    )
    target = float(np.var(stack, axis=0, ddof=1).mean())
    points = [
        {
            "spp": spp,
            "seconds": seconds[f"ours {spp}"],
            "mse": float(np.var(images[f"ours {spp}"], axis=0, ddof=1).mean()),
            "stages": {},
        }
        for spp in plan.ours
    ]
    best = np.stack(images[f"ours {plan.ours[-1]}"])
    return row | comparison(best.mean(axis=(1, 2, 3)), stack.mean(axis=(1, 2, 3))) | {
        "seconds_ours": float(Curve.of(points).seconds_to(target)[0]),
        "seconds_theirs": seconds["theirs"],
        "note": f"to the error of {plan.samples} of its samples, {target:.1e}",
    }  # fmt: skip


def comparison(ours: np.ndarray, theirs: np.ndarray) -> dict[str, float]:
    """Two sets of independent estimates of one number: means, their ratio, and its standard error."""
    means = [float(one.mean()) for one in (ours, theirs)]
    errors = [one.std(ddof=1) / np.sqrt(len(one)) / one.mean() for one in (ours, theirs)]
    return {
        "ours": means[0],
        "theirs": means[1],
        "ratio": means[0] / means[1],
        "standard_error": float(np.hypot(*errors)) * means[0] / means[1],
    }


def by_radiance(plan: Plan, device: Device) -> dict[str, object]:
    """The row of direct light at sensors all over a room.

    Raises
    ------
    ImportError
        Without pyradiance.
    """
    import pyradiance

    scene = ncv.load_scene(bench_sensors.SCENE)
    at, normals = bench_sensors.sensors(scene, plan.sensors)

    def ours() -> np.ndarray:
        return ncv.irradiance(scene, at, normals, spp=LINES, method="mc", device=device).values

    ours()
    own, own_seconds, _ = bench_sensors.timed(ours)
    with tempfile.TemporaryDirectory() as folder:
        text, octree = Path(folder) / "scene.rad", Path(folder) / "scene.oct"
        text.write_text(bench_sensors.radiance_scene(scene), encoding="utf-8")
        octree.write_bytes(pyradiance.oconv(text, warning=False))
        theirs, seconds, _ = bench_sensors.timed(
            lambda: bench_sensors.by_radiance(octree, at, normals, PART)
        )
    # Both look from the same sensors, so their difference has the noise of the methods alone.
    values, others = own.mean(axis=1), theirs.mean(axis=1)
    difference = values - others
    return {
        "peer": "Radiance rtrace",
        "scene": "interior",
        "quantity": "mean irradiance, direct",
        "ours": float(values.mean()),
        "theirs": float(others.mean()),
        "ratio": float(values.mean() / others.mean()),
        "standard_error": float(difference.std(ddof=1) / np.sqrt(len(difference)) / others.mean()),
        "seconds_ours": own_seconds,
        "seconds_theirs": seconds,
        "note": f"{plan.sensors} sensors; {LINES} lines on each light; rtrace -ds {PART}",
    }


def others(plan: Plan, device: Device) -> Iterator[dict[str, object]]:
    """Rows of all peers but Mitsuba."""
    try:
        yield by_radiance(plan, device)
    except ImportError:
        print("without Radiance: pip install pyradiance")
    yield from view_factor_peers.rows(device, plan.quick)


def show(row: dict[str, object]) -> None:
    """Print one row."""
    head = f"{row['peer']:17} {row['scene']:36} {row['quantity']:23}"
    if "ratio" not in row:
        print(f"{head} {row['note']}", flush=True)
        return
    print(
        f"{head} ours / theirs {row['ratio']:.5f} +- {row['standard_error']:.5f}; "
        f"{row['seconds_ours']:.4f} s, theirs {row['seconds_theirs']:.4f} s; {row['note']}",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="one scene, small")
    parser.add_argument("--json", metavar="FILE", help="write the results here")
    parser.add_argument("--device", metavar="D", help="as for ncv-cl render")
    parser.add_argument("--threads", type=int, default=2, help="threads for either (default 2)")
    options = parser.parse_args()
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: options.threads])
    device, plan = choose_device(options.device), Plan(options.quick)
    report: dict[str, object] = {"device": device.identity, "threads": options.threads}
    rows: list[dict[str, object]] = []
    for row in others(plan, device):
        rows.append(row)
        show(row)
    if importlib.util.find_spec("mitsuba"):
        compile_ours(plan, device)
        limit_threads(options.threads)
    mitsuba = import_mitsuba()
    if mitsuba is None or not mitsuba.variant().startswith("llvm"):
        print(
            "without Mitsuba: pip install mitsuba, and set DRJIT_LIBLLVM_PATH to an LLVM of 16 or newer"
        )
    else:
        report["mitsuba"] = f"{mitsuba.__version__} {mitsuba.variant()}"
        for name, integrand in plan.cases:
            rows.append(by_mitsuba(mitsuba, name, integrand, plan, device))
            show(rows[-1])
    if options.json:
        Path(options.json).write_text(
            json.dumps(report | {"rows": rows}, indent=1) + "\n", encoding="utf-8"
        )


if __name__ == "__main__":
    main()
