"""The report: sentences are those of the numbers, and the page opens on a phone and in the dark."""

from __future__ import annotations

import json
import re
import shutil

import browser
import pytest

pytest.importorskip("jinja2", reason="the benchmarks need jinja2")

import bench_curves
from bench_curves import DEFAULT, METHODS, SOBOL
from bench_static import tables_of
from report import document, readme, svg
from report.build import QUESTIONS, build_report
from report.parts import PARTS
from test_report import OURS, PLAIN, SPPS

# Of the page, in bytes, and of the Markdown.
MOST, MOST_MARKDOWN = 5e6, 60e3
PHONE = 390
needs_browser = pytest.mark.skipif(not browser.browser(), reason="neither Chromium nor Chrome is here")


def curves() -> dict:
    """As bench_curves writes them: one case, and one that failed."""
    methods = {
        name: {
            "validation": {"spp": 64, "z": 0.5, "valid": True},
            "points": OURS if "NCV" in name else PLAIN,
        }
        for name in METHODS
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
    broken = {"scene": "fog", "integrand": "direct", "failed": "its halves disagree"}
    return {"size": 8, "spps": SPPS, "left_out": {"stratified": "so"}, "cases": [case, broken]}


EQUAL = {
    "cases": [
        {
            "scene": "box", "integrand": "direct",
            "rows": [{"samples of MC, Sobol": 64, "MC, Sobol / NCV": 0.5, "MC, Sobol / auto": 4.0,
                      "MC, independent / NCV": 30.0, "auto chose": "mc",
                      "MC, Sobol / NCV, relative error": 0.25,
                      "MC, Sobol / NCV, relative, relative error": 0.4}],
        }
    ]
}  # fmt: skip
GI_EQUAL = {
    "size": 96,
    "cases": {"attic": {"auto mse": 3.0, "mc mse": 2.0, "auto relative": 2.5, "mc relative": 2.0,
                        "ncv, relative mse": 1.0, "ncv, relative relative": 2.75}},
}  # fmt: skip
AUTO = {
    "rows": [
        {"scene": name, "integrand": "gi", "spp": 16, "method": "mc", "better": "one part",
         "ratio": ratio, "ratios": {}, "spread": 1.0}
        for name, ratio in (("terrain", 1.2), ("foliage", 0.81))
    ]
}  # fmt: skip
AGREEMENT = [
    {"scene": name, "integrand": "gi", "difference": [0.001, -size, 0.0], "agrees": size < 0.005}
    for name, size in (("box", 0.002), ("fog", 0.03))
]
PEERS = {
    "rows": [
        {"peer": "Radiance", "scene": "box", "quantity": "irradiance", "ours": 1.0, "theirs": 1.01,
         "ratio": 0.99, "standard_error": error, "seconds_ours": 1.0, "seconds_theirs": 2.0}
        for error in (0.01, 0.001)
    ]
}  # fmt: skip
EXECUTORS = {
    "seconds": {"alone": {"processor": 1.0, "clock": 1.0}}, "same_bits": True, "overhead": 1.25,
    "seconds_a_task": 0.004, "bytes_a_task": 18000.0,
}  # fmt: skip
KERNELS = """## sm_90

| kernel | registers | spilt B | occupancy |
| --- | --- | --- | --- |
| `draw_samples` | 168 | 0 | 19% |
| `integrate` | 128 | 8 | 22% |
"""
MODEL = """## Renders

| render | H100 SXM s | ratio |
| --- | --- | --- |
| Cornell box, direct | 0.054 | 30 |
"""
LINES = {"rows": [{"scene": "box", "points": 1024, "lines": 64, "ratio": 3.5}]}
SCALING = {
    "points": [{"size": n, "spp": 4, "seconds": {"train": 1.0, "total": 2.0},
                "bytes": {"whole": n * 1e7}} for n in (64, 128)],
    "largest_bytes": 1.28e9, "largest_fits": True,
}  # fmt: skip
PARTS_OF = {
    "curves": curves(), "equal": EQUAL, "gi_equal": GI_EQUAL, "auto": AUTO,
    "mitsuba": {"agreement": AGREEMENT, "time_to_error_ratio": 4.5}, "peers": PEERS,
    "executors": EXECUTORS, "lines": LINES, "scaling": SCALING,
    "static": {"kernels": tables_of(KERNELS), "model": tables_of(MODEL)},
}  # fmt: skip


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """A folder as `ncv-cl bench` leaves it: some parts, one that cannot be read, one that failed."""
    folder = tmp_path_factory.mktemp("report")
    for part, data in PARTS_OF.items():
        (folder / f"{part}.json").write_text(json.dumps(data))
    (folder / "planar.json").write_text("{")
    failed = {"part": "gi", "command": "ncv-cl bench gi", "date": "today", "status": "failed",
              "seconds": 1.0, "load": 0.0, "message": "ZeroDivisionError: no light"}  # fmt: skip
    record = {"machine": {"cores": 2, "ncv_cl": "9.9"}, "runs": {"gi": failed}}
    (folder / "runs.json").write_text(json.dumps(record))
    return folder


@pytest.fixture(scope="module")
def built(results):
    """The folder, the page and the Markdown."""
    return results, *(path.read_text() for path in build_report(results)[:2])


def test_every_question_is_asked_and_every_part_answers_one(built):
    _, html, text = built
    titles = re.findall(r"^## (.*)$", text, flags=re.MULTILINE)
    assert titles[:-2] == [question.title for question in QUESTIONS]
    assert all(part.path.exists() for part in PARTS.values())
    assert set(PARTS) == {part for question in QUESTIONS for part in question.parts}
    assert all(f">{title}</a>" in html for title in titles)


def test_what_is_missing_is_named(built):
    _, _, text = built
    left = text[text.index("## What is left out?") :]
    for missing in ("pictures", "device", "gi", "planar", "curves: stratified"):
        assert f"| {missing} |" in left
    assert "planar.json cannot be read" in left and "it failed: ZeroDivisionError: no light" in left
    assert "fog direct: its halves disagree" in text


@pytest.mark.parametrize(
    "said",
    [
        # Plain takes 0.01 s a sample, ours 2 s and 0.02 s; relative errors are 2 / n and 2 / (4 n).
        f"auto comes within 2 % of the reference after {0.01 * 5000:.2g} s",
        "the default is 3 times as fast as plain path tracing",
        "the best plain way: 1.5)",
        "against Sobol points it is faster in 0 of 1 images, slower in 1 (box direct)",
        "Against Sobol points it pays in box direct from 400 samples on.",
        "by default it is faster in 1 of 2 images, slower in 1 (box direct) (0",
        "auto reaches 0.900 of the best way's speed on average and 0.810 at worst; 1 of 2",
        "Below: foliage gi at 16 (0.810; one part was better).",
        "2 of 4 comparisons with Mitsuba and Radiance agree; the largest difference of means is 3.00 %",
        "time to an error against its usual way 4.50",
        "Seconds of Radiance over ours: 2.00 on average.",
        "the same bits for 1.25 times the processor seconds",
        "19 to 22 % of the warps resident",
        "1 of 2 kernels spill registers (integrate)",
        "how many times sooner than two cores an H100 would be done: Cornell box, direct 30.",
        "processor time of shadow rays is 3.5 times theirs",
        "128 × 128 points by the control variate takes 1.28 GB, within the 6 GB that",
    ],
)
def test_sentences_are_made_of_the_numbers(built, said):
    assert said in built[2]


def test_a_part_that_cannot_be_shown_costs_no_other(results, tmp_path):
    folder = tmp_path / "copy"
    shutil.copytree(results, folder)
    (folder / "executors.json").write_text(json.dumps({"seconds": 1}))
    text = build_report(folder)[1].read_text()
    assert "executors.json could not be shown: KeyError" in text and "takes 1.28 GB" in text


def test_bars_begin_at_one_and_labels_are_escaped():
    drawn = svg.bars([("a < b", 2.0, 0), ("c", 0.5, 1)], "ratio", 1.0)
    (right, left) = [
        (float(x), float(width))
        for x, width in re.findall(r'<rect class="s\d" x="([\d.]+)" y="[\d.]+" width="([\d.]+)"', drawn)
    ]
    assert right[0] == pytest.approx(left[0] + left[1]) and right[1] == pytest.approx(left[1])
    assert "a &lt; b" in drawn and "prefers-color-scheme:dark" in svg.standalone(drawn)


def test_lines_rise_with_their_values():
    drawn = svg.lines({"one": [(1, 10), (10, 100), (100, 0.0)]}, "x", "y")
    (x0, y0), (x1, y1) = [
        tuple(map(float, p)) for p in re.findall(r'cx="([\d.]+)" cy="([\d.]+)"', drawn)
    ]
    assert x1 > x0 and y1 < y0


def test_the_committed_report_is_of_the_committed_results(tmp_path):
    folder = tmp_path / "results"
    shutil.copytree(readme.RESULTS, folder)
    page, text = build_report(folder)[:2]
    assert page.read_text() == (readme.RESULTS / "report.html").read_text()
    assert text.read_text() == (readme.RESULTS / "report.md").read_text()
    assert page.stat().st_size < MOST and text.stat().st_size < MOST_MARKDOWN
    missing = [f for f in re.findall(r"\]\((\w+\.svg)\)", text.read_text()) if not (folder / f).exists()]
    assert not missing


def test_readme_has_the_numbers_of_the_committed_results(results):
    text = readme.README.read_text()
    assert readme.written(text, readme.RESULTS) == text
    block = readme.block(results)
    assert "3 (`attic`)" in block and "below 1: 0.5 (`box`)" in block and "400 samples (`box`)" in block
    assert "below 1: 0.12 (`box`)" in block and "9.9, commit unknown, 2 cores" in block
    with pytest.raises(ValueError, match="no place for the table"):
        readme.written("# ncv_cl", results)


@needs_browser
@pytest.mark.parametrize("scheme", sorted(browser.SCHEMES))
def test_the_page_opens(tmp_path, scheme):
    page = (readme.RESULTS / "report.html").read_text()
    seen = browser.look_at(page, tmp_path, PHONE, scheme)
    assert not seen["console"] and not seen["broken"]
    assert seen["drawings"] > 5 and seen["width"] == PHONE and seen["needed"] <= PHONE
    bright = {
        name: sum(map(int, re.findall(r"\d+", seen[name])[:3])) / 765 for name in ("ground", "ink")
    }
    assert (bright["ground"] > 0.9 > bright["ink"]) == (scheme == "light")
    assert abs(bright["ground"] - bright["ink"]) > 0.6


@needs_browser
def test_the_browser_sees_what_is_wrong(tmp_path):
    page = (
        "<!DOCTYPE html><body><img src='data:image/png;base64,AAAA'><div style='width:700px'>x</div>"
        "<script>console.error('dark'); missing()</script></body>"
    )
    seen = browser.look_at(page, tmp_path, PHONE, "light")
    assert seen["broken"] == 1 and seen["needed"] > PHONE and len(seen["console"]) == 2


def test_commands_in_sentences_are_marked_and_nothing_else_is(built):
    _, html, text = built
    assert "with `--allocation relative` it" in text
    assert "with <code>--allocation relative</code> it" in html
    assert str(document._marked("a < `b`")) == "a &lt; <code>b</code>"
