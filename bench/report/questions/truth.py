"""Whether it is right: the exact integral, pictures of other renderers, other control variates."""

from __future__ import annotations

import numpy as np

from .. import svg
from ..document import Answer, Figure, Table
from .common import Question, Results, label, mean_ratio, measured, named, ratio_figure, records, shown

# Peers agree within so many of their standard errors, or within this share.
DEVIATIONS, SHARE = 4.0, 0.005
RATIOS = {
    "samples_per_second_ratio": "samples a second against its usual way",
    "samples_per_second_ratio_best": "against the best of its ways",
    "time_to_error_ratio": "time to an error against its usual way",
    "time_to_error_ratio_best": "against the best of its ways",
}


def exact(found: Results) -> Answer:
    """Errors of the exact integral, and what quadrature takes to the same."""
    data = found["integrate"]
    columns = [key for key in data["stress"][0] if key != "network"]
    worst = {key: max(row[key][0] for row in data["stress"] if key in row) for key in columns}
    robust = {key: sum(row[key][1] for row in data["stress"] if key in row) for key in columns}
    single = max(error for key, error in worst.items() if key.startswith("float32"))
    name, rows = next(iter(data["quadrature"].items()))
    ours = next(row for row in rows if row[0] == "decoupled")
    best = min((row for row in rows if row[0] not in ("decoupled", "full")), key=lambda row: row[2])
    speed = data["speed"][0]
    answer = Answer(
        f"On {len(data['stress'])} networks made to break it, the float32 integral is off by "
        f"{single:.1e} of the network's range at worst; the best quadrature tried, {best[1]} values by "
        f"{best[0]}, is off by {best[2]:.1e} ({name}) and takes "
        f"{shown(best[3] / ours[3])} times as long."
    )
    answer.more.append(
        f"An integral over {speed['networks']} costs {shown(speed['us_a_point'])} µs a point, as much "
        f"as {speed['samples_in_that_time']:.0f} evaluations of that network."
    )
    series: dict[str, list[tuple[float, float]]] = {}
    for row in rows:
        series.setdefault(row[0], []).append((row[3], row[2]))
    drawn = svg.lines(series, "µs a point", "relative error")
    answer.figure = Figure("exact", drawn, f"{name}: the exact integral beside quadrature.")
    answer.table = Table(
        ["", "worst error", "points that needed robust kernels"],
        [[key, worst[key], robust[key]] for key in columns],
        "Networks made to break it, against rational arithmetic",
    )
    answer.details.append(records(data["speed"], "Cost of an integral"))
    scaling = [[r["case"], *r["decoupled"], *r["full"]] for r in data["scaling"]]
    answer.details.append(Table(["", "µs a point", "faces", "full, µs", "faces"], scaling, "By size"))
    return answer


def picture(found: Results) -> Answer:
    """Means of images and values beside those of other programs."""
    pairs = [
        (f"{label(row)}, Mitsuba", float(np.abs(row["difference"]).max()), row["agrees"])
        for row in found.get("mitsuba", {}).get("agreement", [])
        if "agrees" in row
    ]
    every = found.get("peers", {}).get("rows", [])
    notes: list[str] = []
    rows = [row for row in every if row.get("ratio") and np.isfinite(row["ratio"])]
    for row in rows:
        off = abs(row["ratio"] - 1)
        # The standard error is the ratio's own.
        allowed = max(SHARE, DEVIATIONS * (row["standard_error"] or 0.0))
        name = f"{row['scene']} {row['quantity']}, {row['peer']}"
        pairs.append((name, off, off <= allowed))
        if off > allowed and row.get("note"):
            notes.append(f"{name}: {row['note']}.")
    if not pairs:
        return Answer("No other program was at hand.")
    off = [name for name, _, agrees in pairs if not agrees]
    peers = sorted({name.rsplit(", ", 1)[1] for name, _, _ in pairs})
    largest = max(pairs, key=lambda pair: pair[1])
    answer = Answer(
        f"{len(pairs) - len(off)} of {len(pairs)} comparisons with {named(peers)} agree; the largest "
        f"difference of means is {shown(100 * largest[1])} % ({largest[0]})"
        + (f"; not in agreement: {named(off)}." if off else ".")
    )
    bars = [(_short(name), 100 * max(size, 1e-6), 0 if agrees else 1) for name, size, agrees in pairs]
    answer.figure = Figure(
        "picture",
        svg.bars(bars, "difference in %", series=("agrees", "does not")),
        "Differences of means over all pixels or points.",
    )
    answer.table = Table(["image, peer", "difference", "agrees"], [list(p) for p in pairs], "Means")
    answer.more += [*notes, *_speeds(found, rows)]
    zs = [
        abs(m["validation"]["z"])
        for case in measured(found.get("curves", {}).get("cases", []))
        for m in case["methods"].values()
    ]
    if zs:
        answer.more.append(
            f"Our own methods agree with each other: of {len(zs)} images the largest difference of "
            f"means is {shown(max(zs))} deviations."
        )
    skipped: dict[str, list[str]] = {}
    for row in found.get("mitsuba", {}).get("agreement", []):
        if "skipped" in row:
            skipped.setdefault(row["skipped"], []).append(label(row))
    for row in every:
        if row not in rows:
            skipped.setdefault(row["note"], []).append(f"{row['scene']} with {row['peer']}")
    answer.more += [f"Not compared: {named(names)}: {why}." for why, names in skipped.items()]
    if rows:
        answer.details.append(records(rows, "Other programs"))
    return answer


