"""What each stage costs, in seconds and memory, as a render grows.

Against points (64² to 2048²), the network's widths, triangles (1e2 to 1e6, spheres over a plane), and
threads (1, 2); and exact integration against width and depth, since only the integrator knows other
depths than two. Every configuration runs in a process of its own, so that no peak of memory leaks into
the next one. There a small render compiles the kernels first; seconds are then medians over the repeats.

Memory is the process's resident high-water mark while a stage runs (Linux; elsewhere only the whole
process's), so it includes what earlier stages left.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import resource
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

SCENES = Path(__file__).parent.parent / "scenes"
# Spheres and subdivisions of each: 20 * 4^subdivisions triangles a sphere.
SPHERES = {100: (5, 0), 960: (12, 1), 9920: (31, 2), 99840: (78, 3), 998400: (195, 4)}
# (width, hidden layers) of integrated networks.
INTEGRATED = ((8, 2), (16, 2), (32, 2), (64, 2), (16, 1), (16, 3), (8, 4))
# What 2048 x 2048 points may take.
LARGEST_BYTES = 6e9
# A whole configuration must not take longer.
TIMEOUT = 900
WHOLE = "whole"


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="few and small configurations")
    parser.add_argument("--json", metavar="FILE", help="write the results here")
    parser.add_argument("--device", metavar="D", help="as for ncv-cl render")
    parser.add_argument("--job", help=argparse.SUPPRESS)
    options = parser.parse_args(argv)
    if options.job is not None:
        json.dump(_measure(json.loads(options.job)), sys.stdout)
        return 0
    report = run(options.quick, options.device)
    if options.json:
        Path(options.json).write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    return 0


def run(quick: bool, device: int | str | None = None) -> dict:
    """All sweeps: lists of rows, each with its configuration, stages' seconds and gigabytes."""
    report: dict = {}
    for sweep, jobs in sweeps(quick).items():
        print(f"\n{sweep}", flush=True)
        report[sweep] = []
        for job in jobs:
            row = job | _in_a_process(job | {"device": device})
            report["device"] = row.pop("device")
            report[sweep].append(row)
            _show(row)
    largest = report["points"][-1]
    report["largest_bytes"] = largest["bytes"][WHOLE]
    report["largest_fits"] = report["largest_bytes"] <= LARGEST_BYTES
    print(f"\n{report['device']}\nmost memory: {report['largest_bytes'] / 1e9:.2f} GB")
    return report


def sweeps(quick: bool) -> dict[str, list[dict]]:
    """The configurations, by what varies."""
    sizes = (64, 128, 256) if quick else (64, 128, 256, 512, 1024, 2048)
    widths = (8, 32) if quick else (8, 16, 32, 64)
    triangles = tuple(SPHERES)[:3] if quick else tuple(SPHERES)
    size, repeats = (64, 1) if quick else (256, 3)
    networks = INTEGRATED[:3] if quick else INTEGRATED
    plain = {"size": size, "spp": 64, "method": "mc", "repeats": repeats}
    learned = {"size": size, "spp": 16, "method": "ncv", "repeats": repeats}
    return {
        "points": [
            learned | {"size": n, "spp": 4 if n > 1024 else 16, "repeats": 1 if n > 512 else repeats}
            for n in sizes
        ],
        "width": [learned | {"width": width} for width in widths],
        "triangles": [plain | {"triangles": number} for number in triangles],
        "threads": [one | {"threads": n} for one in (plain, learned) for n in (1, 2)],
        "integration": [
            {"width": width, "depth": depth, "points": 256 if quick else 2048, "repeats": repeats}
            for width, depth in networks
        ],
    }


