"""Direct light at 100,000 sensors of scenes/interior.toml: seconds to an error, beside Radiance's.

Sensors are even over all surfaces but the lights. Errors are against many lines on each light. Those of
Radiance's rtrace fall with `-ds`, the size of the parts that it cuts lights into. It is run if
`pyradiance` is installed.

    python bench/bench_sensors.py [--sensors 100000] [--reference 8192] [--quick] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

import ncv_cl as ncv

SCENE = Path(__file__).parent.parent / "scenes" / "interior.toml"
LINES = (16, 64, 256, 1024)
PARTS = (0.1, 0.02, 0.005)


def seconds() -> tuple[float, float]:
    """Processor seconds of this process and its children, and seconds of the clock."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(one.ru_utime + one.ru_stime for one in used), time.perf_counter()


def timed(work: Callable[[], np.ndarray]) -> tuple[np.ndarray, float, float]:
    """What `work` returns, and its seconds."""
    began = seconds()
    found = work()
    ended = seconds()
    return found, ended[0] - began[0], ended[1] - began[1]


def sensors(scene: ncv.Scene, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Positions and normals, on the side of the triangles' corners that go round counter-clockwise."""
    rng = np.random.default_rng(0)
    corners = scene.vertices[scene.triangles[scene.triangle_light < 0]].astype(float)
    vectors = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(vectors, axis=1)
    chosen = rng.choice(len(areas), count, p=areas / areas.sum())
    a, b = rng.random((2, count))
    a, b = np.where(a + b > 1, 1 - a, a), np.where(a + b > 1, 1 - b, b)
    first, second, third = corners[chosen].transpose(1, 0, 2)
    positions = first + a[:, None] * (second - first) + b[:, None] * (third - first)
    return positions + scene.origin, vectors[chosen] / areas[chosen, None]


def radiance_scene(scene: ncv.Scene) -> str:
    """The scene in Radiance's format: black surfaces, and lights that shine to one side."""
    lines = ["void plastic black 0 0 5 0 0 0 0 0"]
    for k, light in enumerate(scene.lights):
        lines.append(f"void light lamp{k} 0 0 3 {' '.join(map(repr, map(float, light.radiance)))}")
    world = scene.vertices.astype(float) + scene.origin
    for k, triangle in enumerate(scene.triangles[scene.triangle_light < 0]):
        lines.append(f"black polygon t{k} 0 0 9 {' '.join(map(repr, world[triangle].ravel().tolist()))}")
    for k, light in enumerate(scene.lights):
        corner, edge1, edge2 = (
            getattr(light, name).astype(float) for name in ("corner", "edge1", "edge2")
        )
        ring = np.array([corner, corner + edge1, corner + edge1 + edge2, corner + edge2]) + scene.origin
        lines.append(f"lamp{k} polygon q{k} 0 0 12 {' '.join(map(repr, ring.ravel().tolist()))}")
    return "\n".join(lines) + "\n"


def by_radiance(octree: Path, positions: np.ndarray, normals: np.ndarray, part: float) -> np.ndarray:
    """Irradiance, (n, 3), by rtrace without bounces."""
    import pyradiance

    rays = np.concatenate([positions + 1e-5 * normals, normals], axis=1).astype(np.float32)
    options = ["-ab", "0", "-aa", "0", "-ds", f"{part}", "-dj", "0.7", "-dt", "0", "-dc", "1"]
    found = pyradiance.rtrace(
        rays.tobytes(), octree, header=False, inform="f", outform="f", irradiance=True,
        nproc=os.cpu_count(), params=options,
    )  # fmt: skip
    return np.frombuffer(found, np.float32).reshape(-1, 3).astype(float)


def report(name: str, work: tuple[np.ndarray, float, float], reference: np.ndarray) -> dict[str, object]:
    """Print and return a row: means over the sensors that get any light."""
    values, used, wall = work
    lit = reference.mean(axis=1) > 0
    mean = reference.mean(axis=1)
    error = np.abs(values - reference).mean(axis=1)
    relative = error[lit] / mean[lit]
    print(
        f"{name:<16}{used:>9.2f} s{wall:>9.2f} s    errors over values {error.sum() / mean.sum():.1e}"
        f"    relative errors: median {np.median(relative):.1e}, mean {relative.mean():.1e}"
    )
    return {
        "way": name,
        "processor_seconds": used,
        "seconds": wall,
        "error_over_values": float(error.sum() / mean.sum()),
        "median_relative_error": float(np.median(relative)),
        "mean_relative_error": float(relative.mean()),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--sensors", type=int, default=100_000)
    parser.add_argument("--reference", type=int, default=8192, help="lines a sensor")
    parser.add_argument("--quick", action="store_true", help="few sensors")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the rows here")
    options = parser.parse_args()
    if options.quick:
        options.sensors, options.reference = 1000, 1024
    rows = measure(options.sensors, options.reference)
    if options.json:
        found = {"sensors": options.sensors, "reference_lines": options.reference, "rows": rows}
        options.json.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


def measure(count: int, reference_lines: int) -> list[dict[str, object]]:
    """A row for each number of lines, and for each `-ds` of Radiance where it is installed."""
    scene = ncv.load_scene(SCENE)
    at, normals = sensors(scene, count)

    def by_lines(lines: int, seed: int) -> np.ndarray:
        return ncv.irradiance(scene, at, normals, spp=lines, seed=seed, method="mc").values

    by_lines(1, 0)
    reference = by_lines(reference_lines, 1)
    print(f"{'':<16}{'processor':>11}{'clock':>11}")
    rows = [
        report(f"{lines} lines", timed(lambda lines=lines: by_lines(lines, 2)), reference)
        for lines in LINES
    ]
    try:
        import pyradiance
    except ImportError:
        print("pyradiance is not installed")
        return rows
    with tempfile.TemporaryDirectory() as folder:
        text, octree = Path(folder) / "interior.rad", Path(folder) / "interior.oct"
        text.write_text(radiance_scene(scene), encoding="utf-8")
        octree.write_bytes(pyradiance.oconv(text, warning=False))
        for part in PARTS:
            work = timed(lambda part=part: by_radiance(octree, at, normals, part))
            rows.append(report(f"rtrace -ds {part}", work, reference))
    return rows


if __name__ == "__main__":
    main()
