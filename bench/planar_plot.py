"""Bars of bench_planar.py's report: variance reduction at equal samples."""

from __future__ import annotations

import numpy as np


def plot(report: dict, path: str) -> None:
    """One panel an integrand, one bar a method and sampler."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    rows = report["equal_samples"]
    names = list(dict.fromkeys(row["integrand"] for row in rows))
    across = min(3, len(names))
    down = -(-len(names) // across)
    figure, axes = pyplot.subplots(down, across, figsize=(5.2 * across, 3.6 * down), squeeze=False)
    for axis in axes.flat[len(names) :]:
        axis.set_visible(False)
    for axis, name in zip(axes.flat, names, strict=False):
        own = [row for row in rows if row["integrand"] == name][::-1]
        middle = np.array([row["variance_reduction"] for row in own])
        low, high = np.array([row["variance_reduction_range"] for row in own]).T
        colors = ["C1" if row["method"].startswith(("ours", "ncv_cl")) else "C0" for row in own]
        labels = [f"{row['method']}, {row['sampler']}" for row in own]
        spread = np.maximum([middle - low, high - middle], 0)
        axis.barh(labels, middle, xerr=spread, color=colors, error_kw={"elinewidth": 0.8})
        axis.set(title=name, xscale="log", xlabel="variance reduction at equal samples")
        axis.axvline(1, color="black", linewidth=0.8)
        axis.tick_params(axis="y", labelsize=7)
    figure.suptitle(report["device"], fontsize=7)
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    pyplot.close(figure)
