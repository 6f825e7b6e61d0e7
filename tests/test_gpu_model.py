"""The paper model of a GPU: what it counts, how it reckons, and that its page is what it says."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pyopencl as cl
import pytest

from ncv_cl.opencl.device import GPU_LANES, open_device
from ncv_cl.opencl.memory import HostArray
from ncv_cl.opencl.prefer import LEAST_ADVANTAGE
from ncv_cl.opencl.program import build

sys.path.insert(0, str(Path(__file__).parent.parent / "bench"))
import device_stages
import gpu_instructions
import gpu_model
import gpu_record
import gpu_times
from device_counts import counting

# One warp-instruction a clock and scheduler, and nothing in between.
GPU = gpu_times.Gpu("one", 1, 32, 64, 1.0, 1.0, 2.0, 4.0, 1)
GIVEN = {
    "instructions": 1.0, "active": 1.0, "active in walks": 0.5, "arithmetic clocks": 4.0,
    "memory clocks": 0.0, "independent": 1.0, "issued": 1.0, "missed": 0.5, "from memory": 0.25,
    "launch": 0.0, "wait": 2.0, "bus": 0.5, "call": 0.25, "host": 1.0, "rays": 10.0,
}  # fmt: skip


def test_launches_waits_and_bytes_are_counted(one_device):
    values = HostArray(one_device, 64 * one_device.vector_width, np.float32)
    kernel = build(one_device, ("common", "probe"), {"STEPS": "16u"}).kernel("multiply_add")
    size = values.shape[0] * 4
    with counting() as counts:
        with values.mapped(write=True) as view:
            view[...] = 1
        for _ in range(3):
            kernel(64, a=0.5, b=1.0, values=values)
        one_device.queue.finish()
        values.read()
        with values.mapped(update=True):
            pass
        cl.enqueue_copy(one_device.queue, np.empty(4, np.uint8), values.buffer)
    assert (counts.launches, counts.kernels["multiply_add"].items) == (3, 192)
    assert counts.kernels["multiply_add"].seconds == 0
    assert (counts.to_device, counts.to_host) == (2 * size, 2 * size + 4)
    assert counts.waits == {"map": 3, "finish": 1, "copy": 1}
    before = dict(counts.waits)
    values.read()
    assert counts.waits == before, "nothing is counted after the block"
    with counting(timed=True) as counts:
        kernel(64, a=0.5, b=1.0, values=values)
    assert counts.kernels["multiply_add"].seconds > 0 and not counts.waits


LOG = """
Instructions executed for kernel 'one':
              10 - fadd
               6 - call llvm.fmuladd.v3f32()
               4 - call _Z3fmafff()
               2 - load global (8 bytes)
               1 - store global (16 bytes)
               1 - call _Z6vload3mPU3AS1Kf()
             900 - load private (3600 bytes)
              50 - call some_function()

Instructions executed for kernel 'two':
               2 - fdiv
Instructions executed for kernel 'one':
              10 - fadd
