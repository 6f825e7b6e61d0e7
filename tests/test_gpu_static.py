"""Kernels compiled for GPUs that are not here: no spills, no private arrays in memory, enough warps.

``python tests/test_gpu_static.py`` writes docs/gpu_kernels.md anew.
"""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import pytest
from every_program import Built, build_everything, programs_of
from gpu.amd import Amd
from gpu.compilers import Compiler, Row, worst_rows
from gpu.nvidia import Nvidia

from ncv_cl.opencl.choose import all_devices
from ncv_cl.opencl.device import GPU_LANES, Device, open_device

MAKERS = {"nvidia": ("sm_80", "sm_90"), "amd": ("gfx1100",)}
TABLE = Path(__file__).parent.parent / "docs" / "gpu_kernels.md"
# Every device has so many bytes of local memory; and the least part of warps that is resident.
LOCAL_MEMORY = 48 << 10
OCCUPANCY = 0.25
# Kernels that take more, of (bytes spilt, bytes of stack, occupancy), and why: by the name of a form, or
# of a kernel for those of its forms that have none of their own.
EXCEPTIONS = {
    "column_moments": (40, 64, 0.15, "once an image; all weights of a network are in its loop"),
    "count_leaves": (0, 352, OCCUPANCY, "1024 slices an image; a slice's blocked parts"),
    "draw_samples": (0, 32, OCCUPANCY, "where densities lie on the subdivision's triangles"),
    "draw_samples (any scene)": (112, 128, 0.15, "lights of every shape, and an environment"),
    "draw_samples (lines)": (256, 896, 0.15, "the free parts of two lines; with one light no spill"),
    "draw_samples (lines, any scene)": (288, 912, 0.15, "the same, of several shapes of lights"),
    "draw_samples (slices)": (0, 352, OCCUPANCY, "a slice's blocked parts"),
    "find_occluders": (0, 624, OCCUPANCY, "once an image; where a walk is in boxes, of each light"),
    "fold": (0, 0, 0.12, "once an image; a point's features, which every row reads"),
    "follow_paths": (80, 256, 0.15, "few paths, each to its end: what rays hit and shading in one"),
    "gradients": (0, 0, 0.12, "wide networks: what samples leave lies in local memory"),
    "integrate (a group a point)": (212, 216, 0.06, "what a group shares lies in local memory"),
    "integrate (a work-item a point)": (72, 7552, OCCUPANCY, "a point's arrangement, which is private"),
    "integrate (a work-item a point, double)": (128, 3456, OCCUPANCY, "the same, of smaller networks"),
    "integrate (a group a point, double)": (1056, 704, 0.18, "few points, which float fails"),
    "integrate_robust": (16, 8, OCCUPANCY, "few points; numbers of twice the length"),
    "shade_hits": (112, 256, 0.15, "glass, textures and an environment together; else 144 of stack"),
    "share_rays": (544, 496, OCCUPANCY, "a group's eight members, which every path is held against"),
    "unshadowed_means": (64, 96, 0.15, "once an image; lights of every shape and an environment"),
}

pytestmark = pytest.mark.slow


def compiler_of(maker: str, scratch: Path) -> Compiler:
    archs = MAKERS[maker]
    return Nvidia(archs, scratch) if maker == "nvidia" else Amd(*archs)


def gpu_shape(device: Device) -> Device:
    return open_device(device.cl_device, device.index, vector_width=1, lanes=GPU_LANES)


@pytest.fixture(scope="module")
def programs(one_device, tmp_path_factory) -> list[Built]:
    return programs_of(gpu_shape(one_device), tmp_path_factory)


@pytest.mark.parametrize("maker", MAKERS)
def test_no_kernel_takes_more_than_a_gpu_has(programs, tmp_path, maker):
    compiler = compiler_of(maker, tmp_path)
    if compiler.missing:
        pytest.skip(f"{maker}: no {compiler.missing}")
    complaints = [
        found for row in worst_rows(compiler, programs, os.cpu_count()) if (found := beyond(row))
    ]
    assert not complaints, "\n".join(complaints)


