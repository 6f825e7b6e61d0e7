"""Every program that rendering and integration build passes clang's front end without a warning."""

from __future__ import annotations

import itertools
import os
import shutil
import subprocess
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from fitting import fitting

from ncv_cl import (
    AmbientOcclusion,
    DirectLight,
    GlobalIllumination,
    estimate,
    integrate,
    render,
)
from ncv_cl.integration import certificate
from ncv_cl.integration.subdivide import subdivide
from ncv_cl.opencl import program
from ncv_cl.opencl.device import GPU_LANES, Device, open_device
from ncv_cl.opencl.probe import measure
from ncv_cl.points.sampler import SAMPLERS
from ncv_cl.settings.presets import PRESETS

CLANG = shutil.which("clang")
FLAGS = ["-x", "cl", "-cl-std=CL1.2", "-Xclang", "-finclude-default-header", "-fsyntax-only"]
# (VEC, LANES) of a CPU and of a GPU.
SHAPES = [(16, 1), (1, GPU_LANES)]
WARNINGS = ["-Wall", "-Wextra", "-Wconversion", "-Wdouble-promotion", "-Werror"]

# Scenes specialise kernels by their lights and materials: one light and matte, several and glossy.
MATTE = """
[camera]
position = [0, 1, 3]
target = [0, 0, 0]
vertical_fov = 40
[materials.floor]
albedo = [0.2, 0.5, 0.7]
[[quads]]
corner = [-5, 0, -5]
edge1 = [0, 0, 10]
edge2 = [10, 0, 0]
material = "floor"
[[lights]]
corner = [-1, 2, -1]
edge1 = [2, 0, 0]
edge2 = [0, 0, 2]
radiance = 5
"""
GLOSSY = (
    MATTE.replace("[[quads]]", "reflectance = 0.2\nroughness = 0.3\n[[quads]]")
    + """
[[lights]]
corner = [2, 1, 0]
edge1 = [0, 1, 0]
edge2 = [0, 0, 1]
radiance = [3, 2, 1]
"""
)
# More lights than kernels look at one by one.
MANY = GLOSSY + "".join(
    f"[[lights]]\ncorner = [{x}, 2, 3]\nedge1 = [0.5, 0, 0]\nedge2 = [0, 0, 0.5]\nradiance = 1\n"
    for x in range(8)
)
# No light, and a surface that emits; a sphere has normals of its own.
GLOWING = (
    MATTE[: MATTE.index("[[lights]]")].replace("[[quads]]", "emission = 2\n[[quads]]")
    + """
[[spheres]]
center = [0, 1, 0]
radius = 0.5
material = "floor"
"""
)

pytestmark = [pytest.mark.slow, pytest.mark.skipif(CLANG is None, reason="clang is not installed")]


def render_everything(device: Device, folder: Path) -> None:
    """Renders that between them build every program of a render."""
    cases = [
        (MATTE, DirectLight()),
        (GLOSSY, DirectLight()),
        (MATTE, AmbientOcclusion(mapping="height")),
        (MATTE, AmbientOcclusion(mapping="cosine")),
        (MATTE, GlobalIllumination()),
        (GLOSSY, GlobalIllumination(3)),
        (MANY, DirectLight()),
        (MANY, GlobalIllumination(3)),
        (MATTE, GlobalIllumination(2, direct=False)),
        (GLOWING, GlobalIllumination(4)),
    ]
    options = zip(itertools.cycle(SAMPLERS), itertools.cycle(sorted(PRESETS)), strict=True)
    for (text, integrand), (sampler, preset) in zip(cases, options, strict=False):
        scene = folder / "scene.toml"
        scene.write_text(text, encoding="utf-8")
        render(
            scene,
            integrand,
            "ncv",
            sampler=sampler,
            spp=2,
            train_spp=1,
            size=(4, 4),
            preset=preset,
            device=device,
        )
    options = {"spp": 2, "train_spp": 1, "size": (4, 4), "device": device}
    render(scene, "ao", "ncv", density="subdivision", **options)
    for sampler, density in zip(SAMPLERS, ("subdivision", "table"), strict=True):
        render(scene, "ao", "ncv", sampler=sampler, density=density, visibility="lines", **options)
    for text, density in ((MATTE, "subdivision"), (GLOSSY, "table")):
        scene.write_text(text, encoding="utf-8")
        render(scene, "direct", "ncv", density=density, visibility="lines", **options)
    # So many samples that what slices cost is looked into.
    image = render(scene, "ao", "mc", **options | {"spp": 1024, "train_spp": "auto"})
    assert "slices" in image.stats


def estimate_everything(device: Device) -> None:
    """Integrals of a callable, sampled uniformly and by each density."""
    for options in ({"method": "mc"}, {"method": "ncv"}, {"method": "ncv", "density": "subdivision"}):
        estimate(lambda u, v, point: u, spp=2, device=device, **fitting(train_spp=1, **options))


def integrate_everything(device: Device) -> None:
    """Integrals by each method in each precision, with one hidden layer and with two."""
    cases = [
        ("decoupled", "float32", (2, 3, 1)),
        ("decoupled", "float64", (2, 3, 3, 1)),
        ("full", "float32", (2, 3, 3, 1)),
        ("full", "float64", (2, 3, 1)),
    ]
    generator = np.random.default_rng(0)
    for method, precision, widths in cases:
        if precision == "float64" and not device.has_float64:
            continue
        weights = [generator.normal(size=(n_out, n_in)) for n_in, n_out in itertools.pairwise(widths)]
        biases = [generator.normal(size=n_out) for n_out in widths[1:]]
        if method == "full":
            subdivide(weights, biases, precision=precision, device=device)
        with pytest.MonkeyPatch.context() as patch:
            # No arrangement is that exact: the programs of all stages are built.
            patch.setattr(certificate, "excess_tolerance", lambda *_: -1.0)
            integrate(weights, biases, method=method, precision=precision, device=device)
            integrate(
                weights, biases, method=method, precision=precision, device=device, return_bound=True
            )


@pytest.fixture(scope="module")
def programs(one_device, tmp_path_factory):
    """(files, defines) of every program, in the shapes of CPUs and GPUs."""
    with pytest.MonkeyPatch.context() as patch:
        built = {}
        patch.setattr(program, "_programs", built)
        # Only what is built matters here: without optimisation that takes half the time.
        options = program.option_list
        patch.setattr(program, "option_list", lambda defines: [*options(defines), "-cl-opt-disable"])
        for vec, lanes in SHAPES:
            device = open_device(one_device.cl_device, one_device.index, vec, lanes)
            render_everything(device, tmp_path_factory.mktemp("scene"))
            estimate_everything(device)
            integrate_everything(device)
            measure(device)
        return [(one.files, one.defines) for one in built.values()]


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
