"""Minibatches of GPUs: held-out residual by how much they grow, with as many steps and with fewer.

After the last round of an automatic training, the variance of f − g over that of f at points that are
not trained on; the mean over the seeds, over that of minibatches that do not grow.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from statistics import fmean

import ncv_cl as ncv
from ncv_cl.learning import learn
from ncv_cl.learning.growth import grown
from ncv_cl.opencl.choose import choose_device
from ncv_cl.opencl.device import Device
from ncv_cl.settings.schedule import Schedule

SCENES = Path(__file__).parent.parent / "scenes"
CASES = (
    *(("cornell_box", "direct"), ("occluders", "ao"), ("interior", "direct")),
    *(("knot", "direct"), ("veach_plates", "direct")),
)
SIZE, SPP, SEEDS = 128, 128, (3, 4)
GROWTHS = (1, 2, 4, 8, 16)
FEWER = 4


def fewer(schedule: Schedule, longer: float) -> Schedule:
    """A quarter of the steps, of `longer` times the size."""
    rates = {"rate": longer * schedule.rate, "final_rate": longer * schedule.final_rate}
    return replace(schedule, batch=FEWER * schedule.batch, **rates)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--device", metavar="D", help="as for ncv-cl render")
    device = choose_device(parser.parse_args().device)
    schedules = {f"x {n}": lambda base, n=n: grown(base, n) for n in GROWTHS}
    schedules |= {
        f"x {FEWER}, fewer steps": lambda base: fewer(base, 1.0),
        f"x {FEWER}, fewer and longer steps": lambda base: fewer(base, 2.0),
    }
    learning = learn._Learning
    for scene, integrand in CASES:
        found = {}
        for name, change in schedules.items():
            learning._grown = lambda _, base, current, change=change: change(base)
            found[name] = fmean(held_out(device, scene, integrand, seed) for seed in SEEDS)
        ratios = (f"{name}: {one / found['x 1']:.2f}" for name, one in found.items())
        print(f"{scene:12} {integrand:7} {found['x 1']:.3f}  {'  '.join(ratios)}", flush=True)


def held_out(device: Device, scene: str, integrand: str, seed: int) -> float:
    options = {"device": device, "size": (SIZE, SIZE), "spp": SPP, "seed": seed, "train_spp": "auto"}
    image = ncv.render(SCENES / f"{scene}.toml", integrand, "ncv", visibility="points", **options)
    return image.stats["training"]["held_out"][-1]


if __name__ == "__main__":
    main()
