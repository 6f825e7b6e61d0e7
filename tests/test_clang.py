"""Every program that rendering and integration build passes clang's front end without a warning."""

from __future__ import annotations

import itertools
import os
import shutil
import subprocess
from concurrent.futures import ThreadPoolExecutor

import pytest
from every_program import programs_of

from ncv_cl.opencl import program
from ncv_cl.opencl.device import GPU_LANES, open_device

CLANG = shutil.which("clang")
FLAGS = ["-x", "cl", "-cl-std=CL1.2", "-Xclang", "-finclude-default-header", "-fsyntax-only"]
# (VEC, LANES) of a CPU and of a GPU.
SHAPES = [(16, 1), (1, GPU_LANES)]
WARNINGS = ["-Wall", "-Wextra", "-Wconversion", "-Wdouble-promotion", "-Werror"]

pytestmark = [pytest.mark.slow, pytest.mark.skipif(CLANG is None, reason="clang is not installed")]


@pytest.fixture(scope="module")
def programs(one_device, tmp_path_factory):
    """(files, defines) of every program, in the shapes of CPUs and GPUs."""
    shapes = [open_device(one_device.cl_device, one_device.index, *shape) for shape in SHAPES]
    built = itertools.chain(*(programs_of(shape, tmp_path_factory) for shape in shapes))
    return [(one.files, one.defines) for one in built]


def diagnostics(files: tuple[str, ...], defines: dict[str, int | str]) -> str:
    command = [CLANG, *FLAGS, *WARNINGS, *program.option_list(defines), "-"]
    done = subprocess.run(command, input=program.source(files), capture_output=True, text=True)
    return f"{' + '.join(files)} with {defines}\n{done.stderr}" if done.returncode else ""


def test_the_programs_cover_every_kernel_file_and_shape(programs):
    assert {name for files, _ in programs for name in files} == {
        kernel.stem for kernel in program.kernel_folder().glob("*/*.cl")
    }
    assert set(SHAPES) <= {(defines["VEC"], defines["LANES"]) for _, defines in programs}


@pytest.mark.parametrize("use_fma", [0, 1])
def test_clang_has_nothing_to_say(programs, use_fma):
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        found = pool.map(lambda one: diagnostics(one[0], {**one[1], "USE_FMA": use_fma}), programs)
        complaints = "\n".join(filter(None, found))
    assert not complaints, complaints


def test_clang_lane_notices_a_warning(monkeypatch):
    monkeypatch.setattr(program, "source", lambda files: "kernel void f(global float *x) { *x = 0.1; }")
    assert "double" in diagnostics(("none",), {})
