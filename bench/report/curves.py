"""The sections on whole renders: error against time, crossover, `auto`, stages, the slides' table."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from bench_curves import AUTO, DEFAULT, SLIDES, SOBOL, STAGES, curves_of
from crossover import Crossover, Curve

from . import plots
from .document import Figure, Paragraph, Section, Table, shown

# The slides' last table, to be read beside ours: another renderer, scene, size and machine.
SLIDES_TABLE = {
    "Monte Carlo (the slides)": {"spp": "32768", "mse": 4.54e-5, "render": 136.0, "total": 136.0},
    "GI-NCV (the slides)": {
        "spp": "1024 + 18432", "mse": 4.53e-5, "render": 78.0, "train": 33.0, "integration": 10.0,
        "inference": 34.0, "total": 155.0,
    },
}  # fmt: skip
# What is plotted against what, into which file, and what it shows.
PLOTS = (
    ("seconds", "mse", "error_against_time", "Mean square error against total seconds."),
    ("samples", "mse", "error_against_samples", "Mean square error against samples, training's too."),
    ("seconds", "relmse", "relative_error_against_time", "relMSE against total seconds."),
    ("samples", "relmse", "relative_error_against_samples", "relMSE against samples, training's too."),
)
# A reference with more than this share of the least measured error is called coarse.
COARSE = 0.25
# The least that `auto` is to reach of Sobol Monte Carlo's speed.
AUTO_TARGET = 0.95


def sections(data: dict, folder: Path, command: str) -> list[Section]:
    """All of them; figures are drawn into `folder`."""
    cases = [case for case in data["cases"] if "methods" in case]
    return [
        _error(data, cases, folder, command),
        _crossover(cases, folder, command),
        _auto(cases),
        _stages(cases, folder, command),
    ]


def label(case: dict) -> str:
    return f"{case['scene']} {case['integrand']}"


# ---- error ---------------------------------------------------------------------------------------


def _error(data: dict, cases: list[dict], folder: Path, command: str) -> Section:
    section = Section("Error against time and samples")
    short = data.get("short_repeats", 0)
    more = f" ({short} of those shorter than a second)" if short > data["repeats"] else ""
    section.blocks.append(
        Paragraph(
            f"{data['size']} × {data['size']} points, medians of {data['repeats']} runs{more}, "
            "interleaved; shaded from the least to the largest. Seconds are total: training is in them, "
            "the compilation of kernels is not. The reference's own variance is subtracted from errors."
        )
    )
    for case in data["cases"]:
        if "failed" in case:
            section.blocks.append(Paragraph(f"{label(case)} was not measured: {case['failed']}.", True))
    if not cases:
        return section
    for x, error, name, caption in PLOTS:
        plots.errors(cases, x, folder / f"{name}.png", error)
        section.blocks.append(Figure(f"{name}.png", caption, command))
    section.blocks += [Paragraph(text, True) for text in map(_least_error, cases) if text]
    section.blocks += [Paragraph(text, True) for text in map(_coarse_reference, cases) if text]
    section.blocks += [_references(data, cases), _validation(cases)]
    section.blocks += [_points(case) for case in cases]
    return section


def _least_error(case: dict) -> str:
    """Which method had the least error in the seconds that all of them had."""
    curves = curves_of(case["methods"])
    if len(curves) < 2:
        return ""
    budget = min(curve.seconds[-1] for curve in curves.values())
    reached = {name: _error_at(curve, budget) for name, curve in curves.items() if name != AUTO}
    order = sorted((one for one in reached if reached[one]), key=lambda one: reached[one])
    if len(order) < 2:
        return ""
    best, second, worst = order[0], order[1], order[-1]
    text = (
        f"{label(case)}: in {shown(budget)} s, the most that every method was given, {best} has the "
        f"least mean square error ({shown(reached[best])}); {second} has "
        f"{shown(reached[second] / reached[best])} times as much"
    )
    if worst != second:
        text += f", {worst} {shown(reached[worst] / reached[best])} times"
    return text + "."


def _error_at(curve: Curve, seconds: float) -> float | None:
    """The error of the most samples that fit into some seconds, interpolated; None if none fit."""
    if seconds < curve.seconds[0]:
        return None
    samples = np.interp(seconds, curve.seconds, curve.samples)
    return float(np.exp(np.interp(np.log(samples), np.log(curve.samples), np.log(curve.errors))))


def _least_measured(case: dict) -> float:
    """The least mean square error of any method's points."""
    points = (p["mse"] for method in case["methods"].values() for p in method.get("points", []))
    return min((mse for mse in points if mse > 0), default=float("nan"))


def _coarse_reference(case: dict) -> str:
    """A warning where a reference is not far better than what it judges."""
    share = case["reference"]["mse"] / _least_measured(case)
    if not share > COARSE:
        return ""
    return (
        f"{label(case)}: the reference's own error is {shown(share)} of the least one measured; it is "
        "subtracted, but the smallest errors are uncertain."
    )


