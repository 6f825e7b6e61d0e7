"""Pictures at equal time: reference, plain Monte Carlo, control variate, and where each errs.

The control variate renders with a number of samples; Sobol Monte Carlo gets as many as fit into the
same seconds, found from the cost of a shorter render. Beside the pictures: absolute errors, and the
FLIP map (Andersson et al. 2020) where OpenImageIO has it.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import matplotlib
import numpy as np
from bench_curves import DEFAULT, FULL, METHODS, SOBOL, cases_of
from references import reference
from training import SCENES

import ncv_cl as ncv
from ncv_cl.opencl.choose import choose_device
from ncv_cl.opencl.device import Device
from ncv_cl.output.compare import flip_map, has_flip

matplotlib.use("Agg")
from matplotlib import pyplot

# What a picture's brightest error is mapped to: this percentile of plain Monte Carlo's errors.
PERCENTILE = 99.5
# Behind pictures: grey, which suits a light page and a dark one.
GROUND = "#6b6b6b"


@dataclass(frozen=True)
class Plan:
    """Points a side, samples of the control variate, samples of the reference."""

    size: int
    spp: int
    reference_spp: int


# The full run shares the references of the curves.
PLANS = {False: Plan(FULL.size, 256, FULL.reference_spp), True: Plan(64, 16, 1024)}


def run(device: Device, plan: Plan, cases: list[tuple[str, str]], folder: Path) -> dict:
    """Render the strips into `folder`; returns what --json writes."""
    rows = []
    for scene, integrand in cases:
        row: dict[str, object] = {"scene": scene, "integrand": integrand}
        try:
            row |= _strip(device, scene, integrand, plan, folder)
        except RuntimeError as error:
            row["failed"] = str(error)
        print({key: value for key, value in row.items() if key != "methods"}, flush=True)
        rows.append(row)
    return {"device": device.identity, "size": plan.size, "flip": has_flip(), "cases": rows}


def _strip(device: Device, name: str, integrand: str, plan: Plan, folder: Path) -> dict:
    scene = ncv.load_scene(SCENES / f"{name}.toml")
    truth = reference(device, scene, integrand, plan.size, plan.reference_spp)

    def render(method: str, spp: int) -> ncv.Image:
        size = (plan.size, plan.size)
        options = METHODS[method]
        return ncv.render(scene, integrand, spp=spp, size=size, seed=3, device=device, **options)

    # The first renders compile kernels; costs come from the second ones.
    render(DEFAULT, plan.spp)
    ours = render(DEFAULT, plan.spp)
    render(SOBOL, plan.spp)
    few, many = render(SOBOL, plan.spp), render(SOBOL, 4 * plan.spp)
    budget = ours.stats["seconds"]["total"]
    cost = (many.stats["seconds"]["total"] - few.stats["seconds"]["total"]) / (3 * plan.spp)
    spare = max(0.0, budget - few.stats["seconds"]["total"])
    affordable = plan.spp + round(spare / cost) if cost > 0 else 4 * plan.spp
    plain = render(SOBOL, max(1, affordable))
    rows = {}
    for method, image in ((SOBOL, plain), (DEFAULT, ours)):
        mse, relmse = truth.errors(image.pixels)
        flip = flip_map(truth.pixels, image.pixels)
        rows[method] = {
            "samples": image.stats["samples_per_point"],
            "seconds": image.stats["seconds"]["total"],
            "mse": mse,
            "relmse": relmse,
            "flip": None if flip is None else float(flip.mean()),
        }
    file = folder / f"pictures_{name}_{integrand}.jpg"
    draw(file, truth.pixels, {SOBOL: plain.pixels, DEFAULT: ours.pixels}, rows)
    return {"picture": file.name, "methods": rows}


def draw(file: Path, truth: np.ndarray, images: dict[str, np.ndarray], rows: dict[str, dict]) -> None:
    """Rows of panels: reference and images, their errors, their FLIP maps; each row on one scale."""
    errors = {name: np.abs(pixels - truth).mean(axis=2) for name, pixels in images.items()}
    flips = {name: flip_map(truth, pixels) for name, pixels in images.items()}
    table: list[list[tuple[str, np.ndarray | None, dict]]] = [[("reference", shown(truth), {})]]
    for name, pixels in images.items():
        row = rows[name]
        title = f"{name}\n{row['samples']:.0f} samples, {row['seconds']:.2f} s"
        table[0].append((title, shown(pixels), {}))
    for what, maps in (("error", errors), ("FLIP", flips)):
        if any(one is None for one in maps.values()):
            continue
        top = max(float(np.percentile(maps[SOBOL], PERCENTILE)), 1e-12)
        # Below the reference there is nothing.
        table.append([("", None, {})])
        for name, one in maps.items():
            title = f"{what} of {name}\nmean {one.mean():.2e}, white {top:.1e}"
            table[-1].append((title, one, {"cmap": "magma", "vmin": 0, "vmax": top}))
    panels = [panel for row in table for panel in row]
    size = (2.4 * len(table[0]), 2.75 * len(table))
    figure, axes = pyplot.subplots(len(table), len(table[0]), figsize=size, facecolor=GROUND)
    for axis, (title, image, options) in zip(axes.flat, panels, strict=True):
        if image is not None:
            axis.imshow(image, interpolation="nearest", **options)
        axis.set_title(title, fontsize=8, color="white")
        axis.axis("off")
    figure.tight_layout(pad=0.3)
    quality = {"quality": 85}
    figure.savefig(file, dpi=100, bbox_inches="tight", pad_inches=0.05, pil_kwargs=quality)
    pyplot.close(figure)


def shown(pixels: np.ndarray) -> np.ndarray:
    """Linear RGB as a screen shows it: clamped, with sRGB's curve (IEC 61966-2-1)."""
    clamped = np.clip(pixels, 0, 1)
    return np.where(clamped <= 0.0031308, 12.92 * clamped, 1.055 * clamped ** (1 / 2.4) - 0.055)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="small images, few samples")
    parser.add_argument("--json", metavar="FILE", help="write the results here, pictures beside it")
    parser.add_argument("--device", metavar="D", help="as for ncv-cl render")
    parser.add_argument("--reference-spp", type=int, help=f"default {FULL.reference_spp}")
    parser.add_argument("--case", action="append", metavar="SCENE:INTEGRAND", help="default: all")
    options = parser.parse_args()
    folder = Path(options.json).parent if options.json else Path()
    plan = PLANS[options.quick]
    plan = replace(plan, reference_spp=options.reference_spp or plan.reference_spp)
    cases = [tuple(case.split(":")) for case in options.case or ()] or cases_of(options.quick)
    results = run(choose_device(options.device), plan, cases, folder)
    if options.json:
        Path(options.json).write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
    return 1 if any("failed" in case for case in results["cases"]) else 0


if __name__ == "__main__":
    sys.exit(main())
