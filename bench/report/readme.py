"""README's table of when the network pays, from committed results: `python bench/report/readme.py`.

It stands in README.md between two comments, and a test compares it with what this makes of
`bench/results`. Whatever was not measured has no row.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parent.parent.parent
RESULTS, README = ROOT / "bench" / "results", ROOT / "README.md"
START, END = "<!-- measured -->", "<!-- /measured -->"
# Files of the results that are read.
NEEDED = ("gi_equal", "gi", "equal", "curves", "lines", "slices", "runs")
# Names of ways in the results.
SOBOL, OURS, RELATIVE, AUTO = "MC, Sobol", "NCV", "NCV, relative", "auto"
KINDS = {"direct": "direct light", "ao": "ambient occlusion"}
# From here to its inverse two ways are called equally fast.
EVEN = 1.05


def block(results: Path) -> str:
    """The table, and where it comes from, as Markdown.

    Parameters
    ----------
    results : Path
        A folder that `ncv-cl bench --out` has written.
    """
    files = {name: results / f"{name}.json" for name in NEEDED}
    found = {
        name: json.loads(file.read_text(encoding="utf-8"))
        for name, file in files.items()
        if file.exists()
    }
    rows = [*_paths(found), *_others(found), *_exact(found)]
    lines = ["| image | times as fast | pays from |", "|---|---|---|"]
    lines += [f"| {' | '.join(row)} |" for row in rows]
    machine = found.get("runs", {}).get("machine", {})
    runs = [run for name, run in found.get("runs", {}).get("runs", {}).items() if name in NEEDED]
    commits = ", ".join(sorted({run.get("commit", "unknown") for run in runs}))
    where = f"{machine.get('ncv_cl', 'unknown')}, commit {commits}, {machine.get('cores', '?')} cores"
    return "\n".join([*lines, "", f"Measured with ncv_cl {where}."])


def _paths(found: dict[str, dict]) -> list[tuple[str, str, str]]:
    """Global illumination, by either error."""
    rows = []
    part = found.get("gi_equal", {})
    starts = [
        f"{_start(case['crossovers']['ncv'])} (`{scene}`)"
        for scene, case in found.get("gi", {}).get("cases", {}).items()
    ]
    for error, named in (("mse", "mean square error"), ("relative", "relative error")):
        cases = {
            name: case[f"auto {error}"]
            for name, case in part.get("cases", {}).items()
            if f"auto {error}" in case
        }
        if cases:
            size = part["size"]
            image = f"global illumination at 512 samples a point, {size} × {size}: {named}"
            rows.append((image, _each(cases), "; ".join(starts) if error == "mse" else ""))
    return rows


def _others(found: dict[str, dict]) -> list[tuple[str, str, str]]:
    """Direct light and ambient occlusion, against Sobol points with rays."""
    rows = []
    equal = found.get("equal", {}).get("cases", [])
    for kind, named in KINDS.items():
        own = {case["scene"]: case["rows"][-1] for case in equal if case["integrand"] == kind}
        if not own:
            continue
        samples = next(iter(own.values()))[f"samples of {SOBOL}"]
        ways = (
            (f"{SOBOL} / {OURS}", "mean square error"),
            (f"{SOBOL} / {OURS}, relative error", "relative error"),
            (f"{SOBOL} / {RELATIVE}, relative error", "relative error, `--allocation relative`"),
        )
        starts = [
            f"{_start(case['crossovers'][SOBOL])} (`{case['scene']}`)"
            for case in found.get("curves", {}).get("cases", [])
            if case["integrand"] == kind and SOBOL in case.get("crossovers", {})
        ]
        for key, error in ways:
            cases = {scene: row[key] for scene, row in own.items() if key in row}
            if cases:
                image = f"{named}, against {samples} Sobol points with rays: {error}"
                rows.append((image, _each(cases), "; ".join(starts) if error == ways[0][1] else ""))
        # What auto takes instead, lines or slices without a network, is as fast as this says.
        best = {
            scene: row[f"{SOBOL} / {OURS}"] / row[f"{SOBOL} / {AUTO}"]
            for scene, row in own.items()
            if row["auto chose"] == "mc"
        }
        if best:
            rows.append((f"{named}, against what `auto` takes instead", _each(best), ""))
    return rows


def _exact(found: dict[str, dict]) -> list[tuple[str, str, str]]:
    """Lines and slices, which are no network's doing."""
    rows = []
    for part, kind, many in (("lines", "direct", "points"), ("slices", "ao", "rays")):
        own = found.get(part, {}).get("rows", [])
        for number in sorted({row[many] for row in own}):
            cases = {row["scene"]: row["ratio"] for row in own if row[many] == number}
            image = f"{KINDS[kind]} by {part} without a network, to the error of {number} {many}"
            rows.append((image, _each(cases), ""))
    return rows


def _each(cases: dict[str, float]) -> str:
    """Every scene's ratio; a single word where all lose."""
    text = ", ".join(f"{ratio:.2g} (`{scene}`)" for scene, ratio in cases.items())
    if all(np.array(list(cases.values())) < 1 / EVEN):
        text = f"below 1: {text}"
    return text


def _start(crossing: dict) -> str:
    """From how many samples of plain Monte Carlo on."""
    if crossing["status"] == "always":
        return "the first sample"
    if crossing["status"] == "at":
        return f"{crossing['plain_samples']:.0f} samples"
    return f"never, up to {crossing['end_plain_samples']:.0f} samples"


def written(text: str, results: Path) -> str:
    """README's text with the table anew.

    Raises
    ------
    ValueError
        If the two comments are not there.
    """
    before, start, rest = text.partition(START)
    _, end, after = rest.partition(END)
    if not start or not end:
        raise ValueError(f"README.md has no place for the table: put {START} and {END} there")
    return f"{before}{START}\n{block(results)}\n{END}{after}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--results", type=Path, default=RESULTS, metavar="DIR")
    parser.add_argument("--readme", type=Path, default=README, metavar="FILE")
    options = parser.parse_args()
    text = written(options.readme.read_text(encoding="utf-8"), options.results)
    options.readme.write_text(text, encoding="utf-8")
    print(f"wrote {options.readme}")


if __name__ == "__main__":
    main()
