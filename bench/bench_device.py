"""One device: every kernel against its reference, what each stage costs, and what the model said.

Runs unattended and without network, from a checkout: `tests/` holds the references. Besides what the
package requires it needs pytest, scipy, hypothesis and gmpy2; a check whose needs are missing fails by
name, and the rest goes on. `bench/carry.sh` fetches the wheels of all of them for a machine without
network (docs/devices.md). It takes less than eight minutes: what has not begun by then is left out and
named. The file of results is written after each part, so that a run that is ended leaves what was done.

The paper model's cases are rendered with launches, waits and bytes counted and kernels timed, beside the
device's peak and the model's prediction (`device_stages`). Stages of further renders are timed, in
medians of a few after one that compiles. The sweep takes VEC and LANES that suit the kind of device
through all stages of a control variate, and inference through sizes of the work-group. Seconds are those
of whole stages, so on a GPU they include what copying and waiting for the host cost.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import device_stages
import numpy as np
from device_checks import SCENES, validate

import ncv_cl as ncv
from ncv_cl.network.encode import Encoding
from ncv_cl.network.network import WEIGHT_GROUPS, NetworkDescription
from ncv_cl.opencl.choose import choose_device
from ncv_cl.opencl.device import GPU_LANES, Device, open_device, widest_vectors
from ncv_cl.opencl.memory import HostArray
from ncv_cl.opencl.program import build
from ncv_cl.output.report import package_version
from ncv_cl.settings.presets import PRESETS

CASES = (("cornell_box", "direct", "mc"), ("cornell_box", "direct", "ncv"), ("occluders", "ao", "ncv"))
# (VEC, LANES) to try; LANES work-items of a GPU share a point, a CPU's vectors do.
CPU_SHAPES = ((16, 1), (8, 1), (4, 1), (1, 1), (1, GPU_LANES))
GPU_SHAPES = ((1, 32), (1, 16), (1, 64), (1, 128), (4, 32))
WORK_GROUPS = (16, 32, 64, 128, 256)
# Inference: points and samples of each, of the default network.
POINTS, SAMPLES = 1024, 256


# Seconds after which no further part begins.
LIMIT = 420.0


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="fewer checks, small images, one repeat")
    parser.add_argument("--json", metavar="FILE", help="write the results here")
    parser.add_argument("--device", metavar="D", help="as for ncv-cl render")
    parser.add_argument(
        "--gpu-shape", action="store_true", help="kernels in the shape of a GPU, to rehearse on a CPU"
    )
    options = parser.parse_args(argv)
    device = choose_device(options.device)
    if options.gpu_shape:
        device = open_device(device.cl_device, device.index, 1, GPU_LANES)

    def save(report: dict) -> None:
        if options.json:
            Path(options.json).write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")

    report = run(options.quick, device, save)
    return 0 if report["valid"] else 1


def run(
    quick: bool,
    device: Device | int | str | None = None,
    save: Callable[[dict], None] = lambda report: None,
) -> dict:
    """Validate, then time.

    Parameters
    ----------
    save : callable
        Gets the report after each part.

    Returns
    -------
    dict
        `valid` says whether every kernel was launched and met its reference, `left_out` for what there
        was no time.
    """
    device = choose_device(device)
    begun = time.perf_counter()
    report = describe(device) | {"left_out": []}
    print(device.describe(), flush=True)

    def part(name: str, measure: Callable[[], object]) -> None:
        if time.perf_counter() - begun > LIMIT:
            report["left_out"].append(name)
            return
        report[name] = measure()
        keep()

    def keep() -> None:
        report["seconds"] = time.perf_counter() - begun
        save(report)

    outcomes, unreached = validate(device, quick)
    report["checks"] = [asdict(outcome) for outcome in outcomes]
    report["unreached_kernels"] = unreached
    report["valid"] = not unreached and not any(outcome.error for outcome in outcomes)
    keep()
    part("peaks", lambda: device_stages.peaks(device))
    if "peaks" in report:
        part("model", lambda: device_stages.beside_model(device, report["peaks"], quick))
    part("stages", lambda: [stages(device, *case, quick) for case in CASES])
    part("work_groups", lambda: work_groups(device, quick))
    part("shapes", lambda: _shapes(device, quick, begun))
    keep()
    show(report)
    return report


def _shapes(device: Device, quick: bool, begun: float) -> list[dict]:
    rows = []
    for shape in shapes(device)[: 2 if quick else None]:
        if time.perf_counter() - begun < LIMIT:
            rows.append(shape_row(device, *shape, quick))
    return rows


def describe(device: Device) -> dict:
    """What tells this device, driver and version from others."""
    own = device.cl_device
    return {
        "device": device.name,
        "platform": device.platform_version,
        "driver": own.driver_version.strip(),
        "opencl_c": own.opencl_c_version.strip(),
        "compute_units": own.max_compute_units,
        "local_memory": own.local_mem_size,
        "global_memory": own.global_mem_size,
        "vec": device.vector_width,
        "lanes": device.lanes,
        "use_fma": device.use_fma,
        "version": package_version(),
    }


# ---- stages ----------------------------------------------------------------------------------------


def stages(device: Device, scene: str, integrand: str, method: str, quick: bool) -> dict:
    """Median seconds of a render's stages."""
    size, spp, repeats = (64, 16, 1) if quick else (256, 64, 3)
    loaded = ncv.load_scene(SCENES / f"{scene}.toml")

    def render(seed: int) -> ncv.Image:
        return ncv.render(
            loaded, integrand, method, spp=spp, size=(size, size), seed=seed, device=device
        )

    render(0)
    images = [render(seed) for seed in range(1, repeats + 1)]
    rows = [image.stats["seconds"] for image in images]
    return {
        "scene": scene,
        "integrand": integrand,
        "method": method,
        "points": images[0].stats["points"],
        "samples": spp,
        "rays": images[0].stats["rays_traced"],
        "seconds": {stage: float(np.median([row[stage] for row in rows])) for stage in rows[0]},
    }


