"""Exact integration: both methods against rational arithmetic, in every shape of device."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from rational import exact_integral, point_network, random_network, relative_errors

from ncv_cl.integration import certificate
from ncv_cl.integration.arrangement import Capacities
from ncv_cl.integration.integrate import integrate
from ncv_cl.integration.integrator import Integrator
from ncv_cl.opencl.device import GPU_LANES, open_device, widest_vectors
from ncv_cl.opencl.memory import HostArray
from ncv_cl.opencl.program import option_list, source

LIMIT = {"float32": 1e-6, "float64": 1e-13}
CLANG = shutil.which("clang")
OCLGRIND = shutil.which("oclgrind")


def worst_error(values, network, slope=0.0):
    return max(
        relative_errors(row, *point_network(network, p), slope).max() for p, row in enumerate(values)
    )


def run(device, network, widths, begin=0, end=None, **options):
    """G and statistics through `Integrator`, on arrays that lie on the device."""
    weights, biases = ([HostArray.of(device, array) for array in part] for part in network)
    integrator = Integrator(
        device, widths, [a.ndim == 3 for a in network[0]], [a.ndim == 2 for a in network[1]], **options
    )
    points = max([a.shape[0] for a in network[1] if a.ndim == 2], default=1)
    out = HostArray(device, (points, widths[-1]), integrator.dtype)
    out.fill(0)
    statistics = integrator.run(weights, biases, out, begin, end)
    return out.read(), statistics


@pytest.mark.parametrize("method", ["decoupled", "full"])
@pytest.mark.parametrize(
    "widths", [(2, 3), (2, 7, 1), (2, 5, 17, 3), (2, 4, 5, 3, 2), (2, 3, 3, 3, 3, 1)]
)
def test_methods_meet_rational_arithmetic(device, widths, method):
    network = random_network(widths, 2, seed=1)
    values, statistics = integrate(*network, method=method, device=device, return_stats=True)
    assert values.shape == (2, widths[-1]) and values.dtype == np.float32
    assert worst_error(values, network) <= LIMIT["float32"]
    assert statistics.robust_points == statistics.uncertified_points == 0


@pytest.mark.parametrize("method", ["decoupled", "full"])
def test_scaling_changes_no_bit(device, method):
    # 2^40 moved from layer to layer: such weights are scaled first, ordinary ones are not.
    weights, biases = random_network((2, 6, 5, 2), 3, seed=8)
    plain = integrate(weights, biases, method=method, device=device)
    weights[0] *= np.float32(2.0**40)
    biases[0] *= np.float32(2.0**40)
    weights[1] *= np.float32(2.0**-40)
    assert np.array_equal(integrate(weights, biases, method=method, device=device), plain)


@pytest.mark.parametrize("method", ["decoupled", "full"])
def test_float64_and_leaky_relu(device, method):
    if not device.has_float64:
        pytest.skip("no double precision")
    network = random_network((2, 6, 9, 2), 2, seed=2, dtype=np.float64)
    options = {"activation": "leaky_relu", "negative_slope": 0.3, "method": method}
    values = integrate(*network, precision="float64", device=device, **options)
    assert worst_error(values, network, 0.3) <= LIMIT["float64"]
    single = [[a.astype(np.float32) for a in part] for part in network]
    values = integrate(*single, device=device, **options)
    assert worst_error(values, single, float(np.float32(0.3))) <= LIMIT["float32"]


@pytest.mark.parametrize("widths", [(2, 7, 2), (2, 6, 9, 3), (2, 4, 5, 4, 2)])
@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_robust_path_agrees(one_device, widths, precision, monkeypatch):
    # No arrangement is that exact, in whatever precision.
    monkeypatch.setattr(certificate, "excess_tolerance", lambda *_: -1.0)
    network = random_network(widths, 3, seed=3, dtype=np.dtype(precision).type)
    options = {"precision": precision, "negative_slope": 0.25}
    values, statistics = run(one_device, network, widths, **options)
    assert statistics.excess == statistics.clipped_points == 3 and statistics.uncertified_points == 0
    assert worst_error(values, network, 0.25) <= LIMIT[precision]


def test_matches_dense_quadrature(one_device):
    network = random_network((2, 32, 32, 3), None, seed=4)
    centres = (np.arange(1500) + 0.5) / 1500
    hidden = np.stack(np.meshgrid(centres, centres), -1).reshape(-1, 2).astype(np.float32)
    for weight, bias in zip(network[0][:-1], network[1][:-1], strict=True):
        hidden = np.maximum(hidden @ weight.T + bias, 0)
    quadrature = (hidden @ network[0][-1].T + network[1][-1]).mean(0, dtype=np.float64)
    for method in ("decoupled", "full"):
        values = integrate(*network, method=method, device=one_device)
        np.testing.assert_allclose(values[0], quadrature, atol=3e-5)


def test_every_mixture_of_shared_and_per_point_arrays(one_device):
    full = random_network((2, 5, 6, 2), 3, seed=5)
    for mask in (0, 1, 2, 4, 8, 16, 32, 0b101111, 0b111111):
        flags = [bool(mask >> bit & 1) for bit in range(6)]
        weights = [w if keep else w[0] for w, keep in zip(full[0], flags, strict=False)]
        biases = [b if keep else b[0] for b, keep in zip(full[1], flags[3:], strict=True)]
        expected = [
            [np.broadcast_to(a if keep else a[:1], a.shape) for a, keep in zip(part, kept, strict=True)]
            for part, kept in ((full[0], flags[:3]), (full[1], flags[3:]))
        ]
        values = integrate(weights, biases, device=one_device)
        assert values.shape == (3 if any(flags) else 1, 2)
        reference = integrate(*expected, device=one_device)[: len(values)]
        np.testing.assert_array_equal(values, reference)


@pytest.mark.parametrize("method", ["decoupled", "full"])
def test_a_point_has_the_same_bits_in_every_range(device, method):
    widths = (2, 6, 10, 3)
    network = random_network(widths, 40, seed=6)
    whole, _ = run(device, network, widths, method=method)
    pieces = np.zeros_like(whole)
    for begin, end in ((0, 1), (1, 18), (18, 40)):
        values, _ = run(device, network, widths, begin, end, method=method)
        assert not np.delete(values, np.s_[begin:end], axis=0).any()
        pieces[begin:end] = values[begin:end]
    np.testing.assert_array_equal(pieces.view(np.uint32), whole.view(np.uint32))


@pytest.mark.parametrize("method", ["decoupled", "full"])
def test_all_vector_widths_agree(one_device, method):
    network = random_network((2, 9, 18, 5), 3, seed=7)
    results = []
    widest = widest_vectors(one_device.cl_device)
    for vector_width, lanes in ((1, 1), (4, 1), (8, 1), (widest, 1), (1, 8), (1, GPU_LANES), (1, 64)):
        device = open_device(one_device.cl_device, one_device.index, vector_width, lanes)
        results.append(integrate(*network, method=method, device=device))
    np.testing.assert_allclose(results, np.broadcast_to(results[0], np.shape(results)), atol=2e-6)


def test_moments_are_the_integrals_of_the_last_neurons(device):
    network = random_network((2, 6, 7, 2), 2, seed=8)
    values, moments = integrate(*network, return_moments=True, device=device)
    combined = np.einsum("pcj,pj->pc", network[0][-1], moments) + network[1][-1]
    np.testing.assert_allclose(values, combined, rtol=1e-5, atol=1e-6)
    assert moments.shape == (2, 7) and (moments >= 0).all()


def test_a_gpu_keeps_small_arrangements_in_local_memory(one_device):
    device = open_device(one_device.cl_device, one_device.index, 1, GPU_LANES)
    assert Integrator(device, (2, 32, 32, 3)).workspace_is_local
    wide = Integrator(device, (2, 60, 8, 3))
    assert not wide.workspace_is_local
    network = random_network((2, 60, 8, 3), None, seed=9)
    assert worst_error(integrate(*network, device=device), network) <= LIMIT["float32"]


@pytest.mark.parametrize("lines", [0, 1, 2, 7])
def test_capacities_are_reached_but_not_exceeded(lines):
    vertices, half_edges, faces = 5, 5, 1
    for earlier in range(lines):
        crossed = earlier + 2
        vertices += crossed
        # Splitting gives 1 half-edge on the border, 2 inside; each chord between crossings gives 2.
        half_edges += 2 + 2 * earlier + 2 * (crossed - 1)
        faces += crossed - 1
    bound = Capacities.of(lines, 5)
    assert (bound.vertices, bound.half_edges, bound.faces) == (vertices, half_edges, faces)
    assert bound.triangles == half_edges - 2 * faces


def test_widest_network_fits(one_device):
    network = random_network((2, 128, 128, 2), None, seed=10)
    decoupled, statistics = integrate(*network, device=one_device, return_stats=True)
    full = integrate(*network, method="full", device=one_device)
    # Of sums of 128 terms little is left: they may be done again in double, but no arrangement fails.
    assert statistics.robust_points == statistics.condition and statistics.faces > 3000
    np.testing.assert_allclose(decoupled, full, rtol=1e-5, atol=1e-5)


def test_too_little_memory_is_an_error_before_launch(one_device):
    with pytest.raises(MemoryError, match="scratch_bytes"):
        Integrator(one_device, (2, 128, 128, 3), scratch_bytes=1 << 20)


GOOD = random_network((2, 4, 3), 2, seed=11)


@pytest.mark.parametrize(
    ("weights", "biases", "message"),
    [
        (GOOD[0][:1], GOOD[1], "as many weights as biases"),
        ([], [], "as many weights as biases"),
        ([GOOD[0][0][..., :1], GOOD[0][1]], GOOD[1], "layer 0 maps 2"),
        ([GOOD[0][0], GOOD[0][1][..., 1:]], GOOD[1], "layer 1 maps 4"),
        ([GOOD[0][0] * np.nan, GOOD[0][1]], GOOD[1], r"weights\[0\] holds NaN"),
        (GOOD[0], [GOOD[1][0], GOOD[1][1] * np.inf], r"biases\[1\] holds NaN or infinity"),
        ([GOOD[0][0][0, 0], GOOD[0][1]], GOOD[1], r"weights\[0\] must be"),
        ([GOOD[0][0][:1], GOOD[0][1]], GOOD[1], "points"),
        ([GOOD[0][0].astype(str), GOOD[0][1]], GOOD[1], "real numbers"),
        (*random_network((2, 129, 1)), "hidden widths"),
        (*random_network((2, 1, 1, 1, 1, 1, 1)), "at most 4 hidden layers"),
        ([a * np.float64(1e300) for a in GOOD[0]], GOOD[1], "as float32"),
    ],
)
def test_bad_networks_get_a_clear_error(one_device, weights, biases, message):
    with pytest.raises(ValueError, match=message):
        integrate(weights, biases, device=one_device)


@pytest.mark.parametrize(
    "option",
    [
        {"method": "exact"},
        {"precision": "float16"},
        {"activation": "tanh"},
        {"activation": "leaky_relu", "negative_slope": np.nan},
    ],
)
def test_bad_options_get_a_clear_error(one_device, option):
    with pytest.raises(ValueError, match=next(reversed(option))):
        integrate(*GOOD, device=one_device, **option)


def test_a_result_beyond_float32_is_an_error(one_device):
    weights = [np.full((1, 2), 1e30, np.float32), np.full((1, 1), 1e30, np.float32)]
    biases = [np.zeros(1, np.float32), np.zeros(1, np.float32)]
    with pytest.raises(FloatingPointError, match="no finite result"):
        integrate(weights, biases, device=one_device)
    exact, _ = exact_integral(weights, biases)
    value = integrate(weights, biases, precision="float64", device=one_device)
    assert value[0, 0] == pytest.approx(float(exact[0]), rel=1e-13)


def test_wrong_device_arrays_get_a_clear_error(one_device):
    with pytest.raises(ValueError, match=r"biases\[0\] must be float32 of shape \(3, 4\)"):
        integrator = Integrator(one_device, (2, 4, 1), per_point_biases=(True, False))
        shapes = ((4, 2), (1, 4), (2, 4), (1,), (3, 1))
        arrays = [HostArray(one_device, shape, np.float32) for shape in shapes]
        integrator.run(arrays[:2], arrays[2:4], arrays[4])


@pytest.mark.skipif(CLANG is None, reason="clang is not installed")
@pytest.mark.parametrize("precision", ["float32", "float64"])
@pytest.mark.parametrize("method", ["decoupled", "full"])
def test_clang_finds_nothing(one_device, method, precision):
    flags = "-x cl -cl-std=CL1.2 -Xclang -finclude-default-header -fsyntax-only -Wall -Wextra "
    flags += "-Wconversion -Wdouble-promotion -Werror"
    for widths in ((2, 3), (2, 5, 1), (2, 32, 32, 3), (2, 4, 4, 4, 2)):
        widest = widest_vectors(one_device.cl_device)
        for vector_width, lanes, slope in ((widest, 1, 0.0), (1, GPU_LANES, 0.1), (1, 1, 0.0)):
            device = open_device(one_device.cl_device, one_device.index, vector_width, lanes)
            integrator = Integrator(
                device,
                widths,
                method=method,
                precision=precision,
                negative_slope=slope,
                write_moments=len(widths) > 2,
            )
            for files, defines in integrator.programs():
                text = source(files).encode()
                command = [CLANG, *flags.split(), *option_list(defines)[1:], "-"]
                done = subprocess.run(command, input=text, capture_output=True, check=False)
                assert not done.returncode, f"{files} {defines}\n{done.stderr.decode()}"


OCLGRIND_SCRIPT = """
import sys
import numpy as np
from rational import random_network
from ncv_cl.integration import certificate
from ncv_cl.opencl.device import list_cl_devices, open_device
from ncv_cl.opencl.memory import HostArray
from test_integrate import run, worst_error

