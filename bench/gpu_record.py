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
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from device_counts import Counts, counting
from gpu_instructions import ROOT, count

import ncv_cl as ncv
from ncv_cl.opencl import program
from ncv_cl.opencl.choose import choose_device
from ncv_cl.opencl.device import GPU_LANES, Device, open_device
from ncv_cl.opencl.limits import DeviceMemory
from ncv_cl.sampling import samples
from ncv_cl.visibility import tuning as visibility_tuning

FILE = Path(__file__).parent / "results" / "gpu_counts.json"
ARCHITECTURE = "sm_90"
SPP = 256
# Pixels along a side: of counted renders, and of those that are timed on the CPU.
COUNTED_SIZES = (32, 64)
TIMED_SIZES = (48, 96)


@dataclass(frozen=True)
class Case:
    """A render that the model is about, by plain Monte Carlo.

    Attributes
    ----------
    name, scene, integrand, rays : str
    simulated : tuple of int
        Pixels along a side, and samples a point, of the render that the simulator runs.
    batch : int
        Samples of a batch in counted renders: so few that these have several batches a pass.
    """

    name: str
    scene: str
    integrand: str
    rays: str
    simulated: tuple[int, int]
    batch: int = 1 << 17


CASES = (
    Case("Cornell box, direct", "cornell_box", "direct", "device", (10, 64)),
    Case("knot, ao", "knot", "ao", "device", (5, 256), 1 << 11),
    Case("interior, gi, rays by kernels", "interior", "gi", "device", (4, 16)),
    Case("interior, gi, rays by embree", "interior", "gi", "embree", (4, 16)),
)


def record(names: Sequence[str] = ()) -> None:
    """Measure cases, all by default, and write `FILE` after each; the simulator takes minutes."""
    cpu = choose_device()
    found: dict = {"device": cpu.identity, "spp": SPP, "cases": {}}
    if names:
        found["cases"] = read()["cases"]
    for case in CASES:
        if not names or case.name in names:
            print(case.name, flush=True)
            found["cases"][case.name] = measured(case, cpu, found["cases"])
            FILE.write_text(json.dumps(found, indent=1, default=_plain) + "\n", encoding="utf-8")


def measured(case: Case, cpu: Device, others: dict[str, dict]) -> dict:
    """All of one case; what another of the same scene has found is not measured again."""
    other = next(
        (one for name, one in others.items() if name != case.name and one["scene"] == case.scene), {}
    )
    with pytest.MonkeyPatch.context() as patch:
        # Slices are taken of an image of any size, as of a large one.
        patch.setattr(visibility_tuning, "SAMPLES_A_TRIANGLE", 0)
        shaped = as_a_gpu(cpu)
        rows = counted(case, shaped, patch)
        occupancy = other.get("occupancy", {})
        if not set(rows[-1]["kernels"]) <= set(occupancy):
            occupancy = occupancies(shaped, rows)
        cpu_rows = other.get("cpu") or on_cpu(case, cpu)
    work = other.get("work", {})
    if not set(rows[-1]["kernels"]) <= set(work):
        simulated = count(case.scene, case.integrand, case.rays, *case.simulated)
        work = {name: asdict(one) for name, one in simulated.items()}
    return {
        "scene": case.scene,
        "integrand": case.integrand,
        "rays": case.rays,
        "counted": rows,
        "occupancy": occupancy,
        "cpu": cpu_rows,
        "work": work,
    }


def as_a_gpu(device: Device) -> Device:
    """A CPU in the shape of a GPU, as if it had memory of its own: what is copied is counted."""
    shaped = open_device(device.cl_device, device.index, 1, GPU_LANES)
    memory = device.memory
    return replace(shaped, memory=DeviceMemory(False, memory.largest, memory.total, memory.name))


def render(case: Case, device: Device, side: int, seed: int = 1) -> ncv.Image:
    scene = ncv.load_scene(ROOT / f"scenes/{case.scene}.toml")
    rays = case.rays if device.lanes > 1 else "auto"
    return ncv.render(
        scene, case.integrand, "mc", rays=rays, spp=SPP, size=(side, side), seed=seed, device=device
    )


def counted(case: Case, device: Device, patch: pytest.MonkeyPatch) -> list[dict]:
    """Counts in the shape of a GPU, and the seconds that the host's own thread takes."""
    plain, rows = samples.SAMPLES_PER_BATCH, []
    patch.setattr(samples, "SAMPLES_PER_BATCH", case.batch)
    program._programs.clear()
    render(case, device, COUNTED_SIZES[0], seed=0)
    for side in COUNTED_SIZES:
        with counting() as counts:
            begun = time.thread_time()
            image = render(case, device, side)
            host = time.thread_time() - begun
        row = row_of(side, counts, host, image.stats["rays_traced"])
        rows.append(row | {"batches": side * side * SPP / case.batch})
    patch.setattr(samples, "SAMPLES_PER_BATCH", plain)
    return rows


def row_of(side: int, counts: Counts, host_seconds: float, rays: int) -> dict:
    return {
        "pixels": side * side,
        "kernels": {name: asdict(one) for name, one in counts.kernels.items()},
        "waits": sum(counts.waits.values()),
        "to_host": counts.to_host,
        "to_device": counts.to_device,
        "host_seconds": host_seconds,
        "rays": rays,
    }


def on_cpu(case: Case, device: Device) -> list[dict]:
    """Processor seconds in the CPU's own shape."""
    render(case, device, TIMED_SIZES[0], seed=0)
    rows = []
    for side in TIMED_SIZES:
        begun = time.process_time()
        render(case, device, side)
        rows.append({"pixels": side * side, "seconds": time.process_time() - begun})
    return rows


def occupancies(device: Device, counts: list[dict]) -> dict[str, dict]:
    """The part of a multiprocessor's warps that are resident, of the programs that are built now."""
    sys.path.insert(0, str(ROOT / "tests"))
    from gpu.nvidia import Nvidia

    groups = {name: one["group"] for name, one in counts[-1]["kernels"].items()}
    found: dict[str, dict] = {}
    with tempfile.TemporaryDirectory() as folder:
        compiler = Nvidia((ARCHITECTURE,), Path(folder))
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


def _plain(value: object) -> float:
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"{value!r} has no place in a file of results")


def read() -> dict:
    return json.loads(FILE.read_text(encoding="utf-8"))
