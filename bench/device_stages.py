"""Renders of the paper model's cases on one device: seconds, bytes, and what kernels reach of its peak.

Peaks are what a device's properties tell and what is measured. Beside it stands what the model predicts
of a GPU with these numbers (`gpu_times`), from the instructions that a simulator has counted.
"""

from __future__ import annotations

import time
from dataclasses import asdict

import gpu_record
import numpy as np
import pyopencl as cl
from device_counts import Counts, counting
from gpu_times import Gpu, Prediction, predict

import ncv_cl as ncv
from ncv_cl.opencl.device import Device
from ncv_cl.opencl.memory import HostArray
from ncv_cl.opencl.prefer import facts_of
from ncv_cl.opencl.probe import measure
from ncv_cl.visibility import tuning as visibility_tuning

# Bytes that are copied to measure how fast, and how often.
COPIED, COPIES = 128 << 20, 5
# Pixels along a side, of a GPU and of a CPU, and samples, whose number the model's counts depend on.
GPU_SIDE, CPU_SIDE = 512, 96
# What a driver does not tell: warps of a multiprocessor, the shared cache over the memory's bytes a
# second, and cores of the host.
WARPS, CACHE_OVER_MEMORY, CORES = 64, 1.6, 16


def peaks(device: Device) -> dict[str, float]:
    """What the device can do at most: billion multiply-adds, and gigabytes, a second.

    The first by its properties (`facts_of`); the others are measured.
    """
    copied = min(COPIED, device.cl_device.max_mem_alloc_size // 4)
    first, second = (HostArray(device, copied, np.uint8) for _ in range(2))
    first.fill(1)
    own = np.ones(copied, np.uint8)

    def best(copy: object) -> float:
        seconds = []
        for _ in range(COPIES):
            begun = time.perf_counter()
            copy()
            device.queue.finish()
            seconds.append(time.perf_counter() - begun)
        return 1e-9 * copied / min(seconds)

    queue = device.queue
    return {
        "multiply_adds": facts_of(device.cl_device).peak,
        "multiply_adds_measured": measure(device).multiply_adds,
        # Read and written.
        "memory": 2 * best(lambda: cl.enqueue_copy(queue, second.buffer, first.buffer)),
        "to_device": best(lambda: cl.enqueue_copy(queue, first.buffer, own)),
        "to_host": best(lambda: cl.enqueue_copy(queue, own, first.buffer)),
    }


def gpu_of(device: Device, measured: dict[str, float]) -> Gpu:
    """The model's numbers of this device."""
    facts = facts_of(device.cl_device)
    bus = min(measured["to_device"], measured["to_host"])
    memory = measured["memory"]
    return Gpu(
        facts.name, facts.units, facts.lanes, WARPS, 1e-3 * facts.megahertz, memory,
        CACHE_OVER_MEMORY * memory, bus, CORES,
    )  # fmt: skip


def beside_model(device: Device, measured: dict[str, float], quick: bool) -> list[dict]:
    """A row for each case: what it took, and what kernels did, beside the prediction."""
    recorded = gpu_record.read()
    rows = []
    for case in gpu_record.CASES[: 1 if quick else None]:
        if case.rays == "embree" and device.lanes == 1:
            continue
        rows.append(case_row(device, case, recorded["cases"][case.name], measured, quick))
    return rows


def case_row(
    device: Device, case: gpu_record.Case, known: dict, measured: dict[str, float], quick: bool
) -> dict:
    side = 32 if quick else GPU_SIDE if device.is_gpu else CPU_SIDE
    plain = visibility_tuning.SAMPLES_A_TRIANGLE
    # Slices are taken of small images, too.
    visibility_tuning.SAMPLES_A_TRIANGLE = 0
    try:
        gpu_record.render(case, device, side, seed=0)
        begun, on_host = time.perf_counter(), time.thread_time()
        with counting() as counts:
            image = gpu_record.render(case, device, side, seed=1)
        seconds, on_host = time.perf_counter() - begun, time.thread_time() - on_host
        with counting(timed=True) as timed:
            gpu_record.render(case, device, side, seed=1)
    finally:
        visibility_tuning.SAMPLES_A_TRIANGLE = plain
    row = {
        "case": case.name,
        "side": side,
        "spp": gpu_record.SPP,
        "points": image.stats["points"],
        "seconds": seconds,
        "stages": image.stats["seconds"],
        "host_thread_seconds": on_host,
        "launches": counts.launches,
        "waits": sum(counts.waits.values()),
        "to_host": counts.to_host,
        "to_device": counts.to_device,
    }
    if device.vector_width > 1:
        # An item is another number of samples there than where instructions were counted.
        kernels = {name: asdict(one) for name, one in timed.kernels.items()}
        return row | {"kernels": kernels, "predicted": None}
    said = prediction(known, counts, image, gpu_of(device, measured))
    return row | {"kernels": kernel_rows(known, timed, said), "predicted": parts(said)}


def prediction(known: dict, counts: Counts, image: ncv.Image, gpu: Gpu) -> Prediction:
    """What the model says of a render that was counted; the host's own seconds are those recorded."""
    row = known["counted"][-1]
    plain = {
        "kernels": {
            name: {"count": one.count, "items": one.items} for name, one in counts.kernels.items()
        },
        "waits": sum(counts.waits.values()),
        "to_host": counts.to_host,
        "to_device": counts.to_device,
        "rays": image.stats["rays_traced"],
        "host_seconds": row["host_seconds"],
    }
    return predict(known, plain, gpu)


def parts(said: Prediction) -> dict[str, float | str]:
    return {
        "seconds": said.seconds,
        "device": said.device,
        "host": said.host,
        "embree": said.embree,
        "waiting": said.waiting,
        "copying": said.copying,
        "bound": said.bound,
    }


def kernel_rows(known: dict, timed: Counts, said: Prediction) -> dict[str, dict]:
    """What each kernel took and reached, in billions of operations and of bytes a second."""
    predicted = {one.name: one for one in said.kernels}
    rows = {}
    for name, one in timed.kernels.items():
        row = asdict(one)
        if name in predicted and one.seconds > 0:
            work = known["work"][name]
            moved = work["loaded"] + work["stored"]
            row["gflops"] = 1e-9 * one.items * work["flops"] / one.seconds
            # Caches not counted: all that kernels ask for.
            row["gbytes"] = 1e-9 * one.items * moved / one.seconds
            row["predicted"] = predicted[name].seconds
            row["bound"] = predicted[name].bound
        rows[name] = row
    return rows


def show(rows: list[dict], measured: dict[str, float]) -> None:
    """Two tables: the cases, and the kernels that take most."""
    print("peaks, billion multiply-adds and gigabytes a second: " + _listed(measured))
    for row in rows:
        said = row["predicted"]
        told = f", predicted {said['seconds']:.3f} s ({said['bound']})" if said else ""
        print(
            f"  {row['case']}, {row['side']} points a side: {row['seconds']:.3f} s{told}; "
            f"{row['launches']} launches, {row['waits']} waits, {1e-6 * row['to_host']:.1f} MB to the "
            f"host, {1e-6 * row['to_device']:.1f} MB to the device"
        )
        for name, one in sorted(row["kernels"].items(), key=lambda item: -item[1]["seconds"])[:8]:
            reached = {what: one[what] for what in ("gflops", "gbytes", "predicted") if what in one}
            print(f"    {name:20} {one['seconds']:8.4f} s  {_listed(reached)}")


def _listed(numbers: dict[str, float]) -> str:
    return ", ".join(f"{name} {value:.3g}" for name, value in numbers.items())
