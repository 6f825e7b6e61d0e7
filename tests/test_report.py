"""The benchmark's arithmetic and its report, from curves and results that are known."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest

pytest.importorskip("matplotlib", reason="the benchmarks need matplotlib")
pytest.importorskip("jinja2", reason="the benchmarks need jinja2")

import bench_curves
import bench_pictures
import references
from bench_curves import AUTO, DEFAULT, METHODS, SLIDES, SOBOL
from crossover import Curve, against_the_better, crossover
from report import curves, others
from report.build import build_report
from report.document import shown
from report.generic import tables
from report.parts import PARTS, Part, run_part

SPPS = (4, 16, 64, 256, 1024, 4096)
# Plain Monte Carlo: error 1 / n in 0.01 s a sample. Ours: a quarter of the error, at twice the cost a
# sample, after 2 s. So to an error of 1 / n plain takes 0.01 n, ours 2 + 0.02 n / 4: equal at n = 400.
FIXED, COST, GAIN, CROSSING = 2.0, 0.02, 4.0, 400.0


def points(fixed: float, cost: float, gain: float, method: str) -> list[dict]:
    """Rows as bench_curves measures them, of a method with error 1 / (gain n) in fixed + cost n."""
    return [
        {
            "spp": n,
            "samples": float(n),
            "method": method,
            "seconds": fixed + cost * n,
            "seconds_range": [fixed + cost * n, fixed + cost * n],
            "mse": 1 / (gain * n),
            "mse_range": [1 / (gain * n)] * 2,
            "relmse": 2 / (gain * n),
            "relmse_range": [2 / (gain * n)] * 2,
            "claimed": 1 / (gain * n),
            "stages": {
                "render": cost * n, "train": fixed, "integration": 0.0, "inference": 0.0, "other": 0.0
            },
        }
        for n in SPPS
    ]  # fmt: skip


PLAIN, OURS = points(0.0, 0.01, 1.0, "mc"), points(FIXED, COST, GAIN, "ncv")


def test_crossover_is_where_seconds_to_the_same_error_are_equal():
    found = crossover(Curve.of(PLAIN), Curve.of(OURS))
    assert found.status == "at"
    assert found.plain_samples == pytest.approx(CROSSING, rel=1e-3)
    assert found.our_samples == pytest.approx(CROSSING / GAIN, rel=1e-3)
    assert found.seconds == pytest.approx(0.01 * CROSSING, rel=1e-3)
    assert found.error == pytest.approx(1 / CROSSING, rel=1e-3)
    # Plain Monte Carlo is measured to 4096 samples; ours has that error at 1024.
    assert found.end_plain_samples == pytest.approx(4096)
    assert found.end_gain == pytest.approx(40.96 / (FIXED + COST * 1024))
    assert found.fixed_seconds == pytest.approx(FIXED)
    assert found.cost_ratio == pytest.approx(2) and found.samples_ratio == pytest.approx(GAIN)
    assert found.predicted == pytest.approx(CROSSING)


@pytest.mark.parametrize(
    "ours, status", [(points(0.0, 0.01, 4.0, "ncv"), "always"), (points(0.0, 0.05, 4.0, "ncv"), "never")]
)
def test_without_a_crossing_it_says_on_which_side_all_is(ours, status):
    found = crossover(Curve.of(PLAIN), Curve.of(ours))
    assert found.status == status and found.plain_samples is None
    assert (found.end_gain > 1) == (status == "always")
    assert (found.predicted is None) == (status == "never")


@pytest.mark.parametrize("outdone", [{"mse": 1.0}, {"seconds": 3.0}])
def test_a_point_that_others_outdo_is_left_out(outdone):
    curve = Curve.of([*PLAIN[:2], {**PLAIN[2], **outdone}, *PLAIN[3:]])
    assert curve.samples.tolist() == [4, 16, 256, 1024, 4096]
    assert curve.seconds_to(1 / 64) == pytest.approx(0.64)


def test_auto_is_held_against_the_better_of_the_two():
    rows = against_the_better(PLAIN[3:], {SOBOL: Curve.of(PLAIN), DEFAULT: Curve.of(OURS)})
    assert [row["better"] for row in rows] == [SOBOL, DEFAULT, DEFAULT]
    expected = (FIXED + COST * 1024 / GAIN) / (0.01 * 1024)
    assert [row["ratio"] for row in rows[:2]] == pytest.approx([1.0, expected])
    # Against Sobol Monte Carlo, which it is here, it loses nothing.
    assert [row["ratios"][SOBOL] for row in rows] == pytest.approx([1.0, 1.0, 1.0])


def test_reference_subtracts_its_own_variance_and_finds_a_bias():
    generator = np.random.default_rng(1)
    truth = generator.uniform(0.2, 1.0, (64, 64, 3))
    noise = [generator.normal(0, 0.01, truth.shape) for _ in range(3)]
    first, second, image = (truth + one for one in noise)
    found = references.Reference(
        (first + second) / 2, (first - second) ** 2 / 4, 8, 1.0, 0.0, cached=False
    )
    mse, _ = found.errors(image)
    # 12288 squares: a standard deviation of 1.3 %, somewhat more by the subtraction.
    assert mse == pytest.approx(1e-4, rel=0.08)
    assert found.own_errors()[0] == pytest.approx(0.5e-4, rel=0.08)
    assert found.agrees(image)[1] and not found.agrees(image + 0.002)[1]


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """A folder as `results` gives it, with its report: HTML and Markdown."""
    folder = write_results(tmp_path_factory.mktemp("report"))
    return folder, *(path.read_text() for path in build_report(folder))


@pytest.fixture
def results(tmp_path):
    return write_results(tmp_path)


def write_results(tmp_path):
    """A folder with curves of one case, one part of an unknown layout, and one that failed."""
    methods = {}
    for name in METHODS:
        ours = "NCV" in name
        methods[name] = {
            "validation": {"spp": 64, "z": 0.5, "valid": True},
            "points": OURS if ours else PLAIN,
        }
    found = bench_curves.curves_of(methods)
    case = {
        "scene": "box",
        "integrand": "direct",
        "reference": {"spp": 99, "seconds": 1.0, "cached": False, "mse": 1e-9, "relmse": 1e-9, "z": 0.1},
        "methods": methods,
        "crossovers": bench_curves.crossovers(found),
        "auto": bench_curves.auto_rows(methods, found),
        "equal_error": {SOBOL: PLAIN[-1], DEFAULT: OURS[-2]},
    }
    data = {"device": "none", "size": 8, "spps": SPPS, "repeats": 1, "left_out": {"stratified": "so"}}
    broken = {"scene": "fog", "integrand": "direct", "failed": "its halves disagree"}
    (tmp_path / "curves.json").write_text(json.dumps({**data, "cases": [case, broken]}))
    scaling = {"stages": [{"points": 64, "seconds": 0.25}, {"points": 256, "seconds": 1.0}]}
    (tmp_path / "scaling.json").write_text(json.dumps(scaling))
    (tmp_path / "mitsuba.json").write_text(json.dumps({"samples_per_second_ratio": 0.5}))
    (tmp_path / "planar.json").write_text("{")
    failed = {"part": "gi", "command": "ncv-cl bench gi", "date": "today", "status": "failed",
              "seconds": 1.0, "load": 0.0, "message": "ZeroDivisionError: no light"}  # fmt: skip
    (tmp_path / "runs.json").write_text(json.dumps({"machine": {"cores": 2}, "runs": {"gi": failed}}))
    return tmp_path


def test_report_has_every_section_and_names_what_is_missing(built):
    _, html, text = built
    titles = re.findall(r"^## (.*)$", text, flags=re.MULTILINE)
    assert titles[:2] == ["What was found", "Machine and runs"] and titles[-1] == "Left out"
    assert {part.title for name, part in PARTS.items() if name != "curves"} <= set(titles)
    assert [title for title in titles if title.startswith(("Error", "Crossover", "How auto", "Where"))]
    assert all(
        f'<h2 id="s{n}">{title}' in html.replace("&#39;", "'") for n, title in enumerate(titles, 1)
    )
    left = text[text.index("## Left out") :]
    for missing in ("pictures", "device", "gi", "planar", "curves: stratified"):
        assert f"| {missing} |" in left
    assert "ZeroDivisionError: no light" in text and "planar.json cannot be read" in left


def test_report_is_one_file_and_says_how_to_make_its_figures_again(built):
    results, html, text = built
    figures = re.findall(r"!\[.*\]\((.*)\)", text)
    assert len(figures) == 6 and all((results / name).stat().st_size > 1000 for name in figures)
    assert html.count("data:image/png;base64,") == len(figures) and "http" not in html
    assert text.count("`ncv-cl bench curves`") == len(figures)


def test_findings_are_made_of_the_numbers(built):
    folder, _, text = built
    assert f"pays from {CROSSING:.0f} samples of Sobol Monte Carlo on (4.00 s)" in text
    assert f"{shown(40.96 / 22.48)} times faster" in text
    assert (
        "samples per second, against Mitsuba's usual way: ours over Mitsuba's 0.500, ours loses" in text
    )
    assert "auto keeps up: 1.0" in text and "fog direct was not measured: its halves disagree" in text
    (case, _) = json.loads((folder / "curves.json").read_text())["cases"]
    for point in case["methods"][DEFAULT]["points"]:
        point["seconds"] *= 8
    case["crossovers"] = bench_curves.crossovers(bench_curves.curves_of(case["methods"]))
    text = curves.why(case)
    assert (
        "does not pay up to 4096 samples" in text and f"{shown(8 * 22.48 / 40.96)} times as long" in text
    )


def test_of_two_methods_the_other_is_named_once():
    methods = {name: {"points": rows} for name, rows in ((SOBOL, PLAIN), (DEFAULT, OURS))}
    text = curves._least_error({"scene": "attic", "integrand": "direct", "methods": methods})
    assert text.count("MC, Sobol") == 1 and "attic direct: in 41.0 s" in text


def test_a_result_that_cannot_be_shown_costs_no_other(results):
    (results / "curves.json").write_text(json.dumps({"cases": [{"methods": {}}]}))
    text = build_report(results)[1].read_text()
    assert "curves.json could not be shown" in text and "0.250" in text


def test_any_json_becomes_tables():
    rows = [{"a": 1, "b": {"c": 0.5}, "same": "x"}, {"a": 2, "b": {"c": 1.5}, "same": "x"}]
    (one,) = tables({"rows": [*rows, {"a": 3, "same": "x"}]}, "part")
    assert one.columns == ["a", "b.c"] and one.caption == "part: rows, same x"
    assert one.cells() == [["1", "0.500"], ["2", "1.50"], ["3", "–"]]
    (by_name,) = tables({"first": {"s": 1.0}, "second": {"s": 2.0}}, "part")
    assert by_name.cells() == [["first", "1.00"], ["second", "2.00"]]


GI = {
    "cases": {
        "attic": {
            "throughput": {
                "million_rays_a_second": 4.0, "ratio": 0.9, "traced": 0.5, "all_traced_ratio": 0.6
            },
            "finding": [
                {
                    "preset": "slides", "training samples": count, "relative network error": 1 / count,
                    "share of f": 0.4, "gain": 2.0, "most gain": 2.5,
                }
                for count in (64, 1024)
            ],
            "runs": {"Sobol": PLAIN, "ncv": OURS},
            "speedups": {"ncv": 1.5},
            "crossovers": {"ncv": crossover(Curve.of(PLAIN), Curve.of(OURS)).as_dict()},
        }
    }
}  # fmt: skip


def planar(method: str, reduction: float, **more: object) -> dict:
    return {
        "integrand": "disk",
        "method": method,
        "sampler": "sobol",
        "variance_reduction": reduction,
        **more,
    }


@pytest.mark.parametrize(
    "name, data, said",
    [
        (
            "planar",
            {"equal_samples": [planar("ours, density", 5.0), planar("normalizing flow", 2.0)]},
            "disk, equal samples: ours wins: variance reduction 5.00 (ours, density, sobol) against 2",
        ),
        (
            "planar",
            {"equal_samples": [planar("ours, density", 5.0), planar("polynomial regression", 9.0)]},
            "disk, equal samples: ours loses",
        ),
        (
            "planar",
            {
                "equal_time": [
                    planar(name, gain, seconds=seconds, ns_a_value=0.0)
                    for seconds, gains in ((1.0, (3.0, 2.0)), (8.0, (3.0, 4.0)))
                    for name, gain in zip(("ncv_cl.estimate", "Monte Carlo"), gains, strict=True)
                ]
            },
            "disk, equal time: ours has the least error in 1 of 2 settings.",
        ),
        ("planar", {"missing": {"normalizing flow": "needs zuko"}}, "left out: it needs zuko"),
        ("mitsuba", {"time_to_error_ratio": 4.5}, "ours over Mitsuba's 4.50, ours wins"),
        ("mitsuba", {"time_to_error_ratio": None}, "not measured or not reached"),
        (
            "scaling",
            {"points": [{"size": n, "seconds": {"total": n / 32}} for n in (64, 128)]},
            "points: from size 64 to 128 a render takes 2.00 times as long",
        ),
        (
            "device",
            {
                "device": "abacus",
                "checks": [{"subject": "mlp", "error": ""}, {"subject": "fold", "error": "x"}],
            },
            "abacus: 1 of 2 checks of kernels against their references pass; fold fail.",
        ),
        ("gi", {"findings": ["It is dark."]}, "It is dark."),
        ("gi", GI, "attic gi: plain path tracing answers 4.00 million rays a second, all in, 0.900 of"),
        ("gi", GI, "field's variance, but 40.0 % of f's variance is noise of the nested estimate"),
        ("gi", GI, "attic gi: 4096 Sobol samples take 41.0 s; those over the seconds"),
        ("gi", GI, "attic gi: the control variate pays from 400 samples of Sobol Monte Carlo on"),
    ],
)  # fmt: skip
def test_other_parts_numbers_become_sentences(tmp_path, monkeypatch, name, data, said):
    monkeypatch.setattr(others, "_planar_plot", lambda *_: [])
    found = others.section(PARTS[name], data, tmp_path, "command")
    assert [text for text in found.findings if said in text], found.findings


@pytest.mark.parametrize(
    "script, status",
    [
        ("import sys; open(sys.argv[2], 'w').write('{}')", "ok"),
        ("raise SystemExit('no light')", "failed"),
        ("import time; time.sleep(60)", "timed out"),
        (None, "absent"),
    ],
)
def test_a_part_runs_in_a_process_of_its_own(tmp_path, monkeypatch, script, status):
    if script is not None:
        (tmp_path / "part.py").write_text(script)
    monkeypatch.setattr("report.parts.BENCH", tmp_path)
    (tmp_path / "part.json").write_text("{}")
    limit = 0.5 if status == "timed out" else 30.0
    part = Part("part", "part.py", "Part", "nothing")
    run = run_part(part, tmp_path, False, None, limit, ["--size", "8"])
    assert run.status == status and run.command == 'ncv-cl bench part --options "--size 8"'
    assert ("no light" in run.message) == (status == "failed")
    # An earlier run's results do not pass for those of one that failed.
    assert (tmp_path / "part.json").exists() == (status in ("ok", "absent"))


def test_small_curves_are_measured_end_to_end(one_device, tmp_path, monkeypatch):
    monkeypatch.setattr(references, "cache_folder", lambda: tmp_path)
    plan = bench_curves.Plan(12, (4, 16), 1, 256)
    data = bench_curves.measure(one_device, plan, [("cornell_box", "direct")])
    (case,) = data["cases"]
    assert set(case["methods"]) == set(METHODS)
    assert all(method["validation"]["valid"] for method in case["methods"].values())
    assert all(len(method["points"]) == 2 for method in case["methods"].values())
    assert case["methods"][AUTO]["points"][0]["method"] == "mc"
    assert not case["reference"]["cached"] and "stratified" in data["left_out"]
    assert set(case["equal_error"]) <= {SOBOL, SLIDES, DEFAULT}
    for point in case["methods"][DEFAULT]["points"]:
        assert sum(point["stages"].values()) == pytest.approx(point["seconds"], rel=0.2)
    (file,) = tmp_path.glob("*.npz")
    scene = bench_curves.Case(one_device, "cornell_box", "direct", plan)
    assert scene.reference.cached and file.name.startswith("cornell_box_direct_")


def test_pictures_are_drawn_at_equal_time(one_device, tmp_path, monkeypatch):
    monkeypatch.setattr(references, "cache_folder", lambda: tmp_path)
    data = bench_pictures.run(
        one_device, bench_pictures.Plan(12, 4, 64), [("plane_light", "direct")], tmp_path
    )
    (case,) = data["cases"]
    assert (tmp_path / case["picture"]).read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    assert set(case["methods"]) == {SOBOL, DEFAULT}
    assert case["methods"][SOBOL]["samples"] >= 4 and case["methods"][DEFAULT]["mse"] > 0
    (text, *_) = others.section(PARTS["pictures"], data, tmp_path, "command").findings
    assert text.startswith("plane_light direct: in")


@pytest.mark.skipif(not bench_pictures.has_flip(), reason="this OpenImageIO has no FLIP_diff")
def test_flip_grows_with_the_error():
    picture = np.random.default_rng(0).uniform(0.2, 0.8, (32, 32, 3))
    same, near, far = (
        bench_pictures.flip_map(picture, picture + offset).mean() for offset in (0, 0.02, 0.1)
    )
    assert same == pytest.approx(0, abs=1e-6) and same < near < far < 1
