"""Renders under oclgrind: no bad access, data race, divergent barrier or uninitialised read."""

from __future__ import annotations

import itertools
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from mesh_files import write_image
from test_certificate import TORTURE_NAMES

import ncv_cl
from ncv_cl.integrands import INTEGRANDS
from ncv_cl.integration.integrator import INTEGRATION_METHODS
from ncv_cl.opencl.device import GPU_LANES
from ncv_cl.points.sampler import SAMPLERS

OCLGRIND = shutil.which("oclgrind")
PROGRAM = Path(__file__).with_name("oclgrind_run.py")
# Without optimisation, as oclgrind 21.10 knows neither llvm.bitreverse nor how to follow sincos, and
# without inlining, which makes of restrict pointers what it does not know either.
BUILD_OPTIONS = "-cl-opt-disable -DINLINED= -Dsincos(x,cosine)=(*(cosine)=cos(x),sin(x))"
CHECKS = ["--data-races", "--uninitialized", "--local-mem-size", "49152"]
# (VEC, LANES) of a CPU and of a GPU; with float16 oclgrind reports initialised values as uninitialised.
SHAPES = [(8, 1), (1, GPU_LANES)]

pytestmark = [
    pytest.mark.oclgrind,
    pytest.mark.slow,
    pytest.mark.skipif(OCLGRIND is None, reason="oclgrind is not installed"),
]


