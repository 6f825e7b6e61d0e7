"""The judge of exact integration: its networks, its exact values, and that nothing escapes it."""

from __future__ import annotations

import itertools
import os
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from gmpy2 import mpq
from rational import exact_integral, point_network
from torture import LIMIT, Batch, compare, judge
from torture_exact import Exact, exact_batches, exact_numbers
from torture_families import FAMILIES, torture_networks
from torture_verdict import Program, Shape, Verdict, report, total
from torture_worker import CrashError, Outcome, RefusedError, Worker

SHAPES = (2, 8, 8, 1), (2, 5, 4, 1), (2, 6, 6, 6, 1), (2, 12, 1)
PROGRAM = Program(Shape((5, 4)), "float32", "decoupled", (1, 1))
# First biases by which the process of `faulty_serve` knows what to do.
DIE, HANG, REFUSE, RAISE = 13, 14, 15, 16


# ---------------------------------------------------------------------------------------- networks


@pytest.mark.parametrize("widths", SHAPES)
@pytest.mark.parametrize("family", FAMILIES)
def test_a_family_gives_finite_networks_of_the_right_shape(family, widths):
    weights, biases = torture_networks(family, widths, 1, 3, np.float32)
    assert [w.shape for w in weights] == [(3, n, m) for m, n in itertools.pairwise(widths)]
    assert [b.shape for b in biases] == [(3, n) for n in widths[1:]]
    for array in (*weights, *biases):
        assert array.dtype == np.float32 and np.isfinite(array).all()


@pytest.mark.parametrize("family", FAMILIES)
def test_a_network_depends_on_its_names_alone(family):
    def flat(seed, count, dtype=np.float64, widths=(2, 5, 4, 1)):
        weights, biases = torture_networks(family, widths, seed, count, dtype)
        return np.concatenate([array.reshape(count, -1) for array in (*weights, *biases)], 1)

    assert np.array_equal(flat(1, 2), flat(1, 3)[:2])
    assert np.array_equal(flat(1, 2).astype(np.float32), flat(1, 2, np.float32))
    assert not np.array_equal(flat(1, 2), flat(2, 2))
    assert not np.array_equal(*flat(1, 2))


def test_there_are_as_many_families_as_names():
    assert len(FAMILIES) == 37


@pytest.mark.parametrize("family", ["concurrent_dyadic", "concurrent_all_dyadic"])
def test_dyadic_lines_meet_without_any_rounding(family):
    weights, biases = torture_networks(family, (2, 8, 8, 1), 3, 4, np.float32)
    for rows, offsets in zip(weights[0], biases[0], strict=True):
        lines = [tuple(map(mpq, map(float, (*row, c)))) for row, c in zip(rows, offsets, strict=True)]
        (a, b, c), (d, e, f) = next(
            (one, other) for one in lines for other in lines if one[0] * other[1] != one[1] * other[0]
        )
        u, v = (b * f - c * e) / (a * e - b * d), (c * d - a * f) / (a * e - b * d)
        assert 0 < u < 1 and 0 < v < 1
        assert all(a * u + b * v + c == 0 for a, b, c in lines)
    inner = biases[1]
    assert np.all(inner == 0) == (family == "concurrent_all_dyadic")


def test_coincident_lines_are_ulps_apart():
    weights, biases = torture_networks("near_coincident", (2, 8, 8, 1), 3, 20, np.float32)
    lines = np.concatenate([weights[0], biases[0][..., None]], 2).astype(np.float64)
    # At most three of eight lines differ by more than rounding.
    directions = lines / lines[..., :1]
    for some in directions:
        assert len(np.unique(np.round(some, 3), axis=0)) <= 4


# ------------------------------------------------------------------------------------ exact values


@pytest.fixture
def pool():
    # Threads: the values are the same, and no process has to start.
    with ThreadPoolExecutor(1) as threads:
        yield threads


@pytest.mark.parametrize("slope", [0.0, 0.25])
def test_exact_values_are_those_of_rational_arithmetic(tmp_path, pool, slope):
    batches = [torture_networks(f, (2, 4, 3, 2), 5, 2, np.float64) for f in ("he", "cancel_in", "grid")]
    found = exact_batches(batches, slope, tmp_path, pool)
    for batch, exact in zip(batches, found, strict=True):
        for point in range(2):
            integrals, scales = exact_integral(*point_network(batch, point), slope)
            for k in range(2):
                value = mpq(exact.value[point, k]) + mpq(exact.rest[point, k])
                assert abs(value - integrals[k]) <= abs(integrals[k]) * mpq(2) ** -104
                assert exact.scale[point, k] == float(scales[k])


