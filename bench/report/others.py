"""The sections of all parts but the curves: their findings in sentences, figures, and all numbers."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator
from pathlib import Path

from bench_curves import DEFAULT, SOBOL

from . import gi
from .document import Figure, Paragraph, Section, Table, shown
from .generic import tables
from .parts import Part

# Keys of compare_mitsuba: ours over Mitsuba's.
RATIOS = {
    "samples_per_second_ratio": "samples per second, against Mitsuba's usual way",
    "samples_per_second_ratio_best": "samples per second, against the best of its ways",
    "time_to_error_ratio": "time to Mitsuba's error, against its usual way",
    "time_to_error_ratio_best": "time to Mitsuba's error, against the best of its ways",
}
# Sweeps of bench_scaling, and what varies in each.
SWEEPS = {"points": "size", "width": "width", "triangles": "triangles"}
# "Equal" times that differ by more than this are not called so.
UNLIKE = 1.3


def section(part: Part, data: dict, folder: Path, command: str) -> Section:
    """What a part has to say."""
    found = Section(part.title)
    # A part may bring sentences of its own; for the rest they are made of its numbers here.
    own = data.get("findings", [])
    texts = [
        *_FINDINGS.get(part.name, lambda _: iter(()))(data),
        *(own if isinstance(own, list) else []),
    ]
    found.blocks += [Paragraph(str(text), True) for text in texts]
    if part.name == "pictures":
        found.blocks += _strips(data, folder, command)
        return found
    if part.name == "planar":
        found.blocks += _planar_plot(data, folder, command)
        data = {
            **data,
            "equal_samples": _by(data, "equal_samples"),
            "equal_time": _by(data, "equal_time"),
        }
    rest = {key: value for key, value in data.items() if key not in ("findings", "left_out", "losses")}
    found.blocks += tables(rest, part.name)
    return found


# ---- pictures ------------------------------------------------------------------------------------


def _pictures(data: dict) -> Iterator[str]:
    for case in data["cases"]:
        name = f"{case['scene']} {case['integrand']}"
        if "failed" in case:
            yield f"{name} has no pictures: {case['failed']}."
            continue
        plain, ours = case["methods"][SOBOL], case["methods"][DEFAULT]
        gain = plain["mse"] / ours["mse"] if ours["mse"] > 0 else float("nan")
        verdict = f"{shown(gain)} times less" if gain >= 1 else f"{shown(1 / gain)} times more"
        unlike = max(plain["seconds"], ours["seconds"]) > UNLIKE * min(plain["seconds"], ours["seconds"])
        yield (
            f"{name}: in {'times that came out unlike' if unlike else 'about the same time'} "
            f"({shown(ours['seconds'])} s and {shown(plain['seconds'])} s) the control variate with "
            f"{shown(ours['samples'])} samples has {verdict} mean square error than Sobol Monte Carlo "
            f"with {shown(plain['samples'])}."
        )
    if not data.get("flip"):
        yield "FLIP was left out: this OpenImageIO has no ImageBufAlgo.FLIP_diff."


def _strips(data: dict, folder: Path, command: str) -> list[Figure | Table]:
    blocks: list[Figure | Table] = []
    rows = []
    for case in data["cases"]:
        if "failed" in case:
            continue
        name = f"{case['scene']} {case['integrand']}"
        if (folder / case["picture"]).exists():
            caption = (
                f"{name}, {data['size']} × {data['size']}: at equal time, errors on a common scale."
            )
            blocks.append(Figure(case["picture"], caption, command))
        for method, row in case["methods"].items():
            rows.append(
                [name, method, *(row[k] for k in ("samples", "seconds", "mse", "relmse", "flip"))]
            )
    columns = ["", "method", "samples", "seconds", "MSE", "relMSE", "mean FLIP"]
    return [*blocks, Table(columns, rows, "Errors at equal time")]


# ---- planar --------------------------------------------------------------------------------------


def _is_ours(method: str) -> bool:
    return method.startswith(("ours", "ncv_cl"))


def _planar(data: dict) -> Iterator[str]:
    rows = data.get("equal_samples", [])
    for name in dict.fromkeys(row["integrand"] for row in rows):
        own = [row for row in rows if row["integrand"] == name]
        ours = max((r for r in own if _is_ours(r["method"])), key=_reduction, default=None)
        other = max((r for r in own if not _is_ours(r["method"])), key=_reduction, default=None)
        if ours is None or other is None:
            continue
        verdict = "wins" if _reduction(ours) >= _reduction(other) else "loses"
        yield (
            f"{name}, equal samples: ours {verdict}: variance reduction {shown(_reduction(ours))} "
            f"({ours['method']}, {ours['sampler']}) against {shown(_reduction(other))} of the best "
            f"other ({other['method']}, {other['sampler']})."
        )
    for name, rows in _by(data, "equal_time").items():
        wins, settings = _best_of_settings(rows)
        yield f"{name}, equal time: ours has the least error in {wins} of {settings} settings."
    for method, why in data.get("missing", {}).items():
        yield f"{method} was left out: it {why}."
    for row in data.get("validation", []):
        if not row.get("valid", True):
            yield f"{row['method']} failed its validation on {row['integrand']} and is left out."


def _best_of_settings(rows: list[dict]) -> tuple[int, int]:
    """In how many (seconds, cost of a value) the best method is one of ours, of how many."""
    settings: dict[tuple, list[dict]] = {}
    for row in rows:
        if row["variance_reduction"] is not None:
            settings.setdefault((row["seconds"], row["ns_a_value"]), []).append(row)
    best = [max(group, key=_reduction) for group in settings.values()]
    return sum(_is_ours(row["method"]) for row in best), len(best)


def _reduction(row: dict) -> float:
    return float(row["variance_reduction"])


def _by(data: dict, key: str) -> dict[str, list[dict]]:
    """Rows by integrand: a table each."""
    found: dict[str, list[dict]] = {}
    for row in data.get(key, []):
        found.setdefault(row["integrand"], []).append(row)
    return found


def _planar_plot(data: dict, folder: Path, command: str) -> list[Figure]:
    try:
        module = importlib.import_module("planar_plot")
    except ImportError:
        return []
    module.plot(data, str(folder / "planar.png"))
    return [Figure("planar.png", "Variance reduction at equal samples.", command)]


# ---- Mitsuba -------------------------------------------------------------------------------------


def _mitsuba(data: dict) -> Iterator[str]:
    for key, what in RATIOS.items():
        if key not in data:
            continue
        ratio = data[key]
        if ratio is None:
            yield f"Mitsuba, {what}: not measured or not reached."
        else:
            verdict = "ours wins" if ratio >= 1 else "ours loses"
            yield f"Mitsuba, {what}: ours over Mitsuba's {shown(float(ratio))}, {verdict}."
    rows = [row for row in data.get("agreement", []) if "agrees" in row]
    if rows:
        agree = [row for row in rows if row["agrees"]]
        text = f"Images of {len(agree)} of {len(rows)} scenes and integrands agree with Mitsuba's"
        differ = [f"{row['scene']} {row['integrand']}" for row in rows if not row["agrees"]]
        yield text + (f"; {', '.join(differ)} do not." if differ else ".")
    for row in data.get("agreement", []):
        if "skipped" in row:
            yield f"{row['scene']} {row['integrand']} was not compared with Mitsuba: {row['skipped']}."


# ---- scaling and devices ---------------------------------------------------------------------------


def _scaling(data: dict) -> Iterator[str]:
    """How total seconds grow from a sweep's first row to its last."""
    for sweep, key in SWEEPS.items():
        rows = [row for row in data.get(sweep, []) if "total" in row.get("seconds", {})]
        if len(rows) < 2:
            continue
        first, last = rows[0], rows[-1]
        grown = last["seconds"]["total"] / first["seconds"]["total"]
        yield (
            f"{sweep}: from {key} {first[key]} to {last[key]} a render takes {shown(grown)} times as "
            f"long ({shown(first['seconds']['total'])} s and {shown(last['seconds']['total'])} s)."
        )
    if "largest_bytes" in data:
        fits = "keeps within" if data.get("largest_fits") else "does not keep within"
        size = data["points"][-1]["size"]
        yield (
            f"Memory: the largest image, {size} × {size}, takes {shown(data['largest_bytes'] / 1e9)} GB "
            f"and {fits} its limit."
        )


def _device(data: dict) -> Iterator[str]:
    if "checks" in data:
        failed = [check["subject"] for check in data["checks"] if check["error"]]
        passed, every = len(data["checks"]) - len(failed), len(data["checks"])
        yield (
            f"{data['device']}: {passed} of {every} checks of kernels against their references pass"
            + (f"; {', '.join(failed)} fail." if failed else ".")
        )
    if data.get("unreached_kernels"):
        yield f"No check launched: {', '.join(data['unreached_kernels'])}."
    shapes = [row for row in data.get("shapes", []) if "seconds" in row]
    if shapes:
        best = min(shapes, key=lambda row: row["seconds"]["total"])
        yield (
            f"Shapes: the device's own (VEC {shapes[0]['vec']}, LANES {shapes[0]['lanes']}) takes "
            f"{shown(shapes[0]['seconds']['total'])} s, the fastest (VEC {best['vec']}, LANES "
            f"{best['lanes']}) {shown(best['seconds']['total'])} s."
        )


_FINDINGS: dict[str, Callable[[dict], Iterator[str]]] = {
    "pictures": _pictures,
    "planar": _planar,
    "mitsuba": _mitsuba,
    "scaling": _scaling,
    "device": _device,
    "gi": gi.findings,
}
