"""From a folder of results to the report: which sections there are, in which order."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

from . import curves, others
from .document import Paragraph, Section, Table, html, markdown
from .parts import PARTS, command_of

TITLE = "ncv_cl: run time against error"
# What the runs and the machine were is kept beside the results.
RUNS = "runs.json"


def build_report(folder: Path) -> list[Path]:
    """Write ``report.html`` and ``report.md`` from the JSON files in `folder`; returns both paths.

    Parameters
    ----------
    folder : Path
        Holds ``<part>.json`` of the parts that were run and ``runs.json``, how they went. Whatever is
        missing or broken is named in the report.
    """
    record, _ = _read(folder / RUNS)
    record = record or {"machine": {}, "runs": {}}
    sections = _sections(folder, record["runs"])
    document = [_summary(sections), _machine(record), *sections, _left_out(folder, record["runs"])]
    files = [folder / "report.html", folder / "report.md"]
    files[0].write_text(html(TITLE, document, folder), encoding="utf-8")
    files[1].write_text(markdown(TITLE, document), encoding="utf-8")
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


def _sections(folder: Path, runs: dict[str, dict]) -> list[Section]:
    """Every part's sections; a part without results has one that says so."""
    sections = []
    for part in PARTS.values():
        data, missing = _read(folder / f"{part.name}.json")
        run = runs.get(part.name, {})
        command = run.get("command", command_of(part.name, False))
        if data is None:
            text = f"Left out: {part.name} ({part.shows}): {_why(run, missing)}."
            sections.append(Section(part.title, [Paragraph(text)]))
            continue
        # A layout that the report does not expect must not cost the other parts theirs.
        try:
            found = _of_part(part.name, data, folder, command)
        except (KeyError, TypeError, ValueError, IndexError, AttributeError) as error:
            text = f"{part.name}.json could not be shown: {type(error).__name__}: {error}."
            found = [Section(part.title, [Paragraph(text)])]
        found[0].blocks.insert(0, Paragraph(f"Measured by: {command}, into {part.name}.json."))
        if run.get("status", "ok") != "ok":
            text = f"{part.name}: what is shown is incomplete or of an earlier run: {_why(run, '')}."
            found[0].blocks.insert(1, Paragraph(text, True))
        sections += found
    # Results of other devices, kept beside those of this one.
    for file in sorted(folder.glob("device_*.json")):
        data, _ = _read(file)
        if data is not None:
            part = dataclasses.replace(PARTS["device"], title=f"Device: {file.stem}")
            sections.append(others.section(part, data, folder, command_of("device", False)))
    return sections


def _of_part(name: str, data: dict, folder: Path, command: str) -> list[Section]:
    if name == "curves":
        return curves.sections(data, folder, command)
    return [others.section(PARTS[name], data, folder, command)]


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


def _summary(sections: list[Section]) -> Section:
    """Every finding, in the order of the sections."""
    found = Section("What was found")
    for section in sections:
        if section.findings:
            found.blocks.append(Paragraph(f"{section.title}:"))
            found.blocks += [Paragraph(text, True) for text in section.findings]
    if not found.blocks:
        found.blocks.append(Paragraph("No part has results."))
    return found


def _machine(record: dict) -> Section:
    section = Section("Machine and runs")
    machine = record["machine"]
    if machine:
        section.blocks.append(Table(["", ""], list(machine.items()), "Machine and versions"))
    rows = [
        [name, run["status"], run["seconds"], run["load"], run["date"], run["command"]]
        for name, run in record["runs"].items()
    ]
    columns = ["part", "ended", "seconds", "load before", "date", "command"]
    if rows:
        section.blocks.append(Table(columns, rows, "Runs, each in a process of its own"))
    for name, run in record["runs"].items():
        if run["status"] in ("failed", "timed out") and run["message"]:
            lines = run["message"].replace("\n", " ⏎ ")
            section.blocks.append(Paragraph(f"The last lines of {name}: {lines}"))
    return section


def _left_out(folder: Path, runs: dict[str, dict]) -> Section:
    """What the report does not have, by name."""
    rows = []
    for part in PARTS.values():
        data, missing = _read(folder / f"{part.name}.json")
        if data is None:
            rows.append([part.name, part.shows, _why(runs.get(part.name, {}), missing)])
        elif isinstance(data.get("left_out"), dict):
            rows += [[f"{part.name}: {what}", "", why] for what, why in data["left_out"].items()]
    if not rows:
        return Section("Left out", [Paragraph("Nothing was left out.")])
    return Section("Left out", [Table(["what", "which shows", "why"], rows)])