def simulate(log: Path, *command: str | Path) -> str:
    """Run Python under oclgrind; returns what the simulator found fault with."""
    environment = {
        **os.environ,
        "PYTHONPATH": str(Path(ncv_cl.__file__).parent.parent),
        # Neither pyopencl's cached binaries nor the package's cached probe.
        "PYOPENCL_NO_CACHE": "1",
        "XDG_CACHE_HOME": str(log.parent),
    }
    environment.pop("OCL_ICD_VENDORS", None)
    done = subprocess.run(
        [OCLGRIND, "--log", log, "--build-options", BUILD_OPTIONS, *CHECKS, sys.executable, *command],
        capture_output=True,
        text=True,
        env=environment,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "Oclgrind" in done.stdout, f"another device was used: {done.stdout}"
    # oclgrind exits with 0 whatever it finds; the log is what tells.
    return log.read_text(encoding="utf-8")


@pytest.mark.parametrize("vec, lanes", SHAPES)
@pytest.mark.parametrize(
    "integrand, method, sampler",
    [
        *itertools.product(sorted(set(INTEGRANDS) - {"gi"}), ("mc", "ncv"), SAMPLERS),
        # Paths take the simulator minutes, and differ in their sampler as the others do.
        ("gi", "ncv", "sobol"),
        # One from outside the package.
        (f"{PROGRAM.parents[1] / 'examples' / 'my_integrand' / 'sky.py'}:Sky", "mc", "sobol"),
    ],
)
def test_simulator_finds_no_fault_in_a_render(integrand, method, sampler, vec, lanes, scenes, tmp_path):
    scene = scenes / "cornell_box.toml"
    faults = simulate(tmp_path / "log", PROGRAM, scene, integrand, method, sampler, str(vec), str(lanes))
    assert not faults, faults[:5000]


# Two lights, and more than kernels look at one by one.
@pytest.mark.parametrize("vec, lanes", SHAPES)
@pytest.mark.parametrize("integrand", ["direct", "gi"])
@pytest.mark.parametrize("more", [0, 8])
def test_simulator_finds_no_fault_with_several_lights(integrand, more, vec, lanes, scenes, tmp_path):
    scene = tmp_path / "lights.toml"
    lamp = "[[lights]]\ncorner = [{}, 2.5, 0]\nedge1 = [0.1, 0, 0]\nedge2 = [0, 0, 0.1]\nradiance = 1\n"
    lamps = "".join(lamp.format(0.2 * k) for k in range(more))
    scene.write_text((scenes / "interior.toml").read_text(encoding="utf-8") + lamps, encoding="utf-8")
    faults = simulate(tmp_path / "log", PROGRAM, scene, integrand, "mc", "sobol", str(vec), str(lanes))
    assert not faults, faults[:5000]


@pytest.mark.parametrize("vec, lanes", SHAPES)
def test_simulator_finds_no_fault_in_textures(vec, lanes, scenes, tmp_path):
    """Images that go on in each way, on a glossy surface too, and colours of vertices."""
    write_image(tmp_path / "image.exr", np.full((2, 3, 3), 0.5, np.float32), "half")
    image = '{ file = "image.exr", wrap = "repeat", scale = 50 }'
    text = (
        (scenes / "plane_light.toml")
        .read_text(encoding="utf-8")
        .replace("albedo = 0.5", f"albedo = {image}")
    )
    other = image.replace('"repeat"', '["mirror", "clamp"]')
    text += (
        f"[materials.gloss]\nalbedo = {other}\nreflectance = 0.1\nnormal = {other}\nemission = {other}\n"
    )
    text += '[[boxes]]\nmin = [-2, 0, -2]\nmax = [2, 1, 1]\nmaterial = "gloss"\n'
    text += '[[meshes]]\nfile = "coloured.obj"\n'
    (tmp_path / "coloured.obj").write_text("v -9 5 -3 1 0 0\nv 9 5 -3 0 1 0\nv 0 -5 -3 0 0 1\nf 1 2 3\n")
    (tmp_path / "scene.toml").write_text(text, encoding="utf-8")
    arguments = ("gi", "mc", "sobol", str(vec), str(lanes))
    faults = simulate(tmp_path / "log", PROGRAM, tmp_path / "scene.toml", *arguments)
    assert not faults, faults[:5000]


@pytest.mark.parametrize("vec, lanes", SHAPES)
@pytest.mark.parametrize("integrand", ["direct", "gi"])
def test_simulator_finds_no_fault_under_a_sky(integrand, vec, lanes, scenes, tmp_path):
    """An image and a sun beside lights, on matte and glossy surfaces."""
    scene = tmp_path / "sky.toml"
    sky = '[environment]\nsky = "overcast"\n[environment.sun]\nelevation = 40\nirradiance = 2\n'
    scene.write_text((scenes / "veach_plates.toml").read_text(encoding="utf-8") + sky, encoding="utf-8")
    faults = simulate(tmp_path / "log", PROGRAM, scene, integrand, "mc", "sobol", str(vec), str(lanes))
    assert not faults, faults[:5000]


@pytest.mark.parametrize("vec, lanes", SHAPES)
def test_simulator_finds_no_fault_at_points(vec, lanes, scenes, tmp_path):
    program = PROGRAM.with_name("oclgrind_points.py")
    faults = simulate(tmp_path / "log", program, scenes / "interior.toml", str(vec), str(lanes))
    assert not faults, faults[:5000]


@pytest.mark.parametrize("vec, lanes", SHAPES)
def test_simulator_finds_no_fault_in_a_lobe(vec, lanes, scenes, tmp_path):
    arguments = ("direct", "mc", "sobol", str(vec), str(lanes))
    faults = simulate(tmp_path / "log", PROGRAM, scenes / "veach_plates.toml", *arguments)
    assert not faults, faults[:5000]


@pytest.mark.parametrize("vec, lanes", SHAPES)
def test_simulator_finds_no_fault_in_a_density_by_the_subdivision(vec, lanes, scenes, tmp_path):
    scene = scenes / "cornell_box.toml"
    arguments = ("direct", "ncv", "sobol", str(vec), str(lanes), "subdivision")
    faults = simulate(tmp_path / "log", PROGRAM, scene, *arguments)
    assert not faults, faults[:5000]


@pytest.mark.parametrize("vec, lanes", SHAPES)
@pytest.mark.parametrize("name, density", [("cornell_box", "none"), ("interior", "table")])
def test_simulator_finds_no_fault_in_slices(name, density, vec, lanes, scenes, tmp_path):
    arguments = ("ao", "ncv", "sobol", str(vec), str(lanes), density, "lines")
    faults = simulate(tmp_path / "log", PROGRAM, scenes / f"{name}.toml", *arguments)
    assert not faults, faults[:5000]


@pytest.mark.parametrize("vec, lanes", SHAPES)
def test_simulator_finds_no_fault_in_what_slices_cost(vec, lanes, scenes, tmp_path):
    scene = scenes / "cornell_box.toml"
    arguments = ("ao", "mc", "sobol", str(vec), str(lanes), "none", "slices")
    faults = simulate(tmp_path / "log", PROGRAM, scene, *arguments)
    assert not faults, faults[:5000]


@pytest.mark.parametrize("vec, lanes", SHAPES)
@pytest.mark.parametrize("name", ["cornell_box", "interior"])
@pytest.mark.parametrize("listed", [1023, 0], ids=["lists", "walks"])
def test_simulator_finds_no_fault_along_lines(name, listed, vec, lanes, scenes, tmp_path):
    arguments = ("direct", "ncv", "sobol", str(vec), str(lanes), "table", "lines", str(listed))
    faults = simulate(tmp_path / "log", PROGRAM, scenes / f"{name}.toml", *arguments)
    assert not faults, faults[:5000]


@pytest.mark.parametrize("vec, lanes", SHAPES)
@pytest.mark.parametrize(
    "name, integrand, rays", [("knot", "ao", "device"), ("interior", "gi", "ahead")]
)
def test_simulator_finds_no_fault_in_rays_by_kernels(
    name, integrand, rays, vec, lanes, scenes, tmp_path
):
    arguments = (integrand, "mc", "sobol", str(vec), str(lanes), "none", "points", "", rays)
    faults = simulate(tmp_path / "log", PROGRAM, scenes / f"{name}.toml", *arguments)
    assert not faults, faults[:5000]


@pytest.mark.parametrize("vec, lanes", SHAPES)
@pytest.mark.parametrize("hidden", ["5x4", "3x3x3"])
@pytest.mark.parametrize("method", INTEGRATION_METHODS)
def test_simulator_finds_no_fault_in_an_integration(method, hidden, vec, lanes, tmp_path):
    program = PROGRAM.with_name("oclgrind_integrate.py")
    faults = simulate(tmp_path / "log", program, method, hidden, str(vec), str(lanes))
    assert not faults, faults[:5000]


# All but one, which takes the simulator minutes in the shape of a GPU.
@pytest.mark.parametrize("vec, lanes", SHAPES)
@pytest.mark.parametrize("method", INTEGRATION_METHODS)
@pytest.mark.parametrize("name", TORTURE_NAMES)
def test_simulator_finds_no_fault_where_lines_meet(name, method, vec, lanes, tmp_path):
    if (name, method, lanes) == ("hang_fan_32x32", "full", GPU_LANES):
        pytest.skip("takes minutes")
    program = PROGRAM.with_name("oclgrind_torture.py")
    faults = simulate(tmp_path / "log", program, method, "float32", str(vec), str(lanes), name)
    assert not faults, faults[:5000]


@pytest.mark.parametrize("vec, lanes", SHAPES)
@pytest.mark.parametrize(
    "method, name",
    [("decoupled", "dec3_border_pencil_all_6x6x6"), ("full", "full2_concurrent_all_dyadic_5x4")],
)
def test_simulator_finds_no_fault_in_double_precision(name, method, vec, lanes, tmp_path):
    program = PROGRAM.with_name("oclgrind_torture.py")
    faults = simulate(tmp_path / "log", program, method, "float64", str(vec), str(lanes), name)
    assert not faults, faults[:5000]


@pytest.mark.parametrize(
    "method, capacity, value, vec, lanes",
    [
        # A whole tile of vertices at least: for 32 lanes these networks have too few.
        ("full", "MAX_VERTICES", "16", 8, 1),
        ("full", "MAX_HALF_EDGES", "20", *SHAPES[0]),
        ("full", "MAX_FACES", "4", *SHAPES[1]),
        ("decoupled", "MAX_TRIANGLES", "4", *SHAPES[0]),
        ("decoupled", "CORNER_BOUNDS", "3,3", *SHAPES[1]),
    ],
)
def test_simulator_finds_no_fault_where_a_capacity_does_not_hold(
    method, capacity, value, vec, lanes, tmp_path
):
    program = PROGRAM.with_name("oclgrind_torture.py")
    name = "full3_concurrent_all_dyadic_6x6x6"
    arguments = (method, "float32", str(vec), str(lanes), name, capacity, value)
    faults = simulate(tmp_path / "log", program, *arguments)
    assert not faults, faults[:5000]


def test_simulator_finds_faults(tmp_path):
    program = tmp_path / "faulty.py"
    program.write_text(
        "import pyopencl as cl\n"
        "context = cl.create_some_context(interactive=False)\n"
        "print(context.devices[0].name)\n"
        "text = 'kernel void f(global int *x)'\n"
        "text += '{ x[get_global_id(0) + 1] = 2; x[0] = get_global_id(0); }'\n"
        "buffer = cl.Buffer(context, cl.mem_flags.READ_WRITE, 16)\n"
        "queue = cl.CommandQueue(context)\n"
        "cl.Kernel(cl.Program(context, text).build(), 'f')(queue, (4,), (4,), buffer)\n"
        "queue.finish()\n"
    )
    faults = simulate(tmp_path / "log", program)
    assert "Invalid write" in faults and "data race" in faults
