"""What the paper model of a GPU is made from: counts of small renders, recorded in a file.

Renders on a CPU in the shape of a GPU tell launches, waits, bytes and the host's own seconds; renders in
the CPU's shape what two cores take; a simulator the instructions (`gpu_instructions`); and NVIDIA's
compiler how many warps are resident (`tests/gpu`).
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import pytest
from device_counts import Counts, counting
from gpu_instructions import ROOT, count

import ncv_cl as ncv
from ncv_cl.opencl import program
from ncv_cl.opencl.choose import choose_device
from ncv_cl.opencl.device import GPU_LANES, Device, open_device
from ncv_cl.sampling import samples
from ncv_cl.visibility import tuning as visibility_tuning

FILE = Path(__file__).parent / "results" / "gpu_counts.json"
ARCHITECTURE = "sm_90"
SPP = 256
# Pixels along a side: of counted renders, whose batches are smaller, so that a few of them are enough to
# tell what a batch takes; and of those that are timed on the CPU.
COUNTED_SIZES, COUNTED_BATCH = (32, 64), 1 << 17
TIMED_SIZES = (64, 128)


@dataclass(frozen=True)
class Case:
    """A render that the model is about, by plain Monte Carlo.

    Attributes
    ----------
    name, scene, integrand, rays : str
    simulated : tuple of int
        Pixels along a side, and samples a point, of the render that the simulator runs.
    """

    name: str
    scene: str
    integrand: str
    rays: str
    simulated: tuple[int, int]


CASES = (
    Case("Cornell box, direct", "cornell_box", "direct", "device", (10, 64)),
    Case("knot, ao", "knot", "ao", "device", (6, 256)),
    Case("interior, gi, rays by kernels", "interior", "gi", "device", (5, 16)),
    Case("interior, gi, rays by embree", "interior", "gi", "embree", (6, 16)),
)


def record(quick: bool = False) -> dict:
    """Measure all cases; takes minutes, most of them in the simulator."""
    cpu = choose_device()
    gpu_shape = open_device(cpu.cl_device, cpu.index, 1, GPU_LANES)
    found = {}
    for case in CASES[:1] if quick else CASES:
        print(case.name, flush=True)
        with pytest.MonkeyPatch.context() as patch:
            # Slices are taken of an image of any size, as of a large one.
            patch.setattr(visibility_tuning, "SAMPLES_A_TRIANGLE", 0)
            rows = counted(case, gpu_shape, patch)
            found[case.name] = {
                "scene": case.scene,
                "integrand": case.integrand,
                "rays": case.rays,
                "counted": rows,
                "occupancy": occupancies(gpu_shape, rows),
                "cpu": on_cpu(case, cpu),
                "work": {name: asdict(one) for name, one in simulated(case).items()},
            }
    return {"device": cpu.identity, "spp": SPP, "batch": COUNTED_BATCH, "cases": found}


def simulated(case: Case) -> dict:
    return count(case.scene, case.integrand, case.rays, *case.simulated)


def render(case: Case, device: Device, side: int, seed: int = 1) -> ncv.Image:
    scene = ncv.load_scene(ROOT / f"scenes/{case.scene}.toml")
    rays = case.rays if device.lanes > 1 else "auto"
    return ncv.render(
        scene, case.integrand, "mc", rays=rays, spp=SPP, size=(side, side), seed=seed, device=device
    )


def counted(case: Case, device: Device, patch: pytest.MonkeyPatch) -> list[dict]:
    """Counts in the shape of a GPU, and the seconds that the host's own thread takes."""
    plain, rows = samples.SAMPLES_PER_BATCH, []
    patch.setattr(samples, "SAMPLES_PER_BATCH", COUNTED_BATCH)
    program._programs.clear()
    render(case, device, COUNTED_SIZES[0], seed=0)
    for side in COUNTED_SIZES:
        with counting() as counts:
            begun = time.thread_time()
            image = render(case, device, side)
            host = time.thread_time() - begun
        rows.append(row_of(side, counts, host, image.stats["rays_traced"]))
    patch.setattr(samples, "SAMPLES_PER_BATCH", plain)
    return rows


def row_of(side: int, counts: Counts, host_seconds: float, rays: int) -> dict:
    return {
        "pixels": side * side,
        "batches": side * side * SPP / COUNTED_BATCH,
        "kernels": {name: asdict(one) for name, one in counts.kernels.items()},
        "waits": sum(counts.waits.values()),
        "to_host": counts.to_host,
        "to_device": counts.to_device,
        "host_seconds": host_seconds,
        "rays": rays,
    }


def on_cpu(case: Case, device: Device) -> list[dict]:
    """Processor seconds in the CPU's own shape, the least of two renders."""
    render(case, device, TIMED_SIZES[0], seed=0)
    rows = []
    for side in TIMED_SIZES:
        seconds = []
        for seed in (1, 2):
            begun = time.process_time()
            render(case, device, side, seed)
            seconds.append(time.process_time() - begun)
        rows.append({"pixels": side * side, "seconds": min(seconds)})
    return rows


def occupancies(device: Device, counts: list[dict]) -> dict[str, dict]:
    """The part of a multiprocessor's warps that are resident, of the programs that are built now."""
    sys.path.insert(0, str(ROOT / "tests"))
    from gpu.nvidia import Nvidia

    groups = {name: one["group"] for name, one in counts[-1]["kernels"].items()}
    found: dict[str, dict] = {}
    with tempfile.TemporaryDirectory() as folder:
        compiler = Nvidia(ARCHITECTURE, Path(folder))
        if compiler.missing:
            raise RuntimeError(f"{ARCHITECTURE}: no {compiler.missing}")
        for own, one in ((key[0], built) for key, built in program._programs.items()):
            if own is device:
                text, options = program.source(one.files), program.option_list(one.defines)
                for row in compiler.rows(text, options, groups):
                    known = found.get(row.kernel)
                    if known is None or row.occupancy < known["occupancy"]:
                        found[row.kernel] = asdict(row)
    return found


def write(found: dict) -> None:
    FILE.write_text(json.dumps(found, indent=1, default=_plain) + "\n", encoding="utf-8")


def _plain(value: object) -> float:
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"{value!r} has no place in a file of results")


def read() -> dict:
    return json.loads(FILE.read_text(encoding="utf-8"))