"""


def test_instructions_are_weighed_and_shared_among_items():
    found = gpu_instructions.means(LOG, {"one": 2, "two": 1})
    # 20 additions, 3 lanes of 6 and 4 multiply-adds, 3 accesses of 2 each, one of three numbers.
    assert found["one"].instructions == (20 + 18 + 4 + 6 + 4) / 2
    assert found["one"].flops == (20 + 2 * 18 + 2 * 4) / 2
    assert (found["one"].loaded, found["one"].stored) == ((8 + 12) / 2, 16 / 2)
    assert found["two"] == gpu_instructions.Work(16, 2, 0, 0)


def kernel_time(name="plain", launches=0, occupancy=1.0, **work):
    work = {"instructions": 0.0, "flops": 0.0, "loaded": 0.0, "stored": 0.0} | work
    return gpu_times.kernel_time(name, launches, 3200.0, work, occupancy, GPU, GIVEN)


def test_a_kernel_takes_its_instructions_or_its_bytes():
    assert kernel_time(instructions=50.0).seconds == pytest.approx(100 * 50 / 1e9)
    # Half of the lanes of a walk work, and two warps of 64 hide half of four clocks.
    assert kernel_time("find_hits", instructions=50.0).seconds == pytest.approx(2 * 100 * 50 / 1e9)
    slow = kernel_time(instructions=50.0, occupancy=2 / 64)
    assert slow.seconds == pytest.approx(2 * 100 * 50 / 1e9) and slow.bound == "latency"
    # Half of what is loaded comes from the shared cache, twice as fast as a quarter from memory.
    moved = kernel_time(loaded=4e3)
    assert moved.seconds == pytest.approx(3200 * 4e3 / 4 / 1e9) and moved.bound == "memory"
    assert kernel_time(launches=3, instructions=50.0).seconds == pytest.approx((100 + 3 * 4) * 50 / 1e9)


@pytest.mark.parametrize(("rays", "seconds"), [("device", 6 + 2 + 0.5), ("embree", 6 + 2 + 0.5 + 3)])
def test_host_and_device_overlap_only_where_kernels_trace(rays, seconds):
    case = {
        "rays": rays,
        "work": {"plain": {"instructions": 3e7, "flops": 0, "loaded": 0, "stored": 0}},
        "occupancy": {"plain": {"occupancy": 1.0}},
    }
    counts = {"kernels": {"plain": {"count": 0, "items": 3200}}, "waits": 1, "to_host": 1e9}
    counts |= {"to_device": 0, "rays": 10, "host_seconds": 5.75}
    found = gpu_times.predict(case, counts, GPU, GIVEN)
    assert (
        found.device == pytest.approx(3.0) and found.host == 6.0 and found.embree == (rays == "embree")
    )
    assert found.seconds == pytest.approx(seconds + found.embree)


def test_counts_go_as_pixels_and_as_batches():
    rows = [
        {"pixels": n * 1024, "batches": 2.0 * n, "waits": 3 + 5 * n, "to_host": 100 + 7 * n, "rays": 0,
         "to_device": 0, "host_seconds": 1.0, "kernels": {"one": {"count": 2 * n, "items": 64 * n}}}
        for n in (1, 4)
    ]  # fmt: skip
    found = gpu_times.scaled({"counted": rows, "rays": "device"}, 1024, 256)
    assert found["to_host"] == 100 + 7 * 1024 and found["kernels"]["one"]["items"] == 64 * 1024
    # 2^28 samples are 512 batches.
    assert found["waits"] == 3 + 5 * 256 and found["kernels"]["one"]["count"] == 512


def test_the_page_is_what_the_script_writes():
    assert gpu_model.PAGE.read_text(encoding="utf-8") == gpu_model.page(gpu_record.read())


def test_nearly_all_work_of_a_case_is_of_kernels_that_are_known():
    """What a small render in the simulator does not launch is left out of the prediction."""
    for case in gpu_record.read()["cases"].values():
        launched = case["counted"][-1]["kernels"]
        unknown = [
            one["items"]
            for name, one in launched.items()
            if name not in case["work"] or name not in case["occupancy"]
        ]
        assert sum(unknown) < 0.03 * sum(one["items"] for one in launched.values())


def test_choosing_a_gpu_asks_for_more_than_the_model_says_is_needed():
    """In the mean of renders that a GPU traces itself: there it would take as long as a CPU."""
    peaks, ratios = gpu_times.H100.peak / gpu_model.CPU_PEAK, []
    for case in gpu_record.read()["cases"].values():
        if case["rays"] == "device":
            counts = gpu_times.scaled(case, gpu_model.SIDE, gpu_model.SPP)
            seconds = gpu_times.predict(case, counts, gpu_times.H100).seconds
            ratios.append(peaks * seconds / gpu_model.cpu_seconds(case))
    assert len(ratios) == 3 and np.exp(np.log(ratios).mean()) <= LEAST_ADVANTAGE


def test_a_device_is_measured_beside_the_model(one_device, monkeypatch):
    shaped = open_device(one_device.cl_device, one_device.index, 1, GPU_LANES)
    measured = dict.fromkeys(("memory", "to_device", "to_host"), 10.0)
    (row,) = device_stages.beside_model(shaped, measured, quick=True)
    assert row["predicted"]["seconds"] > 0 and row["waits"] < row["launches"] + 60
    draw = row["kernels"]["draw_samples"]
    assert draw["seconds"] > 0 and draw["gflops"] > 0 and draw["predicted"] > 0