def _short(name: str) -> str:
    """A comparison's name as a bar has room for it."""
    first, peer = name.rsplit(", ", 1)
    return f"{first[:16].strip()}, {peer}"[:29]


def _speeds(found: Results, rows: list[dict]) -> list[str]:
    texts = []
    mitsuba = found.get("mitsuba", {})
    own = [f"{what} {shown(float(mitsuba[key]))}" for key, what in RATIOS.items() if mitsuba.get(key)]
    if own:
        texts.append(f"Speed over Mitsuba's in the Cornell box, direct light: {named(own)}.")
    for peer in dict.fromkeys(row["peer"] for row in rows):
        ratios = [
            (row["scene"], row["seconds_theirs"] / row["seconds_ours"])
            for row in rows
            if row["peer"] == peer and row.get("seconds_ours") and row.get("seconds_theirs")
        ]
        if ratios:
            slower = [f"{scene} ({shown(ratio)})" for scene, ratio in ratios if ratio < 1]
            text = f"Seconds of {peer} over ours: {shown(mean_ratio([r for _, r in ratios]))} on average"
            texts.append(text + (f"; slower than it in {named(slower)}." if slower else "."))
    return texts


def planar(found: Results) -> Answer:
    """Two-dimensional integrands with known integrals."""
    data = found["planar"]
    rows = data["equal_samples"]
    pairs, table = [], []
    for name in dict.fromkeys(row["integrand"] for row in rows):
        own = [row for row in rows if row["integrand"] == name]
        ours, other = (
            max(
                (r for r in own if _is_ours(r["method"]) == mine),
                key=lambda r: r["variance_reduction"],
                default=None,
            )
            for mine in (True, False)
        )
        if ours and other:
            ratio = ours["variance_reduction"] / other["variance_reduction"]
            pairs.append((name, ratio))
            table.append(
                [
                    name,
                    ours["variance_reduction"],
                    f"{ours['method']}, {ours['sampler']}",
                    other["variance_reduction"],
                    f"{other['method']}, {other['sampler']}",
                ]
            )
    won = [name for name, ratio in pairs if ratio >= 1]
    lost = [name for name, ratio in pairs if ratio < 1]
    answer = Answer(
        f"At equal samples ours has the least error on {len(won)} of {len(pairs)} planar integrands"
        + (f"; others are better on {named(lost)}." if lost else ".")
    )
    bars = [(name, ratio, 0 if ratio >= 1 else 1) for name, ratio in pairs]
    answer.figure = ratio_figure(
        "planar", bars, "variance reduction of ours / of the best other", "Above 1 ours is better."
    )
    columns = ["integrand", "ours", "", "best other", ""]
    answer.table = Table(columns, table, "Variance reduction at equal samples, at best")
    answer.more += [f"{name} was left out: it {why}." for name, why in data.get("missing", {}).items()]
    names = {
        "integrand": "integrand",
        "method": "method",
        "sampler": "sampler",
        "variance_reduction": "variance reduction",
        "training_seconds": "training s",
        "ns_a_sample": "ns a sample",
    }
    answer.details.append(records(rows, "Equal samples", names))
    timed = [row for row in data["equal_time"] if row["variance_reduction"] is not None]
    names = {
        "integrand": "integrand",
        "method": "method",
        "sampler": "sampler",
        "seconds": "s",
        "ns_a_value": "ns a value",
        "variance_reduction": "variance reduction",
    }
    answer.details.append(records(timed, "Equal time", names))
    return answer


def _is_ours(method: str) -> bool:
    return method.startswith(("ours", "ncv_cl"))


QUESTIONS = (
    Question("How exact is the integral?", ("integrate",), exact),
    Question("Is it the right picture?", ("mitsuba", "peers", "curves"), picture),
    Question("How do other control variates do?", ("planar",), planar),
)