def test_exact_values_are_kept_and_found_by_what_decides_them(tmp_path, pool, monkeypatch):
    batches = [torture_networks("he", (2, 4, 1), 5, 2, np.float64)]
    (first,) = exact_batches(batches, 0.0, tmp_path, pool)
    assert len(list(tmp_path.iterdir())) == 1
    with monkeypatch.context() as patch:
        patch.setattr("torture_exact.exact_numbers", None)
        (again,) = exact_batches(batches, 0.0, tmp_path, pool)
    assert all(np.array_equal(getattr(first, name), getattr(again, name)) for name in vars(first))
    (leaky,) = exact_batches(batches, 0.5, tmp_path, pool)
    batches[0][1][0][0, 0] += 1
    (shifted,) = exact_batches(batches, 0.0, tmp_path, pool)
    assert len(list(tmp_path.iterdir())) == 3
    assert leaky.value[0] != first.value[0] and shifted.value[0] != first.value[0]


@pytest.mark.parametrize("widths", [(2, 5, 4, 1), (2, 4, 4, 4, 1)])
@pytest.mark.parametrize("family", ["concurrent_all", "corners", "near_coincident", "duplicates", "fan"])
def test_exact_values_are_near_sums_over_a_grid(family, widths):
    batch = torture_networks(family, widths, 7, 2, np.float64)
    value, _, scale = exact_numbers(batch, 0.25)
    centres = (np.arange(200) + 0.5) / 200
    for point in range(2):
        weights, biases = point_network(batch, point)
        h = np.stack(np.meshgrid(centres, centres)).reshape(2, -1)
        for w, b in zip(weights[:-1], biases[:-1], strict=True):
            z = w @ h + b[:, None]
            h = np.where(z > 0, z, 0.25 * z)
        mean = weights[-1] @ h.mean(axis=1) + biases[-1]
        assert abs(mean - value[point]) <= 1e-3 * scale[point]


def test_errors_are_relative_to_the_scale():
    exact = Exact(np.array([[1.0], [1.0], [0.0], [1.0]]), np.full((4, 1), 1e-20), np.full((4, 1), 4.0))
    errors = exact.errors(np.array([[1.0], [1.5], [0.0], [np.nan]]))
    assert np.allclose(errors, [2.5e-21, 0.125, 2.5e-21, np.inf], rtol=1e-12, atol=0)
    nothing = Exact(*np.zeros((3, 2, 1)))
    assert nothing.errors(np.array([[0.0], [1e-30]])).tolist() == [0, np.inf]


# ----------------------------------------------------------------------------- crashes and refusals


class FaultyWorker(Worker):
    """Its process does what a first bias tells it to do."""

    @staticmethod
    def serve(connection, *_):
        while True:
            try:
                marks = connection.recv()[1][0][:, 0]
            except EOFError:
                return
            if DIE in marks:
                os.abort()
            if HANG in marks:
                time.sleep(1000)
            if REFUSE in marks:
                connection.send(RefusedError("no finite result"))
            elif RAISE in marks:
                connection.send(CrashError("KeyError: 1"))
            else:
                connection.send((marks[:, None], None, Counter(robust_points=len(marks))))


def marked(*marks):
    return [np.zeros((len(marks), 1, 2))], [np.array(marks, float)[:, None]]


@pytest.mark.parametrize("mark, crash", [(DIE, "SIGABRT"), (RAISE, "KeyError: 1")])
def test_a_crash_costs_only_the_network_that_causes_it(mark, crash):
    with FaultyWorker("0", (1, 1), {}) as worker:
        outcome = worker.integrate(marked(1, 2, mark, 3, 4))
        assert outcome.crash == crash and (outcome.lost, outcome.refused) == (1, 0)
        assert outcome.answered.tolist() == [True, True, False, True, True]
        assert outcome.values[outcome.answered, 0].tolist() == [1, 2, 3, 4]
        assert outcome.redone == {"robust_points": 4}
        # And nothing is left of it.
        after = worker.integrate(marked(5))
        assert after.crash == "" and after.lost == 0 and after.values.tolist() == [[5]]


def test_a_process_that_hangs_is_ended():
    with FaultyWorker("0", (1, 1), {}, limit=1.0) as worker:
        outcome = worker.integrate(marked(HANG))
    assert outcome.crash == "no answer after 1 s" and outcome.lost == 1 and not outcome.answered.any()


