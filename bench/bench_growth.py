"""Minibatches of GPUs: residual variance by how much they grow, with as many steps and with fewer.

Residual: variance of f − g over variance of f, independent samples, mean over points, fresh samples; the
mean over three seeds, over that of the default's minibatches.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from statistics import fmean

from training import TrainingCase

from ncv_cl.learning.growth import grown
from ncv_cl.opencl.choose import choose_device
from ncv_cl.settings.presets import PRESETS
from ncv_cl.settings.schedule import Schedule

CASES = (
    *(("cornell_box", "direct"), ("occluders", "ao"), ("interior", "direct")),
    *(("knot", "direct"), ("interior", "gi"), ("veach_plates", "direct")),
)
# Image side, samples a point and uses of each: the first round of an automatic training.
SIZE, SAMPLES, EPOCHS, SEEDS = 64, 32, 2, 3
GROWTHS = (1, 2, 4, 8, 16)
# Fewer steps, each as much longer as the root of the growth.
FEWER = 4


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--device", metavar="D", help="as for ncv-cl render")
    device = choose_device(parser.parse_args().device)
    base = replace(PRESETS["default"].schedule, epochs=EPOCHS)
    longer = {"batch": FEWER * base.batch, "rate": 2 * base.rate, "final_rate": 2 * base.final_rate}
    schedules = {f"x {growth}": grown(base, growth) for growth in GROWTHS}
    schedules |= {
        f"x {FEWER}, fewer steps": replace(base, batch=FEWER * base.batch),
        f"x {FEWER}, fewer and longer steps": replace(base, **longer),
    }
    for scene, integrand in CASES:
        case = TrainingCase(device, scene, integrand, SIZE)
        found = {name: residual(case, schedule) for name, schedule in schedules.items()}
        ratios = (f"{name}: {one / found['x 1']:.2f}" for name, one in found.items())
        print(f"{scene:12} {integrand:7} {found['x 1']:.3f}  {'  '.join(ratios)}", flush=True)


def residual(case: TrainingCase, schedule: Schedule) -> float:
    preset = replace(PRESETS["default"], schedule=schedule)
    return fmean(case.run(preset, SAMPLES, seed=seed).residual for seed in range(SEEDS))


if __name__ == "__main__":
    main()
