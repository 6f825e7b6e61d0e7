"""Training schedules at equal seconds: residual variance of each against that of the default.

A schedule is the default preset's with one thing changed. Each is run with several numbers of epochs
over the same samples, which makes a curve of residual against seconds; curves are compared at the
seconds that the default takes, on straight lines between logarithms. Of runs with several seeds
residuals are the means, seconds the least.
"""

from __future__ import annotations

from dataclasses import replace
from statistics import fmean

import numpy as np
from training import TrainingCase

from ncv_cl.settings.presets import PRESETS

# What is changed of `Schedule`.
SCHEDULES: dict[str, dict[str, float]] = {
    "default": {},
    "32 columns": {"batch": 32},
    "128 columns": {"batch": 128},
    "rate 0.005": {"rate": 5e-3},
    "rate 0.02": {"rate": 2e-2},
    "constant rate": {"final_rate": 1e-2},
    "average over 20": {"average_decay": 0.95},
    "average over 500": {"average_decay": 0.998},
}
EPOCHS = (2, 4, 8)
SEEDS = (0, 1)


def measure_schedules(
    case: TrainingCase,
    samples: int,
    epochs: tuple[int, ...] = EPOCHS,
    seeds: tuple[int, ...] = SEEDS,
) -> list[dict]:
    """One row a schedule and number of epochs, in turn so that a loaded machine treats all alike."""
    rows = []
    for number in epochs:
        for name, changes in SCHEDULES.items():
            schedule = replace(PRESETS["default"].schedule, epochs=number, **changes)
            preset = replace(PRESETS["default"], schedule=schedule)
            outcomes = [case.run(preset, samples, seed=seed) for seed in seeds]
            row = {
                "schedule": name,
                "samples": samples,
                "epochs": number,
                "residual": fmean(outcome.residual for outcome in outcomes),
                "seconds": min(outcome.seconds for outcome in outcomes),
            }
            rows.append(row)
    return rows


def at_equal_seconds(rows: list[dict]) -> dict[str, list[float]]:
    """For each schedule, its residual over the default's at each of the default's seconds.

    Seconds outside of a schedule's own take its nearest end: nothing is extrapolated.
    """
    curves = {
        name: sorted((row["seconds"], row["residual"]) for row in rows if row["schedule"] == name)
        for name in dict.fromkeys(row["schedule"] for row in rows)
    }
    seconds, own = np.log(curves["default"]).T
    return {
        name: np.exp(np.interp(seconds, *np.log(curve).T) - own).tolist()
        for name, curve in curves.items()
    }


def schedule_table(found: dict[str, list[dict]]) -> list[str]:
    """Lines of a table: a schedule's ratios in each case, fewest epochs first, and their mean."""
    ratios = {case: at_equal_seconds(rows) for case, rows in found.items()}
    lines = [f"{'schedule':18} " + " ".join(f"{case:>21}" for case in found) + f" {'mean':>6}"]
    for name in next(iter(ratios.values())):
        cells = [" / ".join(f"{ratio:.3f}" for ratio in each[name]) for each in ratios.values()]
        mean = float(np.exp(np.mean([np.log(each[name]) for each in ratios.values()])))
        lines.append(f"{name:18} " + " ".join(f"{cell:>21}" for cell in cells) + f" {mean:6.3f}")
    return lines
