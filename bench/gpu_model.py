"""A paper model of an H100: what renders of a megapixel take there, and what bounds them.

``python bench/gpu_model.py`` writes docs/gpu_model.md from bench/results/gpu_counts.json, and with
``--record`` counts anew first, for some ten minutes (needs oclgrind, clang and ptxas).
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path

import gpu_record
from gpu_times import ASSUMPTIONS, BATCH, H100, Prediction, linear, predict, scaled, uncertainty

from ncv_cl.visibility.room import SAMPLES_A_UNIT

PAGE = Path(__file__).parent.parent / "docs" / "gpu_model.md"
SIDE, SPP = 1024, gpu_record.SPP
# Two cores with AVX-512 at 2.6 GHz, as `facts_of` counts: 16 lanes, a multiply-add of each a clock.
CPU_CORES, CPU_PEAK = 2, 2 * 16 * 2.6
# Batches of a CPU's size are looked at, too: one of 2^19 samples has 2^16 paths, since a path has eight
# entries, and they leave most of the GPU idle.
LARGE = H100.units * SAMPLES_A_UNIT
# Kernels that take at least this part of a render's device seconds are shown.
SHOWN = 0.01


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    names = [case.name for case in gpu_record.CASES]
    parser.add_argument(
        "--record", nargs="*", choices=names, metavar="RENDER", help="count anew; all by default"
    )
    options = parser.parse_args(arguments)
    if options.record is not None:
        gpu_record.record(options.record)
    PAGE.write_text(page(gpu_record.read()), encoding="utf-8")
    return 0


def page(recorded: dict) -> str:
    """docs/gpu_model.md."""
    return "\n".join(_lines(recorded)) + "\n"


INTRODUCTION = f"""# A paper model of a GPU

No GPU has run this code. This page says what renders of {SIDE} × {SIDE} points and {SPP} samples should
take on an {H100.name} with {H100.cores} cores of a host, by plain Monte Carlo, and why.
`python bench/gpu_model.py` writes it from `bench/results/gpu_counts.json`, and counts anew with
`--record`:

- launches, waits, bytes and work-items: small renders in the shape of a GPU on a CPU, two sizes each,
  continued in a line: items and bytes go as the pixels, launches and waits as the batches;
- instructions, floating-point operations and bytes of memory of a work-item: still smaller renders in
  the simulator oclgrind, which counts what is executed, loops and branches as they are taken;
- resident warps: clang and ptxas, of the very programs of these renders
  ([gpu_kernels.md](gpu_kernels.md) has the worst of all programs);
- all else: the assumptions below.

A kernel takes what its instructions need to be issued or its bytes to be moved, whichever is more. Each
launch also takes what one warp alone needs from begin to end. `ncv-cl bench device` prints what a real
GPU takes beside what this model says ([devices.md](devices.md)).

## Assumptions

