"""Exact integration on GPUs: a work-item a point or a group, and kernels that are cut short."""

from __future__ import annotations

import numpy as np
import pytest
from rational import random_network
from test_integrate import run, worst_error

from ncv_cl.integration import integrator
from ncv_cl.integration.arrangement import shape_constants, team_bytes
from ncv_cl.integration.integrator import Integrator
from ncv_cl.integration.stage import memory_of
from ncv_cl.opencl import program
from ncv_cl.opencl.device import CutShortError, open_device
from ncv_cl.opencl.program import build


def gpu_shape(device, lanes):
    return open_device(device.cl_device, device.index, 1, lanes)


@pytest.mark.parametrize(
    ("widths", "method", "precision", "lanes"),
    [
        ((2, 8, 8, 3), "decoupled", "float32", 32),
        ((2, 5, 6, 2), "full", "float32", 64),
        ((2, 4, 4, 4, 2), "decoupled", "float64", 64),
    ],
)
def test_a_work_item_a_point_gives_the_bits_of_a_group(
    one_device, lanes, widths, method, precision, monkeypatch
):
    device = gpu_shape(one_device, lanes)
    if precision == "float64" and not device.has_float64:
        pytest.skip("no double precision")
    network = random_network(widths, 70, seed=3, dtype=np.dtype(precision).type)
    options = {"method": method, "precision": precision}
    assert Integrator(device, widths, **options).has_a_point_a_work_item
    alone, statistics = run(device, network, widths, **options)
    monkeypatch.setattr(integrator, "PRIVATE_BYTES", 0)
    assert not Integrator(device, widths, **options).has_a_point_a_work_item
    together, of_groups = run(device, network, widths, **options)
    np.testing.assert_array_equal(alone, together)
    assert statistics.points == of_groups.points == 70 and statistics.faces == of_groups.faces
    assert worst_error(alone[:3], network) <= (1e-6 if precision == "float32" else 1e-13)


@pytest.mark.parametrize(
    ("widths", "lanes", "alone"),
    [
        ((2, 8, 8, 3), 32, True),
        # Too large an arrangement for private memory; more neurons than half the lanes.
        ((2, 16, 16, 3), 32, False),
        ((2, 8, 8, 3), 8, False),
        ((2, 3, 20, 1), 32, False),
        ((2, 3, 20, 1), 64, True),
        # CPUs have one lane.
        ((2, 8, 8, 3), 1, False),
    ],
)
def test_small_networks_take_a_work_item_each(one_device, widths, lanes, alone):
    device = open_device(one_device.cl_device, one_device.index, 1, lanes)
    assert Integrator(device, widths).has_a_point_a_work_item == alone


@pytest.mark.parametrize(
    ("widths", "method"), [((2, 8, 8, 3), "decoupled"), ((2, 8, 8, 3), "full"), ((2, 5, 1), "decoupled")]
)
def test_private_memory_is_as_much_as_the_shape_says(one_device, widths, method):
    device = gpu_shape(one_device, 32)
    files, constants = Integrator(device, widths, method=method).programs()[0]
    held = sum(memory_of(build(device, files, constants), "integrate_memory"))
    assert team_bytes(shape_constants(widths, method, 1), method, 4) == pytest.approx(held, rel=0.1)


def cut_loops_short(monkeypatch, turns, loop, limited):
    """Have a loop of the kernels end after -D MOST_TURNS turns, as some runtimes end all loops."""
    original, constants = program.source, Integrator._constants

    def source(files):
        text = original(files)
        assert text.count(loop) <= 1
        return text.replace(loop, limited)

    def with_limit(self, *arguments, **options):
        return constants(self, *arguments, **options) | {"MOST_TURNS": turns}

    monkeypatch.setattr(program, "source", source)
    monkeypatch.setattr(Integrator, "_constants", with_limit)


# The first leaves points out. The second, of one point, leaves out the turn only in which the team finds
# that there is none left: the point in hand may have been what was cut short.
@pytest.mark.parametrize(
    ("turns", "points", "said"),
    [(1, 500, r"integrated \d+ of 500 points"), (1, 1, "integrated 1 of 1 points, and 0 of 1 ")],
)
@pytest.mark.parametrize(("vector_width", "lanes"), [(4, 1), (1, 32)])
def test_a_kernel_that_is_cut_short_is_an_error(
    one_device, monkeypatch, vector_width, lanes, turns, points, said
):
    loop = "for (;;) {\n    BARRIER();\n    if (lane == 0) work->first_point"
    limited = loop.replace("for (;;)", "for (int turn = 0; turn < MOST_TURNS; ++turn)")
    device = open_device(one_device.cl_device, one_device.index, vector_width, lanes)
    widths = (2, 20, 1)
    network = random_network(widths, points, seed=4)
    cut_loops_short(monkeypatch, turns, loop, limited)
    with pytest.raises(CutShortError, match=said):
        run(device, network, widths)


def test_a_work_item_that_is_cut_short_is_an_error(one_device, monkeypatch):
    loop = "for (;;) {\n    BARRIER();\n    if (lane == 0) work->first_point"
    cut_loops_short(
        monkeypatch, 1, loop, loop.replace("(;;)", "(int turn = 0; turn < MOST_TURNS; ++turn)")
    )
    widths = (2, 4, 1)
    with pytest.raises(CutShortError, match="its runtime cut the kernel short"):
        run(gpu_shape(one_device, 32), random_network(widths, 500, seed=4), widths)
