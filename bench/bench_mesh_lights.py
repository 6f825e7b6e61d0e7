"""What a mesh that emits costs, and how its triangles are best dealt out to strips of the square.

    python bench/bench_mesh_lights.py             direct light and paths, by the mesh's triangles
    python bench/bench_mesh_lights.py strips      MOST_SURFACE_STRIPS and STAND_INS of light_sources.py
    python bench/bench_mesh_lights.py lobes       MOST_MET of direct.py: with and without lobes' strips

The scene is a room with a ring of light over its floor, or a sphere, beside a shelf. Of each the mean
variance of pixels, processor seconds of the render (its second, so that kernels are compiled), their
product, and the seconds before the first sample that lights take. `--json` keeps the rows of the first.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType

import numpy as np
import trimesh

import ncv_cl as ncv
from ncv_cl.integrands import direct, light_sources
from ncv_cl.integrands.lights import light_records

SPP, SIZE = 64, (64, 48)
# Of the sphere's triangles into four.
SUBDIVISIONS, QUICK_SUBDIVISIONS = (1, 2, 3, 4, 5), (1,)


def room(triangles: np.ndarray, reflectance: float = 0.0, roughness: float = 1.0) -> ncv.Scene:
    """A floor, a wall and a shelf, and triangles (n, 3, 3) that emit."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    places = [
        (np.array([[0, 0, 6], [6, 0, 0], [0, 0, 0]]), (-3, 0, -3)),
        (np.array([[6, 0, 0], [0, 3, 0], [0, 0, 0]]), (-3, 0, -3)),
        (np.array([[2, 0, 0], [0, 0, 1], [0, 0, 0]]), (0.3, 0.6, -1.5)),
    ]
    meshes = [ncv.TriangleMesh(corners @ edges + corner, faces, "dull") for edges, corner in places]
    own = np.arange(3 * len(triangles)).reshape(-1, 3)
    meshes.append(ncv.TriangleMesh(triangles.reshape(-1, 3), own, "bright"))
    materials = {
        "dull": ncv.Material(0.6, reflectance, roughness),
        "bright": ncv.Material(0.2, emission=5.0),
    }
    return ncv.build_scene(ncv.Camera((0.5, 2, 6), (0, 0.8, 0), 42), materials, meshes)


def sphere(subdivisions: int) -> np.ndarray:
    ball = trimesh.creation.icosphere(subdivisions=subdivisions)
    return 0.4 * ball.vertices[ball.faces] + [-0.8, 1.0, 0.5]


def ring(sections: int) -> np.ndarray:
    """A torus, which is near the floor on one side and far on the other."""
    torus = trimesh.creation.torus(1.6, 0.06, major_sections=8 * sections, minor_sections=sections)
    torus.apply_transform(trimesh.transformations.rotation_matrix(1.2, [1, 0, 0.3]))
    return torus.vertices[torus.faces] + [0.0, 1.75, -0.5]


@contextmanager
def changed(module: ModuleType, **values: int) -> Iterator[None]:
    before = {name: getattr(module, name) for name in values}
    for name, value in values.items():
        setattr(module, name, value)
    try:
        yield
    finally:
        for name, value in before.items():
            setattr(module, name, value)


def measured(scene: ncv.Scene, integrand: str) -> dict[str, float]:
    begun = time.process_time()
    light_records(scene)
    ready = time.process_time() - begun
    options = {"method": "mc", "spp": SPP, "size": SIZE, "seed": 1, "sampler": "independent"}
    ncv.render(scene, integrand, **options)
    begun = time.process_time()
    image = ncv.render(scene, integrand, **options)
    seconds = time.process_time() - begun
    variance = float(image.variance.mean())
    return {"ready": ready, "variance": variance, "seconds": seconds, "product": variance * seconds}


def say(name: str, row: dict[str, float]) -> None:
    print(name, ", ".join(f"{key} {value:.3g}" for key, value in row.items()), flush=True)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", nargs="?", choices=("triangles", "strips", "lobes"), default="triangles")
    parser.add_argument("--quick", action="store_true", help="of `triangles` one number")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the rows of `triangles` here")
    options = parser.parse_args()
    what, rows = options.what, []
    if what == "triangles":
        for subdivisions in QUICK_SUBDIVISIONS if options.quick else SUBDIVISIONS:
            scene, triangles = room(sphere(subdivisions)), 20 * 4**subdivisions
            for integrand in ("direct", "gi"):
                row = measured(scene, integrand)
                say(f"sphere of {triangles}, {integrand}:", row)
                rows.append({"triangles": triangles, "integrand": integrand, **row})
        if options.json:
            options.json.write_text(json.dumps({"rows": rows}, indent=1) + "\n", encoding="utf-8")
    elif what == "strips":
        for name, mesh in (("sphere", sphere(4)), ("ring", ring(12))):
            for strips in (1, 4, 16, 64, 256):
                for stand_ins in (2, 8):
                    values = {"MOST_SURFACE_STRIPS": strips, "STAND_INS": stand_ins}
                    with changed(light_sources, **values):
                        say(f"{name}, {strips} strips, {stand_ins}:", measured(room(mesh), "direct"))
    else:
        for subdivisions in (2, 3, 4):
            for most in (0, 1 << 30):
                with changed(direct, MOST_MET=most):
                    scene = room(sphere(subdivisions), 0.5, 0.3)
                    lobes = "with lobes" if most else "without"
                    say(f"{20 * 4**subdivisions} triangles, {lobes}:", measured(scene, "direct"))
    return 0


if __name__ == "__main__":
    sys.exit(main())
