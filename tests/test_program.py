"""Programs: arguments from signatures, retained kernels, and errors that name the right place."""

from __future__ import annotations

import re

import numpy as np
import pytest

from ncv_cl.opencl import program
from ncv_cl.opencl.device import GROUP_SIZE
from ncv_cl.opencl.memory import HostArray
from ncv_cl.opencl.program import build, device_defines, kernel_folder, option_list, source
from ncv_cl.points.sampler import sampler_defines

SAMPLER = ("common", "sampler")
SCALARS = """
kernel void scalars(const int i, const uint n, const ulong big, const float x, global float *result) {
  if (get_global_id(0) >= n) return;
  result[get_global_id(0)] = (float)i + x + (float)(big >> 32) + (float)get_global_id(0);
}
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder that stands for cl/, with no source retained from before or for after."""
    monkeypatch.setattr(program, "kernel_folder", lambda: tmp_path)
    program.source.cache_clear()
    yield tmp_path
    program.source.cache_clear()


@pytest.mark.parametrize("count", [1, GROUP_SIZE, 2 * GROUP_SIZE + 3])
def test_scalars_and_host_arrays_pass_as_the_signature_says(device, folder, count):
    (folder / f"scalars{count}.cl").write_text(SCALARS)
    kernel = build(device, (f"scalars{count}",)).kernel("scalars")
    result = HostArray.of(device, np.full(3 * GROUP_SIZE, -1, np.float32))
    kernel(count, i=-7, n=count, big=3 << 32, x=0.5, result=result)
    # Global sizes are rounded up to whole groups; the kernel guards its tail.
    expected = np.full(3 * GROUP_SIZE, -1.0)
    expected[:count] = np.arange(count) - 3.5
    np.testing.assert_array_equal(result.read(), expected)


def test_no_work_items_enqueue_nothing(one_device, folder):
    (folder / "none.cl").write_text(SCALARS)
    result = HostArray.of(one_device, np.zeros(1, np.float32))
    kernel = build(one_device, ("none",)).kernel("scalars")
    assert kernel(0, i=1, n=1, big=1, x=1.0, result=result) is None


@pytest.fixture
def scalars(device, folder):
    """A kernel, and arguments that suit it."""
    (folder / "checked.cl").write_text(SCALARS)
    result = HostArray.of(device, np.zeros(GROUP_SIZE, np.float32))
    good = {"i": 1, "n": 3, "big": 1 << 32, "x": 0.5, "result": result}
    return build(device, ("checked",)).own_kernel("scalars"), good


ALL = "its arguments are i, n, big, x, result"


@pytest.mark.parametrize(
    ("wrong", "missing", "message"),
    [
        ({}, ["n"], f"scalars: missing n; {ALL}"),
        ({}, ["i", "result"], f"scalars: missing i, result; {ALL}"),
        ({"m": 3}, [], f"scalars: unknown m; {ALL}"),
        ({"m": 3}, ["n"], f"scalars: missing n and unknown m; {ALL}"),
        ({"work_items": 3}, [], f"scalars: unknown work_items; {ALL}"),
        ({"n": 1.5}, [], "scalars: argument n is uint, got float 1.5"),
        ({"n": "3"}, [], "scalars: argument n is uint, got str '3'"),
        ({"x": None}, [], "scalars: argument x is float, got NoneType None"),
        ({"x": np.zeros(3)}, [], "scalars: argument x is float, got ndarray"),
        ({"result": 0.5}, [], "scalars: argument result is float*, got float 0.5"),
        ({"result": np.zeros(3)}, [], "scalars: argument result is float*, got ndarray"),
    ],
)
@pytest.mark.parametrize("how", ["called", "bound"])
def test_arguments_are_checked_by_name_and_type(scalars, wrong, missing, message, how):
    kernel, good = scalars
    given = {name: value for name, value in (good | wrong).items() if name not in missing}
    with pytest.raises(TypeError, match=f"^{re.escape(message)}$"):
        kernel(3, **given) if how == "called" else kernel.bind(**given)


def test_an_array_goes_to_pointers_of_its_type_only(scalars):
    kernel, good = scalars
    wrong = HostArray.of(kernel.device, np.zeros((2, 3), np.uint32))
    message = r"argument result is float\*, got a HostArray of uint32, shape \(2, 3\)$"
    with pytest.raises(TypeError, match=message):
        kernel(3, **good | {"result": wrong})
    with pytest.raises(TypeError, match="argument n is uint, got a HostArray of uint32"):
        kernel(3, **good | {"n": wrong})


