"""Small renders, estimates and integrals that between them build every program of the package."""

from __future__ import annotations

import itertools
import os
import pickle
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from fitting import fitting
from mesh_files import write_image

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
from ncv_cl.opencl.device import GROUP_SIZE, Device
from ncv_cl.opencl.kernel import Kernel
from ncv_cl.opencl.limits import DeviceMemory
from ncv_cl.opencl.probe import measure
from ncv_cl.points.sampler import SAMPLERS
from ncv_cl.settings.presets import PRESETS

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
# A disc and a sphere, whose points are no parallelogram's.
ROUND = (
    GLOSSY
    + """
[[lights]]
kind = "disc"
centre = [-2, 1, 0]
normal = [1, -1, 0]
radius = 0.5
radiance = 2
[[lights]]
kind = "sphere"
centre = [-1, 1, 1]
radius = 0.3
radiance = 2
"""
)
# Light from outside alone, and beside lights.
DARK = MATTE[: MATTE.index("[[lights]]")]
SKY = '[environment]\nsky = "overcast"\n'
SUN = "[environment.sun]\nelevation = 30\nirradiance = 2\n"
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
GLASS = (
    MATTE.replace("[[quads]]", "[materials.glass]\ntransmission = 1\nroughness = 0.2\n[[quads]]", 1)
    + '[[spheres]]\ncenter = [0, 1, 0]\nradius = 0.5\nmaterial = "glass"\n'
)
# Thin, and as many lights as have strips.
PANES = GLASS.replace("roughness = 0.2", "thin = true") + GLOSSY[GLOSSY.rindex("[[lights]]") :]

# An image on a matte and on a glossy floor, beside colours of vertices.
TEXTURED = MATTE.replace("albedo = [0.2, 0.5, 0.7]", 'albedo = { file = "image.exr" }')
GLOW_AND_BUMPS = 'emission = 2\nnormal = { file = "image.exr" }\n'
COLOURED = '[[meshes]]\nfile = "coloured.obj"\n'
VERTICES = "v -1 0.5 0 1 0 0\nv 1 0.5 0 0 1 0\nv 0 1 0 0 0 1\nf 1 2 3\n"


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
        (GLOWING, DirectLight()),
        (ROUND, DirectLight()),
        (ROUND, GlobalIllumination(3)),
        (GLASS, DirectLight()),
        (GLASS, GlobalIllumination(3)),
        (PANES, GlobalIllumination(3)),
        (DARK + SUN, DirectLight()),
        (GLOSSY + SKY + SUN, DirectLight()),
        (GLOSSY + SKY + SUN, GlobalIllumination(3)),
        (DARK + SKY, GlobalIllumination(3)),
        (TEXTURED, GlobalIllumination(3)),
        (
            TEXTURED.replace("[[quads]]", "reflectance = 0.2\n[[quads]]") + COLOURED,
            GlobalIllumination(3),
        ),
        (GLOSSY + COLOURED, GlobalIllumination(3)),
        (TEXTURED.replace("[[quads]]", GLOW_AND_BUMPS + "[[quads]]"), GlobalIllumination(3)),
    ]
    write_image(folder / "image.exr", np.full((2, 3, 3), 0.5, np.float32), "half")
    (folder / "coloured.obj").write_text(VERTICES)
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
    # Rays by kernels, those of paths too, of more triangles than are tested one by one.
    scene.write_text(MATTE + GLOWING[GLOWING.index("[[spheres]]") :], encoding="utf-8")
    render(scene, GlobalIllumination(3), "mc", rays="device", spp=2, size=(4, 4), device=device)
    # Paths that are followed to their ends where the host does not know how many are left.
    memory = DeviceMemory(False, device.memory.largest, device.memory.total)
    discrete = replace(device, memory=memory)
    for text in (scene.read_text(encoding="utf-8"), MATTE):
        scene.write_text(text, encoding="utf-8")
        render(scene, GlobalIllumination(), "mc", rays="device", spp=2, size=(4, 4), device=discrete)
    disc = ROUND[: ROUND.index('[[lights]]\nkind = "sphere"')]
    for text, density in ((MATTE, "subdivision"), (disc, "table")):
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


def programs_of(device: Device, folders: pytest.TempPathFactory) -> list[Built]:
    """What `build_everything` builds for a device, once for all processes of a run of pytest."""
    import fcntl  # Not on Windows, which has none of what takes these programs.

    # Workers of pytest-xdist have the folder above theirs in common, and no other run has it.
    shared = folders.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        shared = shared.parent
    kept = shared / f"programs_{device.vector_width}_{device.lanes}.pickle"
    with kept.with_suffix(".lock").open("w") as lock:
        # Others wait here; the file is closed, and so unlocked, whatever happens.
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not kept.exists():
            built = build_everything([device], folders.mktemp("programs"))
            kept.write_bytes(pickle.dumps(built))
        return pickle.loads(kept.read_bytes())


@dataclass(frozen=True)
class Built:
    """A program, and its kernels that were launched.

    Attributes
    ----------
    files : tuple
        As `build` takes them.
    defines : dict
        All `-D` constants, those of the device too.
    groups : dict
        Work-items of a group by the name of each kernel that was launched.
    """

    files: tuple[program.KernelFile, ...]
    defines: dict[str, int | str]
    groups: dict[str, int]


def build_everything(devices: list[Device], folder: Path) -> list[Built]:
    """Every program, built for each of the devices, and launched."""
    groups: dict[int, dict[str, int]] = {}
    own_kernel, call, repeat = program.Program.own_kernel, Kernel.__call__, Kernel.repeat

    def noting(plain_program: program.Program, name: str) -> Kernel:
        kernel = own_kernel(plain_program, name)
        kernel.launched = groups.setdefault(id(plain_program), {})
        return kernel

    def called(
        kernel: Kernel, items: object, /, *, group: object = GROUP_SIZE, **arguments: object
    ) -> None:
        kernel.launched[kernel.name] = int(np.prod(group))
        return call(kernel, items, group=group, **arguments)

    def repeated(kernel: Kernel, number: int, items: int, group: int = GROUP_SIZE) -> None:
        kernel.launched[kernel.name] = group
        repeat(kernel, number, items, group)

    with pytest.MonkeyPatch.context() as patch:
        built: dict[object, program.Program] = {}
        patch.setattr(program, "_programs", built)
        patch.setattr(program.Program, "own_kernel", noting)
        patch.setattr(Kernel, "__call__", called)
        patch.setattr(Kernel, "repeat", repeated)
        # Only what is built matters here: without optimisation that takes half the time.
        options = program.option_list
        patch.setattr(program, "option_list", lambda defines: [*options(defines), "-cl-opt-disable"])
        for number, device in enumerate(devices):
            own = folder / f"scenes{number}"
            own.mkdir()
            render_everything(device, own)
            estimate_everything(device)
            integrate_everything(device)
            measure(device)
        return [Built(one.files, one.defines, groups.get(id(one), {})) for one in built.values()]
