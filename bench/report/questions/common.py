"""What several questions share: ratios, labels, tables and charts of the curves."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from bench_curves import curves_of

from .. import svg
from ..document import Answer, Figure, Table, shown

# Numbers of the parts that were run, by part.
Results = Mapping[str, dict]
# From here to its inverse two ways are called equally fast.
EVEN = 1.05
# Of a list in a sentence.
LONGEST = 8


@dataclass(frozen=True)
class Question:
    """A heading, the parts that answer it, and how: from those of the parts that have results."""

    title: str
    parts: tuple[str, ...]
    answer: Callable[[Results], Answer]


def label(case: dict) -> str:
    return f"{case['scene']} {case['integrand']}"


def mean_ratio(ratios: Sequence[float]) -> float:
    """The geometric mean."""
    return float(np.exp(np.mean(np.log(ratios))))


def span(values: Sequence[float], digits: int = 2) -> str:
    """The least and the largest, or the only one."""
    low, high = (f"{one:.{digits}g}" for one in (min(values), max(values)))
    return low if low == high else f"{low} to {high}"


def named(names: Sequence[str]) -> str:
    """A list in a sentence."""
    names = list(names)
    if len(names) > LONGEST:
        return f"{', '.join(names[:LONGEST])} and {len(names) - LONGEST} more"
    if len(names) < 2:
        return "".join(names)
    return f"{', '.join(names[:-1])} and {names[-1]}"


def measured(cases: Sequence[dict]) -> list[dict]:
    """Those of the curves that came to their end."""
    return [case for case in cases if "methods" in case]


def wins(pairs: Sequence[tuple[str, float]]) -> str:
    """How many ratios are above 1, below, and about 1, and which lose."""
    won = [name for name, ratio in pairs if ratio >= EVEN]
    lost = [name for name, ratio in pairs if ratio <= 1 / EVEN]
    text = f"it is faster in {len(won)} of {len(pairs)} images"
    if lost:
        text += f", slower in {len(lost)} ({named(lost)})"
    even = len(pairs) - len(won) - len(lost)
    return text + (f", even in {even}" if even else "")


def ratio_figure(
    name: str,
    rows: Sequence[tuple[str, float, int]],
    note: str,
    caption: str,
    series: Sequence[str] = (),
) -> Figure | None:
    """Bars to either side of 1."""
    kept = [row for row in rows if np.isfinite(row[1]) and row[1] > 0]
    return Figure(name, svg.bars(kept, note, 1.0, series=series), caption) if kept else None


def error_figures(cases: Sequence[dict], error: str, called: str) -> list[Figure]:
    """A figure a case: error of every method against seconds."""
    found = []
    for case in cases:
        series = {
            method: [(p["seconds"], p[error]) for p in one["points"]]
            for method, one in case["methods"].items()
            if "points" in one
        }
        file = f"{error}_{case['scene']}_{case['integrand']}"
        drawn = svg.lines(series, "seconds, training included", called)
        found.append(Figure(file, drawn, f"{label(case)}: {called} against seconds."))
    return found


def curves_by(case: dict, error: str) -> dict:
    """Each method's curve of one kind of error."""
    methods = {
        name: {"points": [p | {"mse": p[error]} for p in one.get("points", [])]}
        for name, one in case["methods"].items()
    }
    return curves_of(methods)


def records(rows: Sequence[dict], caption: str, names: Mapping[str, str] | None = None) -> Table:
    """Rows of scalars as a table; `names` chooses and renames columns."""
    columns = names or {key: key.replace("_", " ") for row in rows for key in row}
    return Table(list(columns.values()), [[row.get(key) for key in columns] for row in rows], caption)


__all__ = [
    "EVEN",
    "Question",
    "Results",
    "curves_by",
    "error_figures",
    "label",
    "mean_ratio",
    "measured",
    "named",
    "ratio_figure",
    "records",
    "shown",
    "span",
    "wins",
]
