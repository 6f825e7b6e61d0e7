"""Variance and processor time a sample of several lights: shipped scenes, and halls of 1 to 1,000 lamps.

Variances are those of independent samples, means over points and channels: nothing is seen in them but
how the unit square is dealt out to the lights; `--equal` tries other parts that all share alike. Times
are processor seconds of a render with many samples less one with a single one, the least of three, on
one thread, all rays traced; compare them within one run only. `--mitsuba` puts the halls' direct light
beside that of Mitsuba 3: variances of independent samples, and both renderers' wall clock, all in.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from mitsuba_scene import MitsubaScene, import_mitsuba
from training import SCENES

import ncv_cl as ncv
from ncv_cl.integrands import lights, tuning
from ncv_cl.opencl.choose import choose_device
from ncv_cl.opencl.device import Device
from ncv_cl.scene.load import Scene

# Quick: pixels a side, samples, most lamps; and in full.
QUICK, FULL = (16, 64, 9), (48, 64, 1000)
SHIPPED = ("cornell_box", "interior", "occluders")
LAMPS = (1, 2, 8, 9, 100, 1000)
HALL = """
[camera]
position = [3, 3.5, 3]
target = [30, 1, 20]
vertical_fov = 60
[materials.stone]
albedo = 0.6
[[boxes]]
min = [-1, -1, -1]
max = [61, 0, 41]
material = "stone"
"""
WALL = '[[boxes]]\nmin = {}\nmax = {}\nmaterial = "stone"\n'
LAMP = "[[lights]]\ncorner = {}\nedge1 = [0.3, 0, 0]\nedge2 = [0, 0, 0.3]\nradiance = {}\n"


def hall(lamps: int, folder: str, seed: int = 5) -> Scene:
    """A hall of 60 x 40 x 6 with twelve pillars, and lamps of very different power below its ceiling."""
    generator = np.random.default_rng(seed)
    walls = [([-1, 6, -1], [61, 7, 41]), ([-1, 0, -1], [0, 6, 41]), ([60, 0, -1], [61, 6, 41])]
    walls += [([-1, 0, -1], [61, 6, 0]), ([-1, 0, 40], [61, 6, 41])]
    walls += [
        ([x, 0, z], [x + 0.6, 6, z + 0.6]) for x, z in generator.uniform(5, [55, 35], (12, 2)).tolist()
    ]
    text = HALL + "".join(WALL.format(*ends) for ends in walls)
    places = generator.uniform([0.5, 4.5, 0.5], [59, 5.9, 39], (lamps, 3)).tolist()
    # The first lamp is where the camera looks, whatever their number.
    places[0] = [15, 5, 12]
    powers = (10 ** generator.uniform(-0.5, 1.5, lamps)).tolist()
    text += "".join(LAMP.format(*lamp) for lamp in zip(places, powers, strict=True))
    path = f"{folder}/hall_{lamps}.toml"
    with open(path, "w", encoding="utf-8") as file:
        file.write(text)
    return ncv.load_scene(path)


def measure(device: Device, scene: Scene, integrand: str, side: int, spp: int) -> dict[str, float]:
    """Variance a sample over the squared mean, nanoseconds a sample, and seconds to make the rows."""
    options = {"method": "mc", "sampler": "independent", "size": (side, side), "device": device}
    options["visibility"] = "embree"

    def render(samples: int, seed: int) -> tuple[ncv.Image, float]:
        began = time.process_time()
        image = ncv.render(scene, integrand, spp=samples, seed=seed, threads=1, **options)
        return image, time.process_time() - began

    render(1, 0)
    many, one = ([render(samples, seed) for seed in range(3)] for samples in (spp, 1))
    seconds = min(took for _, took in many) - min(took for _, took in one)
    images = [image for image, _ in many]
    variance = np.mean([image.variance for image in images], dtype=float) * spp
    mean = np.mean([image.pixels for image in images], dtype=float)
    began = time.process_time()
    lights.light_records(replace(scene))
    return {
        "variance": variance / mean**2,
        "ns": 1e9 * seconds / (images[0].stats["points"] * (spp - 1)),
        "rows": time.process_time() - began,
    }


def beside_mitsuba(
    device: Device, scene: Scene, side: int, spp: int, seeds: int = 4
) -> dict[str, float]:
    """Both renderers' variance a sample over the squared mean, and their seconds; two images a seed."""
    theirs = MitsubaScene(import_mitsuba(), scene)
    way = {"type": "direct", "emitter_samples": 1, "bsdf_samples": 0, "hide_emitters": True}
    integrator = theirs.mitsuba.load_dict(way)
    sensor = theirs.sensor((side, side), "independent", spp)

    def ours(seed: int) -> np.ndarray:
        options = {"spp": spp, "size": (side, side), "seed": seed, "sampler": "independent"}
        return ncv.render(scene, "direct", "mc", device=device, **options).pixels

    def of_mitsuba(seed: int) -> np.ndarray:
        image = theirs.mitsuba.render(
            theirs.scene, sensor=sensor, integrator=integrator, spp=spp, seed=seed
        )
        return np.array(image)[..., :3]

    found = {}
    for name, render in (("ours", ours), ("Mitsuba", of_mitsuba)):
        render(99)
        began = time.perf_counter()
        images = np.array([render(seed) for seed in range(2 * seeds)], np.float64)
        found[f"{name}, seconds"] = (time.perf_counter() - began) / (2 * seeds)
        halves = images[::2] - images[1::2]
        found[f"{name}, mean"] = images.mean()
        found[f"{name}, variance"] = 0.5 * np.mean(halves**2) * spp / images.mean() ** 2
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="small images, few samples and lamps")
    parser.add_argument("--equal", type=float, nargs="+", help="parts that all lights share alike")
    parser.add_argument("--mitsuba", action="store_true", help="halls only, beside Mitsuba 3")
    parser.add_argument("--device", metavar="D", help="as for ncv-cl render")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the rows here")
    options = parser.parse_args()
    device = choose_device(options.device)
    side, spp, most = QUICK if options.quick else FULL
    print(f"{device.identity}\n{side} x {side} pixels, {spp} samples")
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        if options.mitsuba:
            for lamps in (one for one in LAMPS if one <= most):
                row = beside_mitsuba(device, hall(lamps, folder), side, spp)
                print(
                    f"{lamps:4} lights: " + ", ".join(f"{k} {v:.4g}" for k, v in row.items()), flush=True
                )
            return
        for part in options.equal or (tuning.EQUAL_PART,):
            tuning.EQUAL_PART = part
            shipped = SHIPPED[:1] if options.quick else SHIPPED
            scenes = [ncv.load_scene(SCENES / f"{name}.toml") for name in shipped]
            scenes += [hall(lamps, folder) for lamps in LAMPS if lamps <= most]
            for scene in scenes:
                for integrand in ("direct", "gi"):
                    row = measure(device, scene, integrand, side, spp)
                    about = {"scene": scene.name, "integrand": integrand, "lights": len(scene.lights)}
                    rows.append({**about, "equal_part": part, **row})
                    print(
                        f"equal part {part:5.3f}  {scene.name:12} {integrand:6}"
                        f" {len(scene.lights):4} lights: variance / mean^2 {row['variance']:8.3g},"
                        f" {row['ns']:6.1f} ns a sample, rows {row['rows']:5.2f} s",
                        flush=True,
                    )
    if options.json:
        found = {"device": device.identity, "size": side, "spp": spp, "rows": rows}
        options.json.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