# ---- shapes ----------------------------------------------------------------------------------------


def shapes(device: Device) -> list[tuple[int, int]]:
    """The device's own (VEC, LANES) first, then what else is worth a try."""
    own = device.vector_width, device.lanes
    widest = widest_vectors(device.cl_device)
    others = GPU_SHAPES if device.is_gpu else [shape for shape in CPU_SHAPES if shape[0] <= widest]
    largest = device.cl_device.max_work_group_size
    return [own, *(shape for shape in others if shape != own and shape[1] <= largest)]


def shape_row(device: Device, vector_width: int, lanes: int, quick: bool) -> dict:
    """Stages' seconds and inference's nanoseconds in one shape; an `error` where it does not run."""
    row: dict = {"vec": vector_width, "lanes": lanes}
    shaped = open_device(device.cl_device, device.index, vector_width, lanes, device.use_fma)
    try:
        row["inference_ns"] = inference_ns(shaped, quick)
        row["seconds"] = stages(shaped, "cornell_box", "direct", "ncv", quick)["seconds"]
    # A shape that a driver cannot build is a finding, not the end.
    except Exception as problem:
        row["error"] = f"{type(problem).__name__}: {' '.join(str(problem).split())[:300]}"
    return row


def work_groups(device: Device, quick: bool) -> list[dict]:
    """Inference in work-groups of several sizes."""
    largest = device.cl_device.max_work_group_size
    return [
        {"group": group, "inference_ns": inference_ns(device, quick, group)}
        for group in WORK_GROUPS
        if group <= largest
    ]


def inference_ns(device: Device, quick: bool, group: int = 64) -> float:
    """Nanoseconds a sample of the default network, all its weights per point."""
    hidden = PRESETS["default"].hidden
    description = NetworkDescription(Encoding(("position",)), 3, hidden, WEIGHT_GROUPS)
    generator = np.random.default_rng(0)
    found = {
        name: generator.normal(size=(POINTS, *shape)) for name, shape in description.group_shapes.items()
    }
    found["W2"] = generator.normal(size=hidden[::-1])
    found["U"], found["V"] = generator.random((2, POINTS, SAMPLES))
    buffers = {
        name.lower(): HostArray.of(device, array.astype(np.float32)) for name, array in found.items()
    }
    value = HostArray(device, (3, POINTS, SAMPLES), np.float32)
    evaluate = build(device, ("common", "mlp"), description.defines()).kernel("evaluate")
    items = POINTS * SAMPLES // device.vector_width
    times = []
    for _ in range(5 if quick else 20):
        begun = time.perf_counter()
        evaluate(
            items,
            first_point=0,
            point_count=POINTS,
            stride=SAMPLES,
            **buffers,
            value=value,
            group=group,
        )
        device.queue.finish()
        times.append(time.perf_counter() - begun)
    return float(np.median(times[1:])) / (POINTS * SAMPLES) * 1e9


# ---- the table -------------------------------------------------------------------------------------


def show(report: dict) -> None:
    """One table of it all."""
    print(
        f"\n{report['device']} | {report['platform']} | {report['driver']} | ncv_cl {report['version']}"
    )
    print("checks")
    for check in report["checks"]:
        verdict = "ok" if not check["error"] else f"FAILED {check['error']}"
        name = check["test"].partition(".")[2].removeprefix("test_").replace("_", " ")
        print(f"  {check['subject']:18} {name:60} {check['seconds']:6.2f} s  {verdict}")
    if report["unreached_kernels"]:
        print(f"  kernels that no check launched: {', '.join(report['unreached_kernels'])}")
    if "model" in report:
        device_stages.show(report["model"], report["peaks"])
    print("stages")
    for row in report.get("stages", ()):
        print(
            f"  {row['scene']} {row['integrand']} {row['method']}, {row['points']} points: " + _line(row)
        )
    print("shapes (VEC samples a work-item, LANES work-items a point; cornell_box direct ncv)")
    for row in report.get("shapes", ()):
        name = f"VEC {row['vec']:2} LANES {row['lanes']:3}"
        if "error" in row:
            print(f"  {name}  {row['error']}")
        else:
            print(f"  {name}  inference {row['inference_ns']:.2f} ns a sample; " + _line(row))
    rows = report.get("work_groups", ())
    groups = ", ".join(f"{row['group']}: {row['inference_ns']:.2f}" for row in rows)
    print(f"work-groups, nanoseconds of inference a sample: {groups}")
    if report["left_out"]:
        print(f"no time was left for: {', '.join(report['left_out'])}")
    verdict = "every kernel meets its reference" if report["valid"] else "NOT VALID"
    print(f"{verdict}; {report['seconds']:.0f} s in all")


def _line(row: dict) -> str:
    return ", ".join(f"{name} {s:.3f}" for name, s in row["seconds"].items() if s >= 5e-4) + " s"


if __name__ == "__main__":
    sys.exit(main())
