"""How long: to a clean picture, by lines and slices, with many lights, with smooth edges."""

from __future__ import annotations

import numpy as np
from bench_curves import AUTO, DEFAULT, INDEPENDENT, SOBOL

from .. import svg
from ..document import Answer, Figure, Picture, Table
from .common import (
    Question,
    Results,
    curves_by,
    error_figures,
    label,
    mean_ratio,
    measured,
    named,
    ratio_figure,
    records,
    shown,
    span,
)

# Root of the relative mean square error at which a picture is called clean.
CLEAN = 0.02
# A reference with more than this share of the least measured error is called coarse.
COARSE = 0.25
SHOWN = (AUTO, DEFAULT, SOBOL, INDEPENDENT)


def clean(found: Results) -> Answer:
    """Seconds of whole renders to a relative error."""
    if "curves" not in found:
        return _pictures(found, Answer("Only pictures were made; see the numbers."))
    data = found["curves"]
    cases = measured(data["cases"])
    rows, bars, slower = [], [], []
    for case in cases:
        curves = curves_by(case, "relmse")
        seconds = {name: float(curves[name].seconds_to(CLEAN**2)[0]) for name in SHOWN if name in curves}
        rows.append([label(case), *(seconds.get(name) for name in SHOWN)])
        bars += [(label(case), one, SHOWN.index(name)) for name, one in seconds.items()]
        if AUTO in seconds and seconds[AUTO] > 1.05 * min(seconds.values()):
            best = min(seconds, key=seconds.__getitem__)
            slower.append(f"{label(case)} ({best} takes {shown(seconds[best] / seconds[AUTO])} of it)")
    if not rows:
        return Answer("No curve was measured.")
    autos = [row[1] for row in rows if row[1]]
    against = [row[4] / row[1] for row in rows if row[1] and row[4]]
    answer = Answer(
        f"At {data['size']} × {data['size']} pixels, auto comes within {100 * CLEAN:.0f} % of the "
        f"reference after {span(autos)} s, training included; independent samples take "
        f"{span(against)} times as long."
    )
    if slower:
        answer.more.append(f"Not the fastest there: {named(slower)}.")
    answer.more.append(
        "Counted is the root of the relative mean square error, with a floor a tenth of the mean. "
        "Seconds beyond what was measured are extrapolated. Kernels are compiled before."
    )
    answer.figure = Figure(
        "clean",
        svg.bars(bars, f"seconds to {100 * CLEAN:.0f} %", series=SHOWN),
        "Seconds to a clean picture; fewer are better.",
    )
    answer.table = Table(["image", *SHOWN], rows, "Seconds to a clean picture")
    answer.details += error_figures(cases, "mse", "mean square error")
    answer.details += [_references(data, cases), *(_points(case) for case in cases)]
    broken = [f"{label(case)}: {case['failed']}" for case in data["cases"] if "failed" in case]
    answer.more += [f"Not measured: {text}." for text in broken]
    return _pictures(found, answer)


def _references(data: dict, cases: list[dict]) -> Table:
    rows = []
    for case in cases:
        one = case["reference"]
        points = (p["mse"] for m in case["methods"].values() for p in m.get("points", []))
        least = min((mse for mse in points if mse > 0), default=float("nan"))
        zs = [abs(m["validation"]["z"]) for m in case["methods"].values()]
        rows.append(
            [
                label(case),
                one["spp"],
                one["mse"],
                one["mse"] / least,
                one["mse"] > COARSE * least,
                one["z"],
                max(zs),
            ]
        )
    columns = [
        "image",
        "samples",
        "own MSE",
        "over the least measured",
        "coarse",
        "Z of its halves",
        "largest |Z| of a method",
    ]
    return Table(
        columns, rows, "References: mean of two renders, by plain Monte Carlo and by control variate"
    )


def _points(case: dict) -> Table:
    rows = [
        [name, p["spp"], p["samples"], p["seconds"], p["mse"], p["relmse"], p["claimed"], p["method"]]
        for name, method in case["methods"].items()
        for p in method.get("points", [])
    ]
    columns = ["", "SPP", "samples", "seconds", "MSE", "relMSE", "MSE it claims", "method"]
    return Table(columns, rows, label(case))


def _pictures(found: Results, answer: Answer) -> Answer:
    """The pictures at equal time, and what they say."""
    gains = []
    for case in found.get("pictures", {}).get("cases", []):
        if "failed" in case:
            answer.more.append(f"{label(case)} has no pictures: {case['failed']}.")
            continue
        plain, ours = case["methods"][SOBOL], case["methods"][DEFAULT]
        gains.append((label(case), plain["mse"] / ours["mse"]))
        text = f"{label(case)} in about {shown(ours['seconds'])} s: each row on one scale."
        answer.details.append(Picture(case["picture"], text))
    if gains:
        more = [f"{name} {shown(gain)}" for name, gain in gains]
        answer.more.append(
            "In equal time, mean square error of Sobol points over the control variate's: "
            f"{named(more)}; below 1 Sobol points are better."
        )
    return answer


