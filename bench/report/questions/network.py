"""When the network pays, by mean square and by relative error, and whether `auto` knows it."""

from __future__ import annotations

from bench_curves import AUTO, DEFAULT, INDEPENDENT, SOBOL
from bench_equal import RELATIVE
from crossover import Crossover

from ..document import Answer, Table
from .common import (
    EVEN,
    Question,
    Results,
    error_figures,
    label,
    mean_ratio,
    measured,
    named,
    ratio_figure,
    records,
    shown,
    span,
    wins,
)

# What `auto` is to reach of the better way, from 16 samples on.
ENOUGH = 0.95


def network(found: Results) -> Answer:
    """Seconds of plain Monte Carlo over those of the control variate, to the same mean square error."""
    last = [(label(case), case["rows"][-1]) for case in found.get("equal", {}).get("cases", [])]
    sobol = [(name, row[f"{SOBOL} / {DEFAULT}"]) for name, row in last]
    # What is as good as auto where that is plain Monte Carlo along lines or slices.
    exact = [
        (name, ratio / row[f"{SOBOL} / {AUTO}"])
        for (name, ratio), (_, row) in zip(sobol, last, strict=True)
        if row["auto chose"] == "mc" and row[f"{SOBOL} / {AUTO}"] > 0
    ]
    paths = gi_ratios(found, "auto", "mse")
    against = [
        (name, one / plain)
        for (name, one), (_, plain) in zip(paths, gi_ratios(found, "mc", "mse"), strict=True)
    ]
    texts = []
    if paths:
        texts.append(
            f"for global illumination the default is {span([r for _, r in paths])} times as fast as "
            f"plain path tracing with Sobol points, to the same mean square error (the network alone, "
            f"against the best plain way: {span([r for _, r in against])})"
        )
    if sobol:
        texts.append(f"for direct light and ambient occlusion against Sobol points {wins(sobol)}")
    if exact:
        texts.append(f"against lines and slices {wins(exact)}")
    text = "; ".join(texts) + "."
    answer = Answer(text[:1].upper() + text[1:])
    bars = [(f"{name} gi", ratio, 0) for name, ratio in paths]
    bars += [(name, ratio, 1) for name, ratio in sobol] + [(name, ratio, 2) for name, ratio in exact]
    answer.figure = ratio_figure(
        "network",
        bars,
        "seconds of plain Monte Carlo / of the control variate",
        "Above 1 the control variate is faster.",
        ("paths, by auto", "against Sobol points", "against lines, slices"),
    )
    if last:
        columns = list(last[0][1])
        rows = [[name, *row.values()] for name, row in last]
        answer.table = Table(["image", *columns], rows, "To the error of so many Sobol samples")
        few = [row[f"{INDEPENDENT} / {DEFAULT}"] for _, row in last]
        answer.more.append(f"Independent random samples take {span(few)} times as long as it.")
    answer.details += _gi_tables(found)
    answer.more += _crossovers(found, answer)
    return answer


def gi_ratios(found: Results, way: str, error: str) -> list[tuple[str, float]]:
    """Of gi_equal: processor seconds of plain path tracing over those of a way."""
    cases = found.get("gi_equal", {}).get("cases", {})
    return [(name, case[f"{way} {error}"]) for name, case in cases.items() if f"{way} {error}" in case]


def _gi_tables(found: Results) -> list[Table]:
    tables = []
    cases = found.get("gi_equal", {}).get("cases", {})
    if cases:
        columns = list(next(iter(cases.values())))
        rows = [[name, *(case.get(c) for c in columns)] for name, case in cases.items()]
        tables.append(
            Table(
                ["scene", *columns],
                rows,
                "Global illumination: seconds of plain path "
                "tracing over those of each way, by either error",
            )
        )
    for scene, case in found.get("gi", {}).get("cases", {}).items():
        rows = [
            {"way": name, **{k: v for k, v in run.items() if k != "stages"}}
            for name, runs in case["runs"].items()
            for run in runs
        ]
        tables.append(records(rows, f"{scene}: errors, seconds and rays of every way"))
        if case["finding"]:
            tables.append(records(case["finding"], f"{scene}: a network's error beside nested noise"))
    return tables


def _crossovers(found: Results, answer: Answer) -> list[str]:
    """From how many samples on; the table goes to the details."""
    rows, pays, never = [], [], []
    cases = [(label(c), c["crossovers"]) for c in measured(found.get("curves", {}).get("cases", []))]
    cases += [
        (f"{scene} gi", {SOBOL: case["crossovers"]["ncv"]})
        for scene, case in found.get("gi", {}).get("cases", {}).items()
    ]
    for name, against in cases:
        for plain, numbers in against.items():
            one = Crossover(**numbers)
            rows.append(
                [
                    name,
                    plain,
                    one.status,
                    one.plain_samples,
                    one.end_plain_samples,
                    one.end_gain,
                    one.fixed_seconds,
                    one.cost_ratio,
                    one.samples_ratio,
                ]
            )
            if plain == SOBOL and one.status == "never":
                never.append(f"{name} ({shown(one.end_gain)} at {one.end_plain_samples:.0f} samples)")
            elif plain == SOBOL:
                start = f"{one.plain_samples:.0f}" if one.status == "at" else "the first"
                pays.append(f"{name} from {start} samples on")
    if not rows:
        return []
    columns = [
        "image",
        "against",
        "crosses",
        "its samples there",
        "its most samples",
        "gain there",
        "fixed seconds",
        "cost a sample, ratio",
        "samples, ratio",
    ]
    answer.details.append(Table(columns, rows, "Where the control variate begins to pay"))
    texts = [f"Against Sobol points it pays in {named(pays)}."] if pays else []
    return texts + ([f"It never paid in {named(never)}."] if never else [])


