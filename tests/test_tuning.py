"""Every tuned number says which script finds it again, and is there once."""

from __future__ import annotations

import ast
import re
import shlex
import sys
import time
from collections import Counter
from pathlib import Path

import pytest

import ncv_cl

sys.path.insert(0, str(Path(__file__).parent.parent / "bench"))
import bench_method
import bench_tuning

from ncv_cl.output import report

ROOT = Path(__file__).parent.parent
PACKAGE = Path(ncv_cl.__file__).parent
FILES = sorted(PACKAGE.rglob("tuning.py"))
COMMAND = re.compile(r"python (bench/\w+\.py)((?: [A-Z][A-Z_0-9]+)*)")


def assigned(path: Path) -> dict[str, int]:
    """Names in capitals that a module assigns, and their lines, from 1."""
    found = {}
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        targets = getattr(node, "targets", [getattr(node, "target", None)])
        for target in targets:
            for name in getattr(target, "elts", [target]):
                if isinstance(name, ast.Name) and name.id.isupper():
                    found[name.id] = node.lineno
    return found


def comment_before(lines: list[str], number: int) -> str:
    """The comment above line `number`, other assignments that it speaks of skipped."""
    above = number - 2
    while lines[above] and not lines[above].startswith("#"):
        above -= 1
    words = []
    while lines[above].startswith("#"):
        words.insert(0, lines[above].lstrip("# "))
        above -= 1
    return " ".join(words)


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.parent.name)
def test_every_number_names_the_script_that_finds_it(path):
    lines = path.read_text(encoding="utf-8").splitlines()
    for name, number in assigned(path).items():
        commands = COMMAND.findall(comment_before(lines, number))
        assert commands, f"{path.parent.name}/tuning.py: {name} names no script"
        for script, _ in commands:
            assert (ROOT / script).is_file(), f"{name}: {script}"
        named = {n for script, names in commands if "tuning" in script for n in shlex.split(names)}
        if not any("bench_method" in script for script, _ in commands):
            assert name in named, f"{name} is not among what its comment varies: {named}"


def test_every_number_can_be_varied():
    everywhere = [name for path in FILES for name in assigned(path)]
    assert sorted(everywhere) == sorted([*bench_tuning.names(), *bench_tuning.ELSEWHERE])
    for name in bench_tuning.names():
        present = getattr(bench_tuning.module_of(name), name)
        values = bench_tuning.values_of(name)
        assert present in values and len(set(values)) >= 2
        for value in values:
            with bench_tuning.set_to(name, value):
                assert getattr(bench_tuning.module_of(name), name) == value
        assert getattr(bench_tuning.module_of(name), name) == present


def test_every_number_is_part_of_a_checkpoints_identity(tmp_path, monkeypatch):
    """Of a copy of the package, one number after another is changed."""
    monkeypatch.setattr(report, "__file__", str(tmp_path / "output" / "report.py"))
    for path in FILES:
        copy = tmp_path / path.parent.name / "tuning.py"
        copy.parent.mkdir()
        copy.write_bytes(path.read_bytes())
    digests = {report.tuning_digest.__wrapped__()}
    assert digests == {report.tuning_digest()}
    for path in FILES:
        copy = tmp_path / path.parent.name / "tuning.py"
        copy.write_bytes(path.read_bytes() + b"MORE = 1\n")
        digests.add(report.tuning_digest.__wrapped__())
        copy.write_bytes(path.read_bytes())
    assert len(digests) == 1 + len(FILES)


def test_no_two_constants_share_a_name():
    every = Counter(name for path in PACKAGE.rglob("*.py") for name in assigned(path) if name[0] != "_")
    assert [name for name, count in every.items() if count > 1] == []


def test_thresholds_are_the_best_of_what_was_measured():
    rows = [
        {"samples": 2.0**k, "mc": min(1.0, 2.0 ** (20 - k)), "ncv": min(1.0, 2.0 ** (k - 20))}
        for k in range(15, 25)
    ]
    assert bench_method.threshold_of(rows) == 2.0**20
    never = [row | {"mc": 1.0} for row in rows]
    assert bench_method.threshold_of([row | {"ncv": 0.5} for row in never]) == float("inf")


def test_a_ratio_is_of_the_sooner_method():
    """Errors as one over the samples: the one of a quarter of the variance has fixed seconds of 3."""
    rows = {
        "mc": [{"spp": n, "seconds": float(n), "mse": 4 / n, "stages": {}} for n in (1, 4, 16, 64)],
        "ncv": [{"spp": n, "seconds": 3.0 + n, "mse": 1 / n, "stages": {}} for n in (1, 4, 16, 64)],
    }
    few, many = bench_method.ratios(rows, 0), bench_method.ratios(rows, 3)
    # To an error of 4: 1 s against 4 s; to one of 1: 4 s each.
    assert few == pytest.approx({"mc": 1.0, "ncv": 1.0})
    # To 1 / 16: 64 s against 19 s.
    assert many == pytest.approx({"mc": 19 / 64, "ncv": 1.0})


def test_the_rules_script_measures_and_prints_every_number(one_device, capsys):
    plan = bench_method.Plan({8: (4, 16, 64)}, dict.fromkeys(("direct", "ao", "gi", "independent"), 1e9))
    rows = []
    for case in (
        ("cornell_box", "direct"),
        ("knot", "ao", "points"),
        ("cornell_box", "ao"),
        ("cornell_box", "gi"),
        ("cornell_box", "gi", "embree"),
    ):
        rows += bench_method.measure(one_device, case, 8, "sobol", plan, time.process_time)
    independent = ("cornell_box", "direct"), 8, "independent"
    rows += bench_method.measure(one_device, *independent, plan, time.process_time)
    for row in rows:
        assert row["samples"] % row["spp"] == 0 and row["mc mse"] > 0 and row["ncv mse"] > 0
        assert 0 < row["mc"] <= 1 and 0 < row["ncv"] <= 1
    bench_method.show(rows)
    out = capsys.readouterr().out
    for name in bench_tuning.ELSEWHERE:
        assert re.search(rf"^{name} = (1 << \d+|math.inf)$", out, re.MULTILINE)


@pytest.mark.parametrize("name", ["GAIN", "DENSITY_STEPS", "HIDDEN", "OWN_SHARE"])
def test_a_number_is_varied_in_whole_renders(one_device, capsys, name):
    trial = bench_tuning.TRIALS.get(name, bench_tuning.Trial())
    trial = bench_tuning.replace(trial, cases=trial.cases[:1], size=12, spp=8)
    found = bench_tuning.measure(name, trial, 2, one_device, time.process_time)
    bench_tuning.show(name, trial, found)
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 1 + len(bench_tuning.values_of(name))
    assert next(line for line in lines if "<- present" in line).split()[-3] in ("1.000", "0.000")