A number may be larger or smaller by its factor. Seconds below are uncertain by what all factors
together change, as if they were independent.
"""


def _lines(recorded: dict) -> Iterator[str]:
    yield INTRODUCTION
    yield from table(
        ("assumption", "value", "factor", "what it is"),
        ((name, f"{one.value:g}", f"{one.factor:g}", one.why) for name, one in ASSUMPTIONS.items()),
    )
    gpu = H100
    yield ""
    yield (
        f"The {gpu.name}: {gpu.units} multiprocessors of {gpu.lanes} lanes and {gpu.warps} warps at "
        f"{gpu.gigahertz} GHz, {gpu.memory:.0f} GB/s\nfrom memory, {gpu.cache:.0f} GB/s from the shared "
        f"cache, {gpu.bus:.0f} GB/s over the bus (PCIe 5, pinned memory)."
    )
    cases = recorded["cases"]
    predictions = {}
    for name, case in cases.items():
        for title, batch in ((name, LARGE), (f"{name}, batches of 2^19", BATCH)):
            counts = scaled(case, SIDE, SPP, batch)
            if batch == LARGE or case["integrand"] == "gi":
                predictions[title] = (
                    predict(case, counts, gpu), uncertainty(case, counts, gpu), cpu_seconds(case)
                )  # fmt: skip
    yield from ["", "## Renders", ""]
    yield from table(
        ("render", "launches", "waits", "MB to host", "MB to device", "bytes a sample", "kernels s",
         "host's thread s", "embree s", "waits s", "bus s", "all s", "bound by"),
        (row_of(name, *of) for name, of in predictions.items()),
    )  # fmt: skip
    yield from ["", *comparison(predictions)]
    yield from ["", "## Kernels", "", KERNELS]
    for name, case in cases.items():
        prediction = predictions[name][0]
        yield from ["", f"### {name}", "", *kernels(prediction)]
        left_out = set(case["counted"][-1]["kernels"]) - {one.name for one in prediction.kernels}
        if left_out:
            named = ", ".join(f"`{one}`" for one in sorted(left_out))
            yield from ["", f"Not launched by the simulator's small render, and left out: {named}."]


KERNELS = f"""Those that take at least {SHOWN:.0%} of a render's device seconds. Instructions, operations
and bytes beyond the nearest cache are those of one work-item, warps those of one scheduler, of 16."""


def row_of(name: str, one: Prediction, factor: float, _: float) -> tuple[str, ...]:
    moved = (one.to_host + one.to_device) / (SIDE * SIDE * SPP)
    seconds = (one.device, one.host, one.embree, one.waiting, one.copying)
    return (
        name, f"{one.launches:.0f}", f"{one.waits:.0f}", f"{1e-6 * one.to_host:.0f}",
        f"{1e-6 * one.to_device:.0f}", f"{moved:.2g}", *(f"{value:.2g}" for value in seconds),
        f"{one.seconds:.2g} ×/÷ {factor:.1f}", one.bound,
    )  # fmt: skip


def cpu_seconds(case: dict) -> float:
    """Seconds of two cores, each of which does half of the work."""
    low, high = ((row["pixels"], row["seconds"]) for row in case["cpu"])
    return linear(low, high, SIDE * SIDE) / CPU_CORES


def comparison(predictions: dict) -> Iterator[str]:
    """What two cores take beside it, and what that says of when a GPU pays."""
    peaks = H100.peak / CPU_PEAK
    yield f"""A batch on a GPU has {SAMPLES_A_UNIT} samples for each of its compute units, {LARGE} here
(`SAMPLES_A_UNIT`, `ncv_cl/visibility/room.py`). In global illumination one of 2^19, a CPU's, has 2^16
paths, as eight points share one: too few to fill the GPU, so launches would be most of the seconds.

Two cores of a CPU (AVX-512), continued in the same way from renders of a few thousand points: the
{H100.name}'s peak is {peaks:.0f} times theirs. The last column is by how much less of its peak the GPU
reaches: one whose peak is so many times a CPU's takes as long as that. `choose_device` takes a GPU from
a ratio of peaks on that is rounded up from the three renders' geometric mean, rays by kernels
(`LEAST_ADVANTAGE`, `ncv_cl/opencl/prefer.py`).
"""
    rows = []
    for name, (one, factor, seconds) in predictions.items():
        ratio = seconds / one.seconds
        rows.append((name, f"{seconds:.3g}", f"{one.seconds:.2g}", f"{ratio:.0f} ×/÷ {factor:.1f}",
                     f"{peaks / ratio:.1f}"))  # fmt: skip
    yield from table(
        ("render", "two cores s", f"{H100.name} s", "ratio", "ratio of peaks over it"), rows
    )


def kernels(prediction: Prediction) -> Iterator[str]:
    """The table of one render's kernels, the longest first."""
    shown = sorted(prediction.kernels, key=lambda one: -one.seconds)
    yield from table(
        ("kernel", "launches", "items", "instructions", "operations", "bytes", "warps", "ms",
         "bound by"),
        (
            (f"`{one.name}`", f"{one.launches:.0f}", f"{one.items:.3g}", f"{one.instructions:.0f}",
             f"{one.flops:.0f}", f"{one.moved:.0f}", f"{one.warps:.1f}", f"{1e3 * one.seconds:.3g}",
             one.bound)
            for one in shown if one.seconds >= SHOWN * prediction.device
        ),
    )  # fmt: skip


def table(heads: Iterable[str], rows: Iterable[Iterable[str]]) -> Iterator[str]:
    """A Markdown table."""
    heads = tuple(heads)
    yield f"| {' | '.join(heads)} |"
    yield f"| {' | '.join(['---'] * len(heads))} |"
    for row in rows:
        yield f"| {' | '.join(row)} |"


if __name__ == "__main__":
    sys.exit(main())