def _in_a_process(job: dict) -> dict:
    environment = dict(os.environ)
    if "threads" in job:
        environment["POCL_MAX_PTHREAD_COUNT"] = str(job["threads"])
    command = [sys.executable, __file__, "--job", json.dumps(job)]
    done = subprocess.run(
        command, env=environment, capture_output=True, text=True, timeout=TIMEOUT, check=False
    )
    if done.returncode:
        raise RuntimeError(f"{job} failed:\n{done.stderr}")
    return json.loads(done.stdout)


def _show(row: dict) -> None:
    configuration = " ".join(
        f"{key} {row[key]}"
        for key in ("method", "size", "width", "depth", "triangles", "threads")
        if key in row
    )
    used = row.get("bytes", {})
    parts = [
        f"{stage} {seconds:.3f} s" + (f" ({used[stage] / 1e9:.2f} GB)" if stage in used else "")
        for stage, seconds in row["seconds"].items()
        if seconds >= 5e-4
    ]
    whole = f" | most {used[WHOLE] / 1e9:.2f} GB" if WHOLE in used else ""
    print(f"  {configuration:32} {', '.join(parts)}{whole}", flush=True)


# ---- in a process of its own -----------------------------------------------------------------------


def _measure(job: dict) -> dict:
    """One configuration's seconds and bytes."""
    if "threads" in job and hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: job["threads"]])
    from ncv_cl.opencl.choose import choose_device

    device = choose_device(job["device"])
    found = _integrate(job, device) if "points" in job else _render(job, device)
    return found | {"device": device.identity}


def _render(job: dict, device: object) -> dict:
    import ncv_cl as ncv
    from ncv_cl.settings.presets import PRESETS

    preset = "default"
    if "width" in job:
        preset = f"width {job['width']}"
        PRESETS[preset] = replace(PRESETS["default"], hidden=(job["width"], job["width"]))
    scene = spheres(*SPHERES[job["triangles"]]) if "triangles" in job else None
    options = {
        "scene": scene or ncv.load_scene(SCENES / "cornell_box.toml"),
        "integrand": "direct",
        "method": job["method"],
        "spp": job["spp"],
        "preset": preset,
        "device": device,
        "threads": job.get("threads"),
    }
    ncv.render(**options, size=(32, 32))
    high_water = HighWater()
    rows = []
    for seed in range(job["repeats"]):
        with high_water.watching():
            image = ncv.render(**options, size=(job["size"], job["size"]), seed=seed)
        rows.append(image.stats["seconds"])
    seconds = {stage: float(np.median([row[stage] for row in rows])) for stage in rows[0]}
    return {
        "seconds": seconds,
        "bytes": high_water.bytes,
        "shading_points": image.stats["points"],
        "rays": image.stats["rays_traced"],
    }


def _integrate(job: dict, device: object) -> dict:
    """Exact integration of random networks with biases of their own at every point."""
    import ncv_cl as ncv

    generator = np.random.default_rng(1)
    widths = (2, *[job["width"]] * job["depth"], 3)
    weights = [
        (generator.normal(size=(n, m)) * np.sqrt(2 / m)).astype(np.float32)
        for m, n in itertools.pairwise(widths)
    ]
    biases = [(0.5 * generator.normal(size=(job["points"], n))).astype(np.float32) for n in widths[1:]]
    ncv.integrate(weights, [bias[:8] for bias in biases], device=device)
    seconds = []
    for _ in range(job["repeats"]):
        begun = time.perf_counter()
        _, statistics = ncv.integrate(weights, biases, device=device, return_stats=True)
        seconds.append(time.perf_counter() - begun)
    return {
        "seconds": {"integrate": float(np.median(seconds))},
        "faces_a_point": statistics.faces / job["points"],
        "robust_points": statistics.robust_points,
    }