def _references(data: dict, cases: list[dict]) -> Table:
    largest = max(data["spps"])
    rows = []
    for case in cases:
        one = case["reference"]
        least = _least_measured(case)
        rows.append(
            [label(case), one["spp"], one["spp"] / largest, one["mse"], one["mse"] / least, one["z"]]
        )
    columns = ["", "samples", "over the largest point's", "own MSE", "over the least measured MSE", "Z"]
    return Table(columns, rows, "References: mean of two renders, by plain Monte Carlo and by control "
                 "variate; Z is that of their difference")  # fmt: skip


def _validation(cases: list[dict]) -> Table:
    names = list(cases[0]["methods"])
    rows = []
    for case in cases:
        found = [case["methods"][name]["validation"] for name in names]
        rows.append(
            [label(case), *(f"{v['z']:+.1f}{'' if v['valid'] else ' not timed'}" for v in found)]
        )
    return Table(["", *names], rows, "Validation before timing: Z-value of the image's mean error")


def _points(case: dict) -> Table:
    rows = [
        [name, p["spp"], p["samples"], p["seconds"], p["seconds_range"], p["mse"], p["mse_range"],
         p["relmse"], p["claimed"], p["method"]]
        for name, method in case["methods"].items()
        for p in method.get("points", [])
    ]  # fmt: skip
    columns = ["", "SPP", "samples in all", "seconds", "least … most", "MSE", "least … most", "relMSE",
               "MSE it claims", "method"]  # fmt: skip
    return Table(columns, rows, label(case))


# ---- crossover -----------------------------------------------------------------------------------


def _crossover(cases: list[dict], folder: Path, command: str) -> Section:
    section = Section("Crossover: from how many samples on the control variate pays")
    section.blocks.append(
        Paragraph(
            "At every error that both reach: the seconds of plain Monte Carlo over those of the "
            "default control variate, training included. From the crossover on this stays above 1; it "
            "is named by the samples a point that plain Monte Carlo has there. Fixed seconds are spent "
            "once an image, so a larger one earns them back at fewer samples a point."
        )
    )
    rows = []
    for case in cases:
        for plain, found in case["crossovers"].items():
            one = Crossover(**found)
            rows.append(
                [label(case), plain, _where(one), one.our_samples, one.seconds, one.end_gain,
                 one.end_plain_samples, one.fixed_seconds, one.cost_ratio, one.samples_ratio]
            )  # fmt: skip
        text = why(case)
        if text:
            section.blocks.append(Paragraph(text, True))
    columns = [
        "", "against", "crossover, its samples", "ours", "seconds", "gain at the end",
        "its samples there", "fixed seconds", "cost a sample, ratio", "samples, ratio",
    ]  # fmt: skip
    if rows:
        section.blocks.append(Table(columns, rows, "Crossovers of the default control variate"))
        plots.gains(cases, folder / "gain.png")
        caption = (
            "Seconds of Sobol Monte Carlo over others' to the same error: above 1 others are faster."
        )
        section.blocks.append(Figure("gain.png", caption, command))
    return section


def _where(one: Crossover) -> str:
    if one.status == "at":
        return shown(one.plain_samples)
    return "at once" if one.status == "always" else f"not up to {one.end_plain_samples:.0f}"


def why(case: dict) -> str:
    """The crossover against Sobol Monte Carlo, and what makes it so, from what was measured."""
    if SOBOL not in case["crossovers"]:
        return f"{label(case)}: no crossover, since one of the two methods was not timed."
    one = Crossover(**case["crossovers"][SOBOL])
    if one.status == "at":
        start = (
            f"pays from {one.plain_samples:.0f} samples of Sobol Monte Carlo on "
            f"({shown(one.seconds)} s); at the least error that both reached it is "
            f"{shown(one.end_gain)} times faster"
        )
    elif one.status == "always":
        start = (
            "pays at every error measured; at the least that both reached it is "
            f"{shown(one.end_gain)} times faster"
        )
    else:
        start = (
            f"does not pay up to {one.end_plain_samples:.0f} samples of Sobol Monte Carlo; there it "
            f"takes {shown(1 / one.end_gain)} times as long"
        )
    reason = (
        f"For that error it spends {shown(one.fixed_seconds)} s on training and integration, a sample "
        f"costs it {shown(one.cost_ratio)} times as much, and plain Monte Carlo needs "
        f"{shown(one.samples_ratio)} times the samples"
    )
    return f"{label(case)}: the control variate {start}. {reason}, {_outlook(one)}{_claims(case)}"


def _outlook(one: Crossover) -> str:
    if one.predicted is None:
        return (
            f"which does not make up for their cost: {shown(one.rate_gain)} times the speed where fixed "
            "seconds no longer count."
        )
    text = f"so {shown(one.rate_gain)} times the speed where fixed seconds no longer count"
    if one.status == "never":
        text += f"; at these rates it would pay from about {one.predicted:.0f} samples on"
    return text + "."


