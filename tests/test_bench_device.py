"""The device benchmark's checks: all kernels are known and reached, and a failure is told."""

from __future__ import annotations

import importlib
import inspect
import json
import sys
from itertools import pairwise
from pathlib import Path

import pytest

from ncv_cl.opencl.device import GPU_LANES, open_device
from ncv_cl.opencl.program import kernel_folder

sys.path.insert(0, str(Path(__file__).parent.parent / "bench"))
import bench_device
import device_checks


def test_every_kernel_of_every_file_is_known():
    known = set(device_checks.kernel_names())
    assert {"draw_samples", "gradients", "integrate", "integrate_robust", "subdivide"} <= known
    # Attributes stand between `kernel` and `void` in some files and not in others.
    marks = [path.read_text().count("reqd_work_group_size(") for path in kernel_folder().glob("*/*.cl")]
    assert len(known) > sum(marks) > 3


@pytest.mark.parametrize("check", device_checks.CHECKS, ids=lambda check: check[2])
def test_checks_fit_the_tests_that_they_call(check):
    _, module, test, arguments = check
    tests = importlib.import_module(module)
    given = set(arguments(tests) if callable(arguments) else arguments)
    fixtures = {"device", "one_device", "scenes", "plane", "monkeypatch"}
    asked = set(inspect.signature(getattr(tests, test)).parameters)
    assert given <= asked <= given | fixtures


@pytest.mark.slow
def test_a_quick_run_reaches_every_kernel(one_device):
    outcomes, unreached = device_checks.validate(one_device, quick=True)
    assert [outcome for outcome in outcomes if outcome.error] == []
    assert unreached == []


def test_a_failure_makes_the_report_invalid_and_names_the_test(one_device, monkeypatch):
    def wrong(device):
        raise AssertionError("off by one")

    monkeypatch.setattr(device_checks, "wrong", wrong, raising=False)
    monkeypatch.setattr(device_checks, "CHECKS", (("sums", "device_checks", "wrong", {}),))
    for name in ("stages", "shape_row", "work_groups"):
        monkeypatch.setattr(bench_device, name, lambda *_: {})
    for name in ("peaks", "beside_model"):
        monkeypatch.setattr(bench_device.device_stages, name, lambda *_: {})
    monkeypatch.setattr(bench_device, "show", lambda report: None)
    report = bench_device.run(True, one_device)
    assert not report["valid"] and "integrate" in report["unreached_kernels"]
    assert report["checks"][0]["test"] == "device_checks.wrong"
    assert "off by one" in report["checks"][0]["error"]


def test_what_there_is_no_time_for_is_named(one_device, monkeypatch, capsys):
    monkeypatch.setattr(device_checks, "CHECKS", ())
    monkeypatch.setattr(bench_device.device_stages, "peaks", lambda device: {"memory": 1.0})
    monkeypatch.setattr(
        bench_device.device_stages,
        "beside_model",
        lambda *_: monkeypatch.setattr(bench_device, "LIMIT", 0.0) or [],
    )
    saved = []
    report = bench_device.run(True, one_device, lambda one: saved.append(set(one)))
    assert report["left_out"] == ["stages", "work_groups", "shapes"]
    assert [after - before for before, after in pairwise(saved)] == [
        {"peaks"},
        {"model"},
        set(),
    ]
    assert "checks" in saved[0] and json.dumps(report)
    assert "no time was left for: stages, work_groups, shapes" in capsys.readouterr().out


def test_shapes_begin_with_the_devices_own_and_suit_its_kind(one_device):
    found = bench_device.shapes(one_device)
    assert found[0] == (one_device.vector_width, one_device.lanes)
    assert len(set(found)) == len(found) > 2
    gpu_shape = open_device(one_device.cl_device, one_device.index, 1, GPU_LANES)
    assert bench_device.shapes(gpu_shape)[0] == (1, GPU_LANES)