class HighWater:
    """The process's high-water mark of memory while each stage of a render runs.

    Attributes
    ----------
    bytes : dict of str, int
        By stage; `WHOLE` is the highest of all.
    """

    def __init__(self) -> None:
        self.bytes: dict[str, int] = {}
        self._stages: list[str] = []

    @contextmanager
    def watching(self) -> Iterator[None]:
        """While the block lasts, stages that a `Stopwatch` times are watched."""
        from ncv_cl.host.clock import Stopwatch

        timed = Stopwatch.__call__
        watch = self

        @contextmanager
        def timed_and_watched(stopwatch: Stopwatch, stage: str) -> Iterator[None]:
            watch._enter(stage)
            with timed(stopwatch, stage):
                yield
            watch._leave()

        Stopwatch.__call__ = timed_and_watched
        self._enter(WHOLE)
        try:
            yield
        finally:
            self._leave()
            Stopwatch.__call__ = timed

    def _enter(self, stage: str) -> None:
        self._note()
        self._stages.append(stage)

    def _leave(self) -> None:
        self._note()
        self._stages.pop()

    def _note(self) -> None:
        """Give the mark so far to all stages under way, and begin a new one."""
        mark = _high_water_mark()
        for stage in self._stages if mark is not None else self._stages[:1]:
            seen = mark or resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
            self.bytes[stage] = max(self.bytes.get(stage, 0), seen)


def _high_water_mark() -> int | None:
    """Linux's VmHWM since the last call, in bytes; None on other systems."""
    with suppress(OSError):
        status = Path("/proc/self/status").read_text(encoding="ascii")
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
        line = next(line for line in status.splitlines() if line.startswith("VmHWM"))
        return int(line.split()[1]) * 1024
    return None


def spheres(count: int, subdivisions: int) -> object:
    """A `Scene` of `count` smooth spheres at random over a plane, under a light."""
    import trimesh

    from ncv_cl.scene.load import Camera, Material, QuadLight, Scene

    generator = np.random.default_rng(7)
    ball = trimesh.creation.icosphere(subdivisions)
    radii = generator.uniform(0.5, 1.0, count) * 2.5 / np.sqrt(count)
    flat = generator.uniform(-4, 4, (count, 2))
    centres = np.stack([flat[:, 0], radii * generator.uniform(1, 2, count), flat[:, 1]], -1)
    corners = np.array([[-6, 0, -6], [-6, 0, 6], [6, 0, 6], [6, 0, -6]], float)
    light = np.array([[-2, 7, -2], [2, 7, -2], [2, 7, 2], [-2, 7, 2]], float)
    flat_ones = np.concatenate([corners, light])
    balls = (ball.vertices[None] * radii[:, None, None] + centres[:, None]).reshape(-1, 3)
    normals = np.tile(ball.vertices, (count, 1))
    first = np.arange(count)[:, None, None] * len(ball.vertices)
    triangles = [
        (ball.faces[None] + first).reshape(-1, 3),
        np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]]) + len(balls),
    ]
    ball_count = len(triangles[0])
    colours = (np.full(3, value, np.float32) for value in (0.5, 0.0))
    black = np.zeros(3, np.float32)
    edges = (light[0], light[1] - light[0], light[3] - light[0])
    single = (vector.astype(np.float32) for vector in edges)
    return Scene(
        name=f"{ball_count} triangles",
        path=None,
        camera=Camera(*(np.array(v, float) for v in ((0, 6, 10), (0, 0.5, 0))), 45.0),
        materials=(Material(*colours, name="grey"), Material(black, name="light")),
        lights=(QuadLight(*single, np.full(3, 8, np.float32), False),),
        vertices=np.concatenate([balls, flat_ones]).astype(np.float32),
        vertex_normals=np.concatenate([normals, np.zeros_like(flat_ones)]).astype(np.float32),
        triangles=np.concatenate(triangles).astype(np.uint32),
        triangle_material=np.repeat([0, 1], [ball_count + 2, 2]).astype(np.int32),
        triangle_light=np.repeat([-1, 0], [ball_count + 2, 2]).astype(np.int32),
        warnings=(),
    )


if __name__ == "__main__":
    sys.exit(main())