def whole(found: Results) -> Answer:
    """Lines on lights and slices of the hemisphere beside points and rays."""
    rows, bars = [], []
    for part, many, few in (("lines", "points", "lines"), ("slices", "rays", "slices")):
        for row in found.get(part, {}).get("rows", []):
            rows.append([row["scene"], f"{row[many]} {many}", f"{row[few]} {few}", row["ratio"]])
            bars.append(
                (f"{row['scene']}, {row[many]} {many}", row["ratio"], 0 if part == "lines" else 1)
            )
    ratios = [row[3] for row in rows]
    lost = [f"{row[0]} at {row[1]}" for row in rows if row[3] < 1]
    answer = Answer(
        f"Where visibility is found exactly, along lines on lights and slices of the hemisphere, the "
        f"processor time of shadow rays is {span(ratios)} times theirs to the same error"
        + (f"; rays are quicker in {named(lost)}." if lost else ".")
    )
    columns = ["scene", "error of", "reached by", "processor time of rays over ours"]
    answer.table = Table(columns, rows, "To equal error")
    answer.figure = ratio_figure(
        "lines_slices",
        bars,
        "processor time of rays / of lines or slices",
        "Above 1 lines and slices are faster.",
        ("lines", "slices"),
    )
    return answer


def lights(found: Results) -> Answer:
    """Cost to an error by the number of lights."""
    rows = found.get("lights", {}).get("rows", [])
    # Differences of very short times may come out negative.
    halls = [row for row in rows if row["scene"].startswith("hall") and row["ns"] > 0]
    answer = Answer("The halls were not measured.")
    if len({row["lights"] for row in halls if row["integrand"] == "direct"}) > 1:
        series = {
            kind: [(r["lights"], r["variance"] * r["ns"]) for r in halls if r["integrand"] == kind]
            for kind in ("direct", "gi")
        }
        few, many = (series["direct"][k] for k in (0, -1))
        answer = Answer(
            f"Direct light of {many[0]} lamps takes {shown(many[1] / few[1])} times as long to the same "
            f"relative error as that of {few[0]}, by independent samples and traced rays."
        )
        drawn = svg.lines(series, "lights", "relative variance × ns a sample")
        answer.figure = Figure("lights", drawn, "Cost to an error by lights, in halls with pillars.")
        answer.table = records(halls, "Halls")
    mesh = found.get("mesh_lights", {}).get("rows", [])
    direct = [row for row in mesh if row["integrand"] == "direct"]
    if len(direct) > 1:
        grown = direct[-1]["product"] / direct[0]["product"]
        answer.more.append(
            f"A mesh of {direct[-1]['triangles']} triangles that emits costs {shown(grown)} times what "
            f"one of {direct[0]['triangles']} does, and {shown(direct[-1]['ready'])} s before."
        )
        answer.details.append(records(mesh, "A sphere that emits"))
    shipped = [row for row in rows if not row["scene"].startswith("hall")]
    if shipped:
        answer.details.append(records(shipped, "Shipped scenes"))
    return answer


def edges(found: Results) -> Answer:
    """Points a pixel and filters at equal samples a pixel."""
    rows = found["filters"]["rows"]
    one = {row["scene"]: row for row in rows if row["supersample"] == 1}
    tents = [row for row in rows if (row["supersample"], row["filter"]) == (2, "tent")]
    slow = [row["processor_seconds"] / one[row["scene"]]["processor_seconds"] for row in tents]
    less = [one[row["scene"]]["error"] / row["error"] for row in tents]
    answer = Answer(
        f"Four points a pixel under a tent take {span(slow)} times as long as one with as many samples "
        f"a pixel, and leave {span(less)} times less error of display values."
    )
    bars = [
        (
            f"{r['scene']} {r['supersample']}×{r['supersample']} {r['filter']}"[:30],
            r["error"],
            {"box": 0, "tent": 1}.get(r["filter"], 2),
        )
        for r in rows
    ]
    drawn = svg.bars(bars, "root mean square error of display values", log=False)
    answer.figure = Figure("edges", drawn, "Error against many points under the same filter.")
    answer.table = records(rows, "Points a pixel and filters")
    if mean_ratio(less) < 1 or np.max(slow) > 2:
        answer.more.append("So it does not pay everywhere.")
    return answer


QUESTIONS = (
    Question("How long to a clean picture?", ("curves", "pictures"), clean),
    Question("What do lines and slices bring?", ("lines", "slices"), whole),
    Question("How many lights?", ("lights", "mesh_lights"), lights),
    Question("What do smooth edges cost?", ("filters",), edges),
)