def beyond(row: Row) -> str:
    """What of a kernel is beyond its limits, in words; nothing if none is."""
    of_kernel = EXCEPTIONS.get(row.kernel, (0, 0, OCCUPANCY, ""))
    spilt, stack, occupancy, _ = EXCEPTIONS.get(row.name, of_kernel)
    found = []
    if row.spilt > spilt:
        found.append(f"spills {row.spilt} bytes")
    if row.stack > stack:
        found.append(f"has a stack of {row.stack} bytes")
    if row.occupancy < occupancy:
        found.append(f"has {row.occupancy:.0%} of the warps, bound by {row.bound}")
    if row.local > LOCAL_MEMORY:
        found.append(f"takes {row.local} bytes of local memory")
    return f"{row.arch}: {row.name} {', '.join(found)}" if found else ""


def test_the_lane_notices_an_array_that_is_not_in_registers(tmp_path, one_device):
    text = """kernel void f(global float *x, const uint n) {
        float a[64];
        for (uint k = 0; k < 64; ++k) a[k] = x[k];
        for (uint k = 0; k < n; ++k) a[(uint)x[k] & 63] += x[k + 1];
        for (uint k = 0; k < 64; ++k) x[k] = a[k];
    }"""
    checked = 0
    for maker in MAKERS:
        compiler = compiler_of(maker, tmp_path)
        if compiler.missing is None:
            rows = compiler.rows(text, ["-cl-std=CL1.2"], {"f": 64})
            assert [row.arch for row in rows] == list(compiler.archs)
            assert all("stack" in beyond(row) for row in rows)
            checked += 1
    if not checked:
        pytest.skip("no compiler of a GPU")


INTRODUCTION = f"""# Kernels on GPUs, by their compilers

No GPU was at hand: clang and ptxas, and clang for AMD, compiled every kernel in the shape of a GPU
(one work-item a lane, {GPU_LANES} lanes), and say what it takes. Of all programs of a kernel's form,
a row shows the one that takes most; "any scene" is one with glass, textures, light from outside, or
lights that are many or no parallelograms. `python tests/test_gpu_static.py` writes this page, and
`pytest tests/test_gpu_static.py` fails where a kernel spills registers, keeps a private array in
memory, or leaves less than {OCCUPANCY:.0%} of the warps resident, but for the exceptions at the end.
The code is `tests/gpu/`; what a GPU has to offer is in [devices.md](devices.md).
"""
COLUMNS = ("kernel", "registers", "spilt B", "stack B", "local B", "group", "occupancy", "bound by")


def table(rows: list[Row]) -> str:
    """docs/gpu_kernels.md."""
    lines = [INTRODUCTION]
    for arch in dict.fromkeys(row.arch for row in rows):
        lines += [f"## {arch}", "", line_of(COLUMNS), line_of(["---"] * len(COLUMNS))]
        for row in rows:
            if row.arch == arch:
                numbers = (row.registers, row.spilt, row.stack, row.local, row.group)
                lines.append(line_of((row.name, *numbers, f"{row.occupancy:.0%}", row.bound)))
        lines.append("")
    lines += ["## Exceptions", ""]
    lines += [f"- `{name}`: {why}" for name, (*_, why) in sorted(EXCEPTIONS.items())]
    return "\n".join(lines) + "\n"


def line_of(cells: Sequence[object]) -> str:
    return f"| {' | '.join(map(str, cells))} |"


def main() -> int:
    one = next(device for device in all_devices() if device.is_cpu)
    with tempfile.TemporaryDirectory() as folder:
        programs = build_everything([gpu_shape(one)], Path(folder))
        compilers = {maker: compiler_of(maker, Path(folder)) for maker in MAKERS}
        missing = [f"{maker}: no {one.missing}" for maker, one in compilers.items() if one.missing]
        if missing:
            print("\n".join(missing), file=sys.stderr)
            return 1
        found = [row for one in compilers.values() for row in worst_rows(one, programs, os.cpu_count())]
    TABLE.write_text(table(found), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