def test_numbers_of_numpy_and_plain_buffers_pass(scalars):
    kernel, good = scalars
    result = good["result"]
    alike = {"n": np.uint16(3), "big": np.uint64(1 << 32), "x": np.float64(0.5), "i": np.int8(1)}
    for same in ({}, alike, {"x": 1, "i": True}, {"result": result.buffer}):
        result.fill(0.0)
        kernel(3, **good | same)
        x = (good | same)["x"]
        np.testing.assert_array_equal(result.read(3), x + np.array([2, 3, 4]))


def test_what_a_pointer_points_at_is_read_from_its_type(device, folder):
    text = "typedef struct { float x; } Own;\n"
    text += "kernel void kinds(global Own *own, global const float4 *wide, constant uchar *bytes) {}"
    (folder / "kinds.cl").write_text(text)
    kernel = build(device, ("kinds",)).kernel("kinds")
    floats, chars = (HostArray.of(device, np.zeros(4, dtype)) for dtype in (np.float32, np.uint8))
    # What the program itself defines may be any memory.
    for own in (floats, chars, floats.buffer):
        kernel(1, own=own, wide=floats, bytes=chars)
    with pytest.raises(TypeError, match="wide is float4"):
        kernel(1, own=floats, wide=chars, bytes=chars)
    with pytest.raises(TypeError, match="bytes is uchar"):
        kernel(1, own=floats, wide=floats, bytes=floats)


def test_an_argument_called_as_the_calls_own_is_refused(device, folder):
    (folder / "clash.cl").write_text("kernel void clash(const uint group) { (void)group; }")
    with pytest.raises(TypeError, match="clash: an argument cannot be called group"):
        build(device, ("clash",)).kernel("clash")
    # This one is no name of the call's.
    (folder / "free.cl").write_text(
        "kernel void free(const uint work_items, global uint *result) { result[0] = work_items; }"
    )
    result = HostArray.of(device, np.zeros(1, np.uint32))
    build(device, ("free",)).kernel("free")(1, work_items=7, result=result)
    assert result.read().tolist() == [7]


def test_what_is_bound_is_what_a_call_passes(scalars):
    kernel, good = scalars
    kernel(3, **good)
    called = good["result"].read()
    good["result"].fill(0.0)
    kernel.bind(**good)
    kernel.repeat(0, 3)
    np.testing.assert_array_equal(good["result"].read(), called)
    assert called.any()


@pytest.mark.parametrize("broken", ["first", "second"])
def test_a_build_error_names_the_file_and_line(device, folder, broken, capfd):
    for name in ("first", "second"):
        text = "/* one\n * two\n */\nkernel void NAME(void) {}\n".replace("NAME", name)
        if name == broken:
            text += "undeclared_type oops;\n"
        (folder / f"{name}.cl").write_text(text)
    with pytest.raises(RuntimeError, match=r"building first \+ second failed on .*'VEC'") as caught:
        build(device, ("first", "second"), {f"FOR_{broken.upper()}": 1})
    program.source.cache_clear()
    # PoCL 3.0 prints some of the compiler's words instead of returning them.
    assert f"{broken}.cl:5:" in str(caught.value) + "".join(capfd.readouterr())


def test_programs_and_kernels_are_retained(device):
    first = build(device, SAMPLER, sampler_defines("sobol"))
    assert build(device, SAMPLER, dict(reversed(sampler_defines("sobol").items()))) is first
    assert first.kernel("square_samples") is first.kernel("square_samples")
    assert build(device, SAMPLER, sampler_defines("independent")) is not first


def test_every_define_and_the_devices_own_reach_the_compiler(device):
    built = build(device, SAMPLER, sampler_defines("sobol"))
    assert built.defines == {**device_defines(device), **sampler_defines("sobol")}
    options = option_list({"B": 2, "A": "1.5f"})
    assert options == ["-cl-std=CL1.2", "-DA=1.5f", "-DB=2"]


def test_sources_are_joined_under_their_names():
    text = source(SAMPLER)
    assert text.startswith('#line 1 "common.cl"\n')
    assert text.count("#line") == 2 and '\n#line 1 "sampler.cl"\n' in text
    assert "#include" not in text


def test_every_kernel_file_opens_with_a_prose_block():
    files = sorted(kernel_folder().glob("*/*.cl"))
    assert files
    for file in files:
        text = file.read_text()
        assert text.startswith("/* "), file.name
        assert "Work-group contract" in text.split("*/")[0], file.name
