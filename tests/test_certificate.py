"""Whatever goes wrong in an arrangement is noticed, counted by its reason, and done again."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest
from rational import exact_integral, point_network, random_network, relative_errors

from ncv_cl.integration import certificate, integrator
from ncv_cl.integration.integrate import IntegrationError, integrate
from ncv_cl.integration.integrator import INTEGRATION_METHODS
from ncv_cl.opencl import program
from ncv_cl.opencl.device import DeviceError

LIMIT = {"float32": 1e-6, "float64": 1e-13}
# Networks that once crashed, hung, or were certified with errors up to 7 %, with their exact integrals.
TORTURE = np.load(Path(__file__).with_name("torture_networks.npz"))
TORTURE_NAMES = sorted({key.split("/")[0] for key in TORTURE.files})


def torture_network(name):
    """Weights, biases, exact integral and scale."""
    layers = sum(key.startswith(f"{name}/W") for key in TORTURE.files)
    parts = [[TORTURE[f"{name}/{letter}{k}"] for k in range(layers)] for letter in "WB"]
    return *parts, TORTURE[f"{name}/exact"], TORTURE[f"{name}/scale"]


def worst_error(values, network):
    return max(relative_errors(row, *point_network(network, p)).max() for p, row in enumerate(values))


@pytest.fixture
def own_programs(monkeypatch):
    """Programs of this test alone: nearly all of its time is theirs, of which optimising takes half."""
    monkeypatch.setattr(program, "_programs", {})
    options = program.option_list
    monkeypatch.setattr(program, "option_list", lambda defines: [*options(defines), "-cl-opt-disable"])


@pytest.fixture
def changed_kernels(monkeypatch, own_programs):
    """Replaces texts in kernels, for programs that are built in this test only."""
    original = program.source

    def change(*replacements):
        def source(files):
            text = original(files)
            for old, new in replacements:
                assert text.count(old) <= 1, f"not unique: {old}"
                text = text.replace(old, new)
            return text

        monkeypatch.setattr(program, "source", source)

    return change


@pytest.mark.parametrize("method", INTEGRATION_METHODS)
@pytest.mark.parametrize("precision", list(LIMIT))
@pytest.mark.parametrize("name", TORTURE_NAMES)
def test_torture_networks(device, name, precision, method):
    if precision == "float64" and not device.has_float64:
        pytest.skip("no double precision")
    weights, biases, exact, scale = torture_network(name)
    options = {"method": method, "precision": precision, "device": device}
    values, bound, statistics = integrate(
        weights, biases, return_bound=True, return_stats=True, **options
    )
    error = np.abs(values[0] - exact)
    assert statistics.uncertified_points == 0
    assert (error <= LIMIT[precision] * scale).all()
    assert (error <= bound[0]).all()


CAPACITIES = ("MAX_VERTICES", "MAX_HALF_EDGES", "MAX_FACES", "MAX_TRIANGLES", "CORNER_BOUNDS")


@pytest.mark.parametrize("capacity", CAPACITIES)
@pytest.mark.parametrize("method", INTEGRATION_METHODS)
def test_every_capacity_that_does_not_hold_is_noticed(
    device, method, capacity, own_programs, monkeypatch
):
    if capacity == "MAX_TRIANGLES" and method == "full":
        pytest.skip("full lists faces")
    original = integrator.shape_constants

    def too_small(*arguments):
        constants = original(*arguments)
        fewer = {"MAX_VERTICES": 32, "MAX_HALF_EDGES": 24, "MAX_FACES": 5, "MAX_TRIANGLES": 6}
        corners = ",".join(["3"] * int(constants["ARRANGEMENTS"]))
        return constants | {capacity: {**fewer, "CORNER_BOUNDS": corners}[capacity]}

    monkeypatch.setattr(integrator, "shape_constants", too_small)
    network = random_network((2, 9, 7, 2) if method == "full" else (2, 9, 7, 6, 2), 3, seed=1)
    values, statistics = integrate(*network, method=method, device=device, return_stats=True)
    assert statistics.walk == statistics.robust_points == statistics.clipped_points == 3
    assert statistics.uncertified_points == 0
    assert worst_error(values, network) <= LIMIT["float32"]


@pytest.mark.parametrize("method", INTEGRATION_METHODS)
@pytest.mark.parametrize("widths", [(2, 6, 2), (2, 7, 6, 2), (2, 5, 5, 4, 1)])
def test_a_line_that_is_not_inserted_is_seen(device, method, widths, changed_kernels):
    if method == "decoupled" and len(widths) == 3:
        pytest.skip("one hidden layer is not arranged")
    # Areas add up all the same: chords split faces, and these faces stay whole.
    changed_kernels(("if (d->failed) return;\n", "if (d->failed || d->lines == 2) return;\n"))
    network = random_network(widths, 4, seed=2)
    values, statistics = integrate(*network, method=method, device=device, return_stats=True)
    assert statistics.excess == statistics.clipped_points == 4
    assert worst_error(values, network) <= LIMIT["float32"]


@pytest.mark.parametrize("method", INTEGRATION_METHODS)
def test_a_walk_that_leaves_by_a_wrong_side_is_seen(device, method, changed_kernels):
    changed_kernels(
        ("edge.twin - OUTSIDE != passage.leaving_side", "edge.twin - OUTSIDE == passage.leaving_side")
    )
    network = random_network((2, 6, 5, 2), 3, seed=3)
    values, statistics = integrate(*network, method=method, device=device, return_stats=True)
    assert statistics.walk == statistics.clipped_points == 3
    assert worst_error(values, network) <= LIMIT["float32"]


@pytest.mark.parametrize("method", INTEGRATION_METHODS)
def test_areas_that_do_not_add_up_are_seen(device, method, monkeypatch):
    monkeypatch.setitem(certificate.AREA_TOLERANCE, "float32", -1.0)
    network = random_network((2, 6, 5, 2), 3, seed=4)
    values, statistics = integrate(*network, method=method, device=device, return_stats=True)
    again = statistics.float64_points if device.has_float64 else statistics.clipped_points
    assert statistics.area == again == 3
    assert worst_error(values, network) <= LIMIT["float32"]


def cancelling_network(points, factor, seed=5):
    """Hidden neurons in pairs whose parts in the next layer cancel but for a hundredth."""
    weights, biases = random_network((2, 8, 6, 1), points, seed)
    generator = np.random.default_rng(seed)
    weights[0][:, 1::2] = weights[0][:, ::2] * 1.001
    biases[0][:, 1::2] = biases[0][:, ::2]
    weights[1][:, :, ::2] *= factor
    noise = 1 + 0.01 * generator.normal(size=weights[1][:, :, ::2].shape)
    weights[1][:, :, 1::2] = (-weights[1][:, :, ::2] * noise).astype(np.float32)
    return weights, biases


@pytest.mark.parametrize("method", INTEGRATION_METHODS)
def test_cancelling_sums_are_done_in_double(device, method):
    if not device.has_float64:
        pytest.skip("no double precision")
    network = cancelling_network(20, 1000)
    values, bound, statistics = integrate(
        *network, method=method, device=device, return_bound=True, return_stats=True
    )
    assert statistics.condition == statistics.float64_points > 10
    assert worst_error(values, network) <= LIMIT["float32"]
    # In double the bound is as tight as single precision can hold the result.
    assert np.median(bound / np.abs(values)) < 1e-6


def test_ordinary_networks_are_certified_at_once(device):
    network = random_network((2, 8, 8, 3), 200, seed=6)
    _, statistics = integrate(*network, device=device, return_stats=True)
    assert statistics.robust_points <= 4


@pytest.mark.parametrize("method", INTEGRATION_METHODS)
@pytest.mark.parametrize("slope", [0.0, 0.25, -0.5, 3.0])
def test_the_bound_holds_and_shrinks_with_the_precision(one_device, method, slope):
    device = one_device
    network = random_network((2, 6, 5, 2), 8, seed=7)
    activation = {"activation": "leaky_relu", "negative_slope": slope} if slope else {}
    bounds = {}
    for precision in LIMIT if device.has_float64 else ("float32",):
        values, bounds[precision] = integrate(
            *network, precision=precision, method=method, return_bound=True, device=device, **activation
        )
        for point, (row, bound) in enumerate(zip(values, bounds[precision], strict=True)):
            exact, _ = exact_integral(*point_network(network, point), slope)
            errors = [abs(float(value) - float(truth)) for value, truth in zip(row, exact, strict=True)]
            assert (np.array(errors) <= bound).all()
    if len(bounds) == 2:
        np.testing.assert_allclose(bounds["float64"] * 2.0**29, bounds["float32"], rtol=0.01)


def test_a_kernel_that_is_cut_short_is_an_error(device, changed_kernels):
    # What a runtime does that ends loops after so many turns.
    changed_kernels(("is_empty = start >= end;", "is_empty = start >= end / 2;"))
    with pytest.raises(DeviceError, match=r"integrated \d+ of 100 points"):
        integrate(*random_network((2, 4, 3, 1), 100, seed=8), device=device)


def test_points_without_a_result_are_named_and_the_others_kept(one_device):
    weights, biases = random_network((2, 4, 3, 1), 50, seed=9)
    good = integrate(weights, biases, device=one_device)
    for point in (3, 17):
        weights[0][point] = weights[1][point] = 1e30
    with pytest.raises(IntegrationError, match=r"points 3, 17 of 50: use precision='float64'") as caught:
        integrate(weights, biases, device=one_device)
    np.testing.assert_array_equal(caught.value.points, [3, 17])
    np.testing.assert_array_equal(
        np.delete(caught.value.values, [3, 17], 0), np.delete(good, [3, 17], 0)
    )
    assert not np.isfinite(caught.value.values[[3, 17]]).any()


def test_reasons_add_up():
    first = certificate.Statistics(points=5, walk=1, condition=2, uncertified=(1,), scratch_bytes=7)
    both = first + certificate.Statistics(points=4, excess=1, uncertified=(9, 11), scratch_bytes=3)
    assert both.points == 9 and both.robust_points == 4 and both.scratch_bytes == 7
    assert both.uncertified == (1, 9, 11) and both.uncertified_points == 3


@pytest.mark.parametrize("method", INTEGRATION_METHODS)
def test_one_arrangement_in_many_batches_of_redone_points(one_device, method, monkeypatch):
    monkeypatch.setattr(integrator, "POINTS_A_LAUNCH", 7)
    network = cancelling_network(40, 1000, seed=10)
    whole = integrate(*network, method=method, device=one_device)
    monkeypatch.undo()
    np.testing.assert_array_equal(integrate(*network, method=method, device=one_device), whole)


def test_every_reason_has_a_counter():
    places = certificate.certificate_constants((2, 3, 1), "float32", 0.0)
    counters = [places[f"COUNT_{name.upper()}"] for name in certificate.COUNTERS]
    assert counters == list(range(len(certificate.COUNTERS)))
    assert all(a != b for a, b in itertools.combinations(counters, 2))
