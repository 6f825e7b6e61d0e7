"""The benchmark's arithmetic from curves that are known, its parts in processes, its smallest runs."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("matplotlib", reason="the benchmarks need matplotlib")
pytest.importorskip("jinja2", reason="the benchmarks need jinja2")

import bench_curves
import bench_pictures
import references
import run_all
from bench_curves import AUTO, DEFAULT, METHODS, SLIDES, SOBOL
from crossover import Curve, against_the_better, crossover
from report.parts import FULL_SECONDS, PARTS, Part, run_part

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


def test_the_full_run_has_an_end():
    assert sum(part.seconds for part in PARTS.values()) <= FULL_SECONDS
    names = list(PARTS)
    gone = 0.0
    for k, name in enumerate(names):
        limit = run_all._limit(False, FULL_SECONDS, gone, names[k + 1 :])
        # Its own seconds, less its part of what the report takes, though others took all of theirs.
        assert limit >= PARTS[name].seconds * (1 - run_all.REPORT_SECONDS / FULL_SECONDS) - 1e-6
        gone += limit
    assert gone + run_all.REPORT_SECONDS <= FULL_SECONDS + 1e-6
    # What is left over goes to the next.
    assert run_all._limit(False, FULL_SECONDS, 0.0, names[2:]) > PARTS[names[0]].seconds


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
    part = Part("part", "part.py", 1.0, "nothing")
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
    assert (tmp_path / case["picture"]).read_bytes()[:3] == b"\xff\xd8\xff"
    assert set(case["methods"]) == {SOBOL, DEFAULT}
    assert case["methods"][SOBOL]["samples"] >= 4 and case["methods"][DEFAULT]["mse"] > 0


@pytest.mark.skipif(not bench_pictures.has_flip(), reason="this OpenImageIO has no FLIP_diff")
def test_flip_grows_with_the_error():
    picture = np.random.default_rng(0).uniform(0.2, 0.8, (32, 32, 3))
    same, near, far = (
        bench_pictures.flip_map(picture, picture + offset).mean() for offset in (0, 0.02, 0.1)
    )
    assert same == pytest.approx(0, abs=1e-6) and same < near < far < 1