def fill(self, value):
    # The simulator takes what clEnqueueFillBuffer wrote for uninitialised.
    with self.mapped(write=True) as view:
        view[...] = value

HostArray.fill = fill
vector_width, lanes, method, tolerance = sys.argv[1:]
device = open_device(list_cl_devices()[0], 0, int(vector_width), int(lanes))
network = random_network((2, 5, 4, 2), 2, seed=12)
if tolerance != "default":
    certificate.excess_tolerance = lambda *_: float(tolerance)
values, _ = run(device, network, (2, 5, 4, 2), method=method)
assert worst_error(values, network) < 1e-6
"""


@pytest.mark.oclgrind
@pytest.mark.skipif(OCLGRIND is None, reason="oclgrind is not installed")
@pytest.mark.parametrize(("vector_width", "lanes"), [(8, 1), (1, GPU_LANES)])
@pytest.mark.parametrize(("method", "tolerance"), [("decoupled", "default"), ("full", "-1")])
def test_oclgrind_finds_nothing(tmp_path, vector_width, lanes, method, tolerance):
    log = tmp_path / "oclgrind.log"
    command = [OCLGRIND, "--log", log, "--data-races", "--uninitialized", "--local-mem-size", "49152"]
    # oclgrind 21.10 itself crashes on optimised code, see test_oclgrind.py; and, but for
    # --uninitialized not, on networks of 4x3 neurons.
    command += ["--build-options", "-cl-opt-disable"]
    arguments = [str(vector_width), str(lanes), method, tolerance]
    tests = Path(__file__).parent
    done = subprocess.run(
        [*command, sys.executable, "-c", OCLGRIND_SCRIPT, *arguments],
        env={"PYTHONPATH": f"{tests}:{tests.parent}", "PATH": "/usr/bin:/bin"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert log.read_text() == ""
