"""Rays by kernels beside embree's: millions a second of one core, first hits and shadow rays.

Usage: python bench/bench_rays.py [SCENE ...] [--cut N] [--rays N] [--quick] [--json FILE]

Rays leave the points of surfaces that the camera sees, as samples do, in all directions above them;
shadow rays end at one length of the direction. Each kind is timed in processor seconds, the least of
several runs: by embree with its binding, and by kernels in the device's own shape and, on a CPU, in that
of a GPU.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from training import SCENES
from visibility_case import cut_in_four

from ncv_cl.opencl.choose import choose_device
from ncv_cl.opencl.device import GPU_LANES, Device, open_device
from ncv_cl.opencl.memory import HostArray
from ncv_cl.points.points import find_points
from ncv_cl.points.trace import Tracer
from ncv_cl.sampling.waves.wave import HEADER, HOST_PLANES, PLANES
from ncv_cl.sampling.waves.waves import Waves
from ncv_cl.scene.load import Scene, load_scene
from ncv_cl.visibility.hierarchy import Hierarchy
from ncv_cl.visibility.rays import RayCount, shadow_rays
from ncv_cl.visibility.trace import DeviceTracer

RUNS = 5


def rays_of(device: Device, scene: Scene, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Origins and directions, float32 (count, 3): cosine-distributed about surfaces' normals."""
    points = find_points(device, scene, Tracer(scene, 1), 256, 256, 1, True)
    normal = points.rows("geometric_normal").T
    start = points.rows("position").T + points.rows("offset").T * normal
    generator = np.random.default_rng(1)
    chosen = np.sort(generator.integers(0, points.active, count))
    ball = generator.normal(size=(count, 3))
    towards = normal[chosen] + ball / np.linalg.norm(ball, axis=1, keepdims=True)
    return start[chosen].astype(np.float32), towards.astype(np.float32)


def least_seconds(work: Callable[[], None]) -> float:
    """Processor seconds of `work`, after a first run that compiles."""
    work()
    found = []
    for _ in range(RUNS):
        begun = time.process_time()
        work()
        found.append(time.process_time() - begun)
    return min(found)


def by_embree(scene: Scene, origins: np.ndarray, directions: np.ndarray) -> tuple[float, float]:
    tracer, count = Tracer(scene, 1), len(origins)
    visible, ends = np.empty(count, np.uint8), np.ones(count, np.float32)
    first = least_seconds(lambda: tracer.closest(origins, directions))
    return first, least_seconds(lambda: tracer.visible(origins, directions, ends, visible))


def by_kernels(
    device: Device, hierarchy: Hierarchy, origins: np.ndarray, directions: np.ndarray
) -> tuple[float, float]:
    tracer, count = DeviceTracer(device, hierarchy), len(origins)
    waves = Waves(device, tracer, by_kernels=False, panes=False)
    waves.make(count)
    wave = waves.begin(count)

    def first_hits() -> None:
        with wave.words.mapped(update=True) as words:
            words[:1].view(np.uint32)[0] = count
            host = words[HEADER : HEADER + HOST_PLANES * wave.plane]
            planes = host.reshape(HOST_PLANES, wave.plane)
            planes[PLANES["origin"], :count] = origins.T
            planes[PLANES["direction"], :count] = directions.T
        waves.trace(bounce=1)
        device.queue.finish()

    rays, visible = shadow_rays(device, tracer, count, False), HostArray(device, count, np.uint8)
    for name, rows in (
        ("origins", origins),
        ("directions", directions),
        ("distances", np.ones(count, np.float32)),
        ("ray_count", np.array([count, 0, 0], np.uint32)),
    ):
        with rays.arguments[name].mapped(write=True) as view:
            view[...] = rows

    def shadows() -> None:
        rays.answer(count, visible, RayCount())
        device.queue.finish()

    return least_seconds(first_hits), least_seconds(shadows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", nargs="*", default=["cornell_box", "interior", "knot"])
    parser.add_argument("--cut", type=int, default=0, help="cut every triangle into four, so many times")
    parser.add_argument("--rays", type=int, default=1 << 18)
    parser.add_argument("--quick", action="store_true", help="one scene, few rays")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the rows here")
    options = parser.parse_args()
    if options.quick:
        options.scene, options.rays = options.scene[:1], 1 << 14
    rows = []
    own = choose_device()
    shapes = [own]
    if own.is_cpu:
        shapes.append(open_device(own.cl_device, own.index, vector_width=1, lanes=GPU_LANES))
    for name in options.scene:
        scene = load_scene(SCENES / f"{name}.toml")
        for _ in range(options.cut):
            scene = cut_in_four(scene)
        rays = rays_of(own, scene, options.rays)
        rates = options.rays / 1e6 / np.array(by_embree(scene, *rays))
        print(
            f"{name}, {len(scene.triangles)} triangles, million rays a second: first hits, shadow rays"
        )
        print(f"  embree        {rates[0]:6.2f} {rates[1]:6.2f}")
        about = {"scene": name, "triangles": len(scene.triangles)}
        rows.append(row_of(about, "embree", rates))
        begun = time.process_time()
        hierarchy = Hierarchy(own, scene)
        built = time.process_time() - begun
        for device in shapes:
            rates = options.rays / 1e6 / np.array(by_kernels(device, hierarchy, *rays))
            print(f"  {device.shape:26}{rates[0]:6.2f} {rates[1]:6.2f}", flush=True)
            rows.append(row_of(about, device.shape, rates))
        print(f"  boxes built in {built:.2f} s")
    if options.json:
        found = {"device": own.identity, "rays": options.rays, "rows": rows}
        options.json.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


def row_of(about: dict[str, object], by: str, rates: np.ndarray) -> dict[str, object]:
    """Million rays a second, of one core."""
    return {**about, "by": by, "first_hits": float(rates[0]), "shadow_rays": float(rates[1])}


if __name__ == "__main__":
    main()
