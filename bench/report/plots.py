"""The plots of the curves: errors, gains and stages, one panel a scene and integrand."""

from __future__ import annotations

from pathlib import Path

import matplotlib
import numpy as np
from bench_curves import AUTO, DEFAULT, METHODS, SOBOL, curves_of

matplotlib.use("Agg")
from matplotlib import pyplot
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

# Control variates in warm colours, plain Monte Carlo in cold ones.
COLORS = dict(
    zip(
        METHODS,
        ("#9ecae1", "#3182bd", "#08519c", "#fdae6b", "#fd8d3c", "#d94801", "#238b45"),
        strict=True,
    )
)
COLUMNS = 4


def _panels(count: int, height: float = 3.4) -> tuple[Figure, list[Axes]]:
    columns = min(COLUMNS, count)
    rows = -(-count // columns)
    figure, axes = pyplot.subplots(
        rows, columns, figsize=(3.6 * columns, height * rows), squeeze=False, layout="constrained"
    )
    flat = list(axes.flat)
    for axis in flat[count:]:
        axis.axis("off")
    return figure, flat[:count]


def _finish(figure: Figure, axes: list[Axes], file: Path) -> None:
    """Ticks that do not run into each other, one legend below all panels; written to `file`."""
    for axis in axes:
        for one in (axis.xaxis, axis.yaxis):
            if one.get_scale() == "log":
                low, high = one.get_view_interval()
                wide = high > 300 * low
                one.set_major_locator(LogLocator(subs=(1.0,) if wide else (1.0, 2.0, 5.0)))
                one.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
                one.set_minor_formatter(NullFormatter())
        axis.tick_params(labelsize=7)
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="outside lower center", ncols=_columns(figure), fontsize=8, frameon=False
    )
    figure.savefig(file, dpi=110)
    pyplot.close(figure)


def _columns(figure: Figure) -> int:
    """Columns of a legend as wide as the figure, whose longest names take 1.5 inches each."""
    return max(1, min(len(METHODS), int(figure.get_figwidth() / 1.5)))


def errors(cases: list[dict], x: str, file: Path, error: str = "mse") -> None:
    """Error against `x`, "seconds" or "samples", with the spread of the repeats."""
    figure, axes = _panels(len(cases))
    for axis, case in zip(axes, cases, strict=True):
        for name, method in case["methods"].items():
            points = [p for p in method.get("points", []) if p[error] > 0]
            across, up = [p[x] for p in points], [p[error] for p in points]
            dashes = "--" if name == AUTO else "-"
            axis.plot(across, up, dashes, marker="o", ms=3, lw=1.2, label=name, color=COLORS[name])
            low, high = np.array([p[f"{error}_range"] for p in points]).reshape(-1, 2).T
            positive = np.maximum(low, np.array(up) * 1e-2)
            axis.fill_between(across, positive, high, color=COLORS[name], alpha=0.15, lw=0)
        axis.set(
            title=f"{case['scene']} {case['integrand']}", xscale="log", yscale="log", xlabel=_named(x)
        )
        axis.grid(True, which="major", alpha=0.3)
    axes[0].set_ylabel({"mse": "MSE", "relmse": "relMSE"}[error])
    _finish(figure, axes, file)


def _named(x: str) -> str:
    return {"seconds": "seconds, all in", "samples": "samples a point"}[x]


def gains(cases: list[dict], file: Path) -> None:
    """Seconds of Sobol Monte Carlo over those of others to its own errors, against its samples."""
    figure, axes = _panels(len(cases))
    for axis, case in zip(axes, cases, strict=True):
        curves = curves_of(case["methods"])
        plain = curves.pop(SOBOL, None)
        if plain is None:
            continue
        for name, curve in curves.items():
            grid = np.geomspace(plain.errors[0], max(plain.errors[-1], curve.errors[-1]), 200)
            gain = plain.seconds_to(grid) / curve.seconds_to(grid)
            width = 2 if name == DEFAULT else 1
            axis.plot(plain.samples_to(grid), gain, label=name, color=COLORS[name], lw=width)
        axis.axhline(1, color="black", lw=0.8)
        axis.set(title=f"{case['scene']} {case['integrand']}", xscale="log", yscale="log")
        axis.set_xlabel("Sobol samples a point that reach the error")
        axis.grid(True, which="major", alpha=0.3)
    axes[0].set_ylabel("seconds of Sobol over others'")
    _finish(figure, axes, file)


def stages(cases: list[dict], file: Path) -> None:
    """Stacked bars of seconds by stage, a bar a method, at equal error."""
    figure, axes = _panels(len(cases), 2.2)
    for axis, case in zip(axes, cases, strict=True):
        rows = case["equal_error"]
        names = list(rows)
        left = np.zeros(len(names))
        for stage in rows[names[0]]["stages"]:
            widths = np.array([rows[name]["stages"][stage] for name in names])
            axis.barh(names, widths, left=left, label=stage)
            left += widths
        axis.invert_yaxis()
        axis.set(title=f"{case['scene']} {case['integrand']}", xlabel="seconds")
        axis.tick_params(labelsize=7)
    _finish(figure, axes, file)