def test_a_refusal_is_no_crash():
    with FaultyWorker("0", (1, 1), {}) as worker:
        outcome = worker.integrate(marked(1, REFUSE, 2))
    assert (outcome.crash, outcome.lost, outcome.refused) == ("", 0, 1)
    assert outcome.values[outcome.answered, 0].tolist() == [1, 2]


# ---------------------------------------------------------------------------------------- verdicts


def batch_of(exact):
    ones = np.ones((len(exact), 1))
    return Batch(1, "he", marked(*range(len(exact))), Exact(np.array(exact)[:, None], 0 * ones, ones))


def outcome_of(values, bounds=np.inf, answered=True, **more):
    shape = (len(values), 1)
    return Outcome(
        np.array(values, float).reshape(shape),
        np.broadcast_to(np.reshape(bounds, (-1, 1)), shape),
        np.broadcast_to(answered, len(values)),
        **more,
    )


def test_a_verdict_counts_what_is_beyond_the_limit():
    limit = LIMIT["float32"]
    verdict = compare(
        outcome_of([1, 1 + 2 * limit, 1 + 0.5 * limit]), batch_of([1.0, 1.0, 1.0]), PROGRAM
    )
    assert (verdict.networks, verdict.beyond, verdict.bound_broken) == (3, 1, 0)
    assert np.isclose(verdict.worst, 2 * limit) and verdict.failed
    assert len(verdict.failures) == 1 and "network 1" in verdict.failures[0][1]
    assert not compare(outcome_of([1.0]), batch_of([1.0]), PROGRAM).failed


def test_a_value_that_is_not_a_number_is_beyond_every_limit():
    verdict = compare(outcome_of([np.nan, np.inf, 1]), batch_of([1.0, 1.0, 1.0]), PROGRAM)
    assert verdict.beyond == 2 and verdict.worst == np.inf
    refused = outcome_of([np.nan, 1], answered=[False, True], refused=1)
    verdict = compare(refused, batch_of([1.0, 1.0]), PROGRAM)
    assert (verdict.networks, verdict.refused, verdict.failed) == (1, 1, False)


def test_a_verdict_counts_errors_beyond_the_bound_that_came_with_them():
    verdict = compare(outcome_of([1.25, 1.25], [0.5, 0.125]), batch_of([1.0, 1.0]), PROGRAM)
    assert verdict.bound_broken == 1
    tight = LIMIT["float32"] / 4
    verdict = compare(outcome_of([1 + 2 * tight], [tight]), batch_of([1.0]), PROGRAM)
    assert (verdict.beyond, verdict.bound_broken, verdict.failed) == (0, 1, True)


@pytest.mark.parametrize("fault", [{"crash": "SIGSEGV"}, {"crash": "SIGSEGV", "lost": 1}])
def test_a_crash_fails_however_right_the_rest_is(fault):
    verdict = compare(outcome_of([1.0], **fault), batch_of([1.0]), PROGRAM)
    assert verdict.crashed == 1 and verdict.failed and "SIGSEGV" in verdict.failures[0][1]


def test_sums_keep_the_worst_and_the_report_fails_with_any_part(capsys):
    good = Verdict(networks=2, worst=1e-8, redone=Counter(robust_points=1))
    bad = Verdict(
        networks=3, worst=1e-3, beyond=1, redone=Counter(robust_points=2), failures=[(1e-3, "x")]
    )
    both = total([good, bad])
    assert (both.networks, both.worst, both.beyond) == (5, 1e-3, 1)
    assert both.redone == {"robust_points": 3}
    found = report({(PROGRAM, "he"): good, (PROGRAM, "fan"): bad})
    assert found["failed"] and found["failures"] == ["x"]
    assert found["summary"][0]["robust_points"] == 3
    assert "FAILED" in capsys.readouterr().out
    assert not report({(PROGRAM, "he"): good})["failed"]


def test_right_networks_are_judged_right(one_device):
    names = "he", "corners"
    networks = [torture_networks(name, PROGRAM.shape.widths, 1, 3, np.float32) for name in names]
    batches = [
        Batch(1, n, b, Exact(*exact_numbers(b, 0.0))) for n, b in zip(names, networks, strict=True)
    ]
    program = Program(PROGRAM.shape, "float32", "decoupled", (one_device.vector_width, one_device.lanes))
    verdicts = judge(program, one_device, batches)
    assert {family for _, family in verdicts} == set(names)
    for verdict in verdicts.values():
        assert verdict.networks == 3 and not verdict.failed and 0 < verdict.worst < 1e-6