def relative(found: Results) -> Answer:
    """The same by relative error, in which dark pixels count as much as bright ones."""
    last = [(label(case), case["rows"][-1]) for case in found.get("equal", {}).get("cases", [])]
    of = {
        name: [(one, row.get(f"{SOBOL} / {name}, relative error")) for one, row in last]
        for name in (DEFAULT, RELATIVE)
    }
    of = {name: [pair for pair in pairs if pair[1]] for name, pairs in of.items()}
    paths = {
        name: gi_ratios(found, way, "relative")
        for name, way in ((DEFAULT, "auto"), (RELATIVE, "ncv, relative"))
    }
    texts, bars, rows = [], [], []
    for name, asked in ((DEFAULT, "by default"), (RELATIVE, "with `--allocation relative`")):
        pairs = of[name] + [(f"{scene} gi", ratio) for scene, ratio in paths[name]]
        if pairs:
            texts.append(
                f"{asked} {wins(pairs)} ({shown(mean_ratio([r for _, r in pairs]))} "
                "times as fast on average)"
            )
        bars += [(one, ratio, 0 if name == DEFAULT else 1) for one, ratio in pairs]
        rows += [[one, name, ratio] for one, ratio in pairs]
    if not texts:
        return Answer("No relative error was measured to equal seconds.")
    answer = Answer(
        f"By relative error, against Sobol points, the control variate loses more: {'; '.join(texts)}."
        if _loses_more(found, rows)
        else f"By relative error, against Sobol points, the control variate: {'; '.join(texts)}."
    )
    answer.more.append(
        "Squared errors are over the pixel's squared value plus a floor, a hundredth of the squared "
        "mean, so that dark pixels count as much as bright ones and black ones do not count alone."
    )
    answer.figure = ratio_figure(
        "relative",
        bars,
        "seconds of Sobol points / of the control variate",
        "Above 1 the control variate is faster.",
        ("the default", "--allocation relative"),
    )
    answer.table = Table(["image", "way", "ratio"], rows, "To the same relative error")
    cases = measured(found.get("curves", {}).get("cases", []))
    answer.details += error_figures(cases, "relmse", "relative mean square error")
    return answer


def _loses_more(found: Results, rows: list[list]) -> bool:
    """Whether the default's ratios by relative error are below those by mean square error."""
    absolute = [
        case["rows"][-1][f"{SOBOL} / {DEFAULT}"] for case in found.get("equal", {}).get("cases", [])
    ]
    absolute += [ratio for _, ratio in gi_ratios(found, "auto", "mse")]
    own = [ratio for _, name, ratio in rows if name == DEFAULT]
    return bool(own and absolute) and mean_ratio(own) < mean_ratio(absolute) / EVEN


def auto(found: Results) -> Answer:
    """What `auto` chose in scenes it was not tuned on, over the best that it could have chosen."""
    rows = found.get("auto", {}).get("rows", [])
    answer = Answer("The scenes held out were not measured.")
    if rows:
        ratios = [min(row["ratio"], 1.0) for row in rows]
        low = [
            f"{label(r)} at {r['spp']} ({shown(r['ratio'])}; {r['better']} was better)"
            for r in rows
            if r["ratio"] < ENOUGH
        ]
        images = len({(row["scene"], row["integrand"]) for row in rows})
        answer = Answer(
            f"In {images} images of scenes that no number was tuned on, auto reaches "
            f"{shown(mean_ratio(ratios))} of the best way's speed on average and "
            f"{shown(min(ratios))} at worst; {len(low)} of {len(rows)} choices are below {ENOUGH}."
        )
        if low:
            answer.more.append(f"Below: {named(low)}.")
        worst: dict[str, float] = {}
        for row in rows:
            worst[label(row)] = min(worst.get(label(row), 9.0), row["ratio"])
        bars = [
            (name[:28], min(ratio, 1.0), 0 if ratio >= ENOUGH else 1) for name, ratio in worst.items()
        ]
        answer.figure = ratio_figure(
            "auto",
            bars,
            "speed of auto / of the best way, at worst",
            "1 is as good as knowing beforehand.",
        )
        table = [
            [label(r), r["spp"], r.get("chosen", r["method"]), r["better"], r["ratio"], r.get("spread")]
            for r in rows
        ]
        columns = ["image", "SPP", "auto took", "best", "ratio", "longest run / shortest"]
        answer.table = Table(columns, table, "Scenes held out")
    shipped = [
        [label(case), one["spp"], one["method"], one["better"], one["ratio"]]
        for case in measured(found.get("curves", {}).get("cases", []))
        for one in case["auto"]
    ]
    if shipped:
        answer.details.append(
            Table(
                ["image", "SPP", "auto took", "better", "ratio"],
                shipped,
                "Shipped scenes, against the better of two ways",
            )
        )
        worst_shipped = min(row[4] for row in shipped)
        answer.more.append(
            f"In shipped scenes it is {shown(worst_shipped)} of the better of Sobol points and the "
            "control variate at worst, by the clock."
        )
    return answer


QUESTIONS = (
    Question("When does the network pay?", ("equal", "gi_equal", "gi", "curves"), network),
    Question("How about relative error?", ("equal", "gi_equal", "curves"), relative),
    Question("Does auto choose well?", ("auto", "curves"), auto),
)
