"""Residual variance against training seconds: both presets and other schedules, shipped scenes.

Residual: variance of f − g over variance of f, independent samples, mean over points, fresh samples.
Seconds are one run each on the device named; compare them within this run only.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict, replace
from pathlib import Path

from schedules import EPOCHS, SEEDS, measure_schedules, schedule_table
from training import CASES, TrainingCase

from ncv_cl.opencl.choose import choose_device
from ncv_cl.opencl.device import Device
from ncv_cl.settings.presets import PRESETS, Preset

# An image with more points than training wants samples, and training samples a point there, on average.
LARGE, LARGE_SPP = 1024, 2


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="small images and few samples")
    parser.add_argument("--json", metavar="FILE", help="write the results here")
    parser.add_argument("--plot", metavar="FILE", help="write a plot here (needs matplotlib)")
    parser.add_argument("--device", metavar="D", help="as for ncv-cl render")
    options = parser.parse_args()
    device = choose_device(options.device)
    size, budgets = (32, (4, 16)) if options.quick else (96, (4, 16, 64))
    print(f"{device.identity}\n{size} x {size} points")
    rows, schedules = [], {}
    for scene, integrand in CASES:
        case = TrainingCase(device, scene, integrand, size)
        compiled = set()
        for name, samples, epochs in runs(budgets, options.quick):
            preset = with_epochs(name, epochs)
            if (name, samples) not in compiled:
                case.run(with_epochs(name, 1), samples)
                compiled.add((name, samples))
            outcome = case.run(preset, samples)
            rows.append(
                {
                    "scene": scene,
                    "integrand": integrand,
                    "preset": name,
                    "samples": samples,
                    "epochs": epochs,
                    **asdict(outcome),
                }
            )
            report_line(rows[-1], size)
        epochs, seeds = (EPOCHS[:2], SEEDS[:1]) if options.quick else (EPOCHS, SEEDS)
        found = measure_schedules(case, budgets[-1], epochs, seeds)
        schedules[f"{scene} {integrand}"] = found
        if not options.quick:
            rows.append(large_image(device, scene, integrand))
            report_line(rows[-1], LARGE)
    print(f"residual over the default's after the same seconds, {budgets[-1]} samples a point, "
          f"{' / '.join(map(str, epochs))} epochs of the default")  # fmt: skip
    print("\n".join(schedule_table(schedules)))
    if options.json:
        every = [{"case": name, **row} for name, found in schedules.items() for row in found]
        report = {"device": device.identity, "size": size, "runs": rows, "schedules": every}
        Path(options.json).write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    if options.plot:
        plot([row for row in rows if "size" not in row], device.identity, options.plot)


def large_image(device: Device, scene: str, integrand: str) -> dict:
    """Two training samples a point on average, as 16 of every eighth point."""
    case = TrainingCase(device, scene, integrand, LARGE)
    epochs = 2
    outcome = case.run(with_epochs("default", epochs), 16, LARGE_SPP / 16)
    about = {"scene": scene, "integrand": integrand, "preset": "default", "samples": LARGE_SPP}
    return {**about, "epochs": epochs, "size": LARGE, **asdict(outcome)}


def report_line(row: dict, size: int) -> None:
    print(
        f"{row['scene']:12} {row['integrand']:7} {row['preset']:8} {size:4}^2 "
        f"{row['samples']:4} samples x {row['epochs']} epochs: "
        f"residual {row['residual']:.4f} after {row['seconds']:.3f} s "
        f"({row['nanoseconds_a_sample']:.0f} ns a sample)",
        flush=True,
    )


def with_epochs(name: str, epochs: int) -> Preset:
    preset = PRESETS[name]
    return replace(preset, schedule=replace(preset.schedule, epochs=epochs))


def runs(budgets: tuple[int, ...], quick: bool) -> list[tuple[str, int, int]]:
    """(preset, samples a point, epochs): the slides' preset uses each sample once."""
    slides = [("slides", samples, 1) for samples in budgets]
    epochs = (1, 4) if quick else (1, 2, 4, 8, 16)
    wide = [("wide", budgets[-1], n) for n in epochs[1:]]
    return slides + [("default", samples, n) for samples in budgets for n in epochs] + wide


def plot(rows: list[dict], device: str, path: str) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, len(CASES), figsize=(4 * len(CASES), 4), sharey=True)
    for axis, (scene, integrand) in zip(axes, CASES, strict=True):
        for name, marker in (("slides", "s"), ("default", "o"), ("wide", "^")):
            chosen = [
                r for r in rows if (r["scene"], r["integrand"], r["preset"]) == (scene, integrand, name)
            ]
            seconds, residuals = [r["seconds"] for r in chosen], [r["residual"] for r in chosen]
            axis.plot(seconds, residuals, marker, label=name)
        axis.set(title=f"{scene} {integrand}", xlabel="training seconds", xscale="log", yscale="log")
        axis.grid(True, which="both", alpha=0.3)
    axes[0].set_ylabel("residual variance / plain variance")
    axes[0].legend()
    figure.suptitle(device, fontsize=7)
    figure.tight_layout()
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    main()