def _claims(case: dict) -> str:
    """The ratio of errors at the largest number of samples that both had."""
    plain, ours = (case["methods"][name].get("points", []) for name in (SOBOL, DEFAULT))
    shared = sorted({p["spp"] for p in plain} & {p["spp"] for p in ours})
    if not shared:
        return ""
    at = shared[-1]
    first, second = (next(p["mse"] for p in one if p["spp"] == at) for one in (plain, ours))
    if min(first, second) <= 0:
        return ""
    return (
        f" At {at} samples each its mean square error is {shown(second / first)} of plain Monte Carlo's."
    )


# ---- auto ----------------------------------------------------------------------------------------


def _auto(cases: list[dict]) -> Section:
    section = Section("How auto fared against the better of the two")
    section.blocks.append(
        Paragraph(
            "At each of its points: the seconds that the better of Sobol Monte Carlo and the default "
            "control variate takes to the same error, over those of auto. 1 is as good as knowing "
            "beforehand. Beside it the same of Sobol Monte Carlo alone, which auto should never fall "
            "behind. The last column says how far runs of one and the same render differed."
        )
    )
    rows = [
        [
            label(case),
            one["spp"],
            one["method"],
            one["better"],
            one["ratio"],
            one["ratios"][SOBOL],
            one["spread"],
        ]
        for case in cases
        for one in case["auto"]
    ]
    for case in cases:
        if not case["auto"]:
            continue
        worst = min(case["auto"], key=lambda one: one["ratio"])
        against_plain = [one["ratios"][SOBOL] for one in case["auto"]]
        verdict = "keeps up" if min(against_plain) >= AUTO_TARGET else "loses"
        section.blocks.append(
            Paragraph(
                f"{label(case)}: auto {verdict}: {shown(min(against_plain))} to "
                f"{shown(max(against_plain))} times Sobol Monte Carlo's speed, and at its worst "
                f"{shown(worst['ratio'])} of the better method's (at {worst['spp']} samples, "
                f"where it chose {worst['method']} and {worst['better']} was the better; its longest "
                f"run there took {shown(worst['spread'])} times its shortest).",
                True,
            )
        )
    section.blocks.append(
        Table(
            ["", "SPP", "auto chose", "better", "ratio", "ratio to MC, Sobol", "longest run / shortest"],
            rows,
        )
    )
    return section


# ---- stages --------------------------------------------------------------------------------------


def _stages(cases: list[dict], folder: Path, command: str) -> Section:
    section = Section("Where the seconds go, and the slides' last table")
    named = "; ".join(f"{name}: {', '.join(members)}" for name, members in STAGES.items())
    section.blocks.append(Paragraph(f"Stages by the slides' names hold these of ours: {named}."))
    equal = [case for case in cases if case["equal_error"]]
    if not equal:
        return section
    plots.stages(equal, folder / "stages.png")
    caption = "Seconds by stage at equal error: methods at the samples that take them there."
    section.blocks.append(Figure("stages.png", caption, command))
    columns = ["", "SPP", "MSE", *STAGES, "other", "total"]
    for case in equal:
        rows = [
            [name, p["spp"], p["mse"], *(p["stages"][s] for s in STAGES), p["stages"]["other"],
             p["seconds"]]
            for name, p in case["equal_error"].items()
        ]  # fmt: skip
        section.blocks.append(Table(columns, rows, f"{label(case)}, seconds at equal error"))
        section.blocks.append(Paragraph(_shares(case), True))
    rows = [[name, *(row.get(c) for c in ("spp", "mse", *STAGES, "other", "total"))]
            for name, row in SLIDES_TABLE.items()]  # fmt: skip
    section.blocks.append(
        Table(columns, rows, "The slides' own figures (another scene, renderer and machine), seconds")
    )
    return section


def _shares(case: dict) -> str:
    """What takes most of the control variate's time, beside what plain Monte Carlo takes in all."""
    rows = case["equal_error"]
    ours, plain = rows[DEFAULT], rows[SOBOL]
    stage = max(ours["stages"], key=ours["stages"].__getitem__)
    text = (
        f"{label(case)}: to this error ({shown(plain['mse'])}) the default control variate takes "
        f"{shown(ours['seconds'])} s, plain Monte Carlo {shown(plain['seconds'])} s; "
        f"{shown(100 * ours['stages'][stage] / ours['seconds'])} % of ours goes to {stage}."
    )
    if SLIDES in rows:
        text += f" The slides' preset takes {shown(rows[SLIDES]['seconds'])} s."
    ratio = (
        SLIDES_TABLE["GI-NCV (the slides)"]["total"] / SLIDES_TABLE["Monte Carlo (the slides)"]["total"]
    )
    return text + (
        f" Ours over plain Monte Carlo: {shown(ours['seconds'] / plain['seconds'])}; in the slides "
        f"{shown(ratio)}."
    )
