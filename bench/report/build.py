"""From a folder of results to the report: questions in order, the machine, what is left out."""

from __future__ import annotations

import json
from pathlib import Path

from . import svg
from .document import Answer, Section, Table, html, markdown
from .parts import PARTS, command_of
from .questions import machines, network, seconds, truth
from .questions.common import Question, named

TITLE = "ncv_cl: what it takes, and what it gives"
# What the runs and the machine were is kept beside the results.
RUNS = "runs.json"
# Characters of what a part said at last.
LAST = 400
QUESTIONS = (
    seconds.QUESTIONS[0],
    *network.QUESTIONS,
    *truth.QUESTIONS,
    *seconds.QUESTIONS[1:],
    *machines.QUESTIONS,
)


def build_report(folder: Path) -> list[Path]:
    """Write ``report.html``, ``report.md`` and its figures from the JSON files in `folder`.

    Parameters
    ----------
    folder : Path
        Holds ``<part>.json`` of the parts that were run and ``runs.json``, how they went. Whatever is
        missing or broken is named in the report.

    Returns
    -------
    list of Path
        The page, the Markdown, and the figures that stand in the Markdown.
    """
    record = _read(folder / RUNS)[0] or {"machine": {}, "runs": {}}
    found, missing = {}, {}
    for part in PARTS:
        data, why = _read(folder / f"{part}.json")
        if data is None:
            missing[part] = _why(record["runs"].get(part, {}), why)
        else:
            found[part] = data
    if "device" in found:
        # Results of other devices, kept beside those of this one.
        others = {file.stem: _read(file)[0] for file in sorted(folder.glob("device_*.json"))}
        found["device"]["others"] = {name: one for name, one in others.items() if one}
    sections = [_section(question, found, missing, record["runs"]) for question in QUESTIONS]
    sections += [_machine(record), _left_out(found, missing)]
    files = [folder / "report.html", folder / "report.md"]
    files[0].write_text(html(TITLE, _about(record), sections, folder), encoding="utf-8")
    files[1].write_text(markdown(TITLE, sections), encoding="utf-8")
    for section in sections:
        if section.answer.figure:
            files.append(folder / f"{section.answer.figure.name}.svg")
            files[-1].write_text(svg.standalone(section.answer.figure.svg), encoding="utf-8")
    return files


def _read(file: Path) -> tuple[dict | None, str]:
    """A JSON file's object, or why there is none."""
    if not file.exists():
        return None, "not run"
    try:
        found = json.loads(file.read_text(encoding="utf-8"))
    except ValueError as error:
        return None, f"{file.name} cannot be read: {error}"
    return (found, "") if isinstance(found, dict) else (None, f"{file.name} holds no object")


def _section(
    question: Question, found: dict[str, dict], missing: dict[str, str], runs: dict[str, dict]
) -> Section:
    own = {part: found[part] for part in question.parts if part in found}
    absent = [f"{part} ({missing[part]})" for part in question.parts if part in missing]
    if not own:
        return Section(question.title, Answer(f"Not measured: {named(absent)}."))
    # A layout that the report does not expect must not cost the other questions theirs.
    try:
        answer = question.answer(own)
    except (KeyError, TypeError, ValueError, IndexError, AttributeError, StopIteration) as error:
        files = named([f"{part}.json" for part in own])
        answer = Answer(f"{files} could not be shown: {type(error).__name__}: {error}.")
    if absent:
        answer.more.append(f"Left out: {named(absent)}.")
    stale = [part for part in own if runs.get(part, {}).get("status", "ok") != "ok"]
    if stale:
        answer.more.append(f"Incomplete or of an earlier run: {named(stale)}.")
    commands = [runs.get(part, {}).get("command", command_of(part, False)) for part in own]
    return Section(question.title, answer, commands)


def _why(run: dict, missing: str) -> str:
    """What became of a part, in a few words."""
    lines = [line for line in run.get("message", "").splitlines() if line.strip()]
    reasons = {
        "absent": "this checkout has no script for it",
        "timed out": f"ended after {run.get('seconds', 0):.0f} s, which was its limit",
        "no time left": "no time was left for it",
        "failed": f"it failed: {lines[-1]}" if lines else "it failed",
    }
    return reasons.get(run.get("status", ""), missing or "not run")


def _about(record: dict) -> str:
    machine = record["machine"]
    if not machine:
        return "Each question has a figure and a sentence made of the numbers; the numbers are below."
    dates = sorted(run["date"] for run in record["runs"].values())
    when = f" Measured from {dates[0]} to {dates[-1]}." if dates else ""
    return (
        f"ncv_cl {machine.get('ncv_cl', '')} on {machine.get('cores', '?')} cores, "
        f"{str(machine.get('device', '')).split('|')[0].strip()}.{when} Sentences are made of the "
        "numbers, where it loses, too."
    )


def _machine(record: dict) -> Section:
    runs, bad = record["runs"], []
    total = sum(run["seconds"] for run in runs.values())
    rows = [
        [
            name,
            run["status"],
            run["seconds"],
            PARTS[name].seconds,
            run["load"],
            run["date"],
            run.get("commit", "unknown"),
        ]
        for name, run in runs.items()
        if name in PARTS
    ]
    bad = [f"{name} {run['status']}" for name, run in runs.items() if run["status"] != "ok"]
    answer = Answer(
        f"{len(runs)} parts took {total / 60:.0f} minutes, each in a process of its own"
        + (f"; {named(bad)}." if bad else "; all ended well.")
    )
    columns = ["part", "ended", "seconds", "of at most", "load before", "date", "commit"]
    answer.table = Table(columns, rows, "Runs")
    if record["machine"]:
        answer.details.append(Table(["", ""], list(record["machine"].items()), "Machine and versions"))
    for name, run in runs.items():
        if run["status"] in ("failed", "timed out") and run["message"]:
            answer.more.append(
                f"The last lines of {name}: {' ⏎ '.join(run['message'].splitlines())[-LAST:]}"
            )
    return Section("Which machine, which runs?", answer)


def _left_out(found: dict[str, dict], missing: dict[str, str]) -> Section:
    """What the report does not have, by name."""
    rows = [[part, PARTS[part].shows, why] for part, why in missing.items()]
    for part, data in found.items():
        if isinstance(data.get("left_out"), dict):
            rows += [[f"{part}: {what}", "", why] for what, why in data["left_out"].items()]
    if not rows:
        return Section("What is left out?", Answer("Nothing."))
    answer = Answer(f"{len(rows)} things that could be here are not: see the table.")
    answer.table = Table(["what", "which shows", "why"], rows)
    return Section("What is left out?", answer)
