"""Programs: arguments from signatures, retained kernels, and errors that name the right place."""

from __future__ import annotations

import numpy as np
import pytest

from ncv_cl.opencl import program
from ncv_cl.opencl.device import GROUP_SIZE, HostArray
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
    kernel(count, -7, count, 3 << 32, 0.5, result)
    # Global sizes are rounded up to whole groups; the kernel guards its tail.
    expected = np.full(3 * GROUP_SIZE, -1.0)
    expected[:count] = np.arange(count) - 3.5
    np.testing.assert_array_equal(result.read(), expected)


def test_no_work_items_enqueue_nothing(one_device, folder):
    (folder / "none.cl").write_text(SCALARS)
    result = HostArray.of(one_device, np.zeros(1, np.float32))
    assert build(one_device, ("none",)).kernel("scalars")(0, 1, 1, 1, 1.0, result) is None


def test_a_wrong_number_of_arguments_names_the_expected_ones(device):
    kernel = build(device, SAMPLER, sampler_defines("sobol")).kernel("square_samples")
    with pytest.raises(TypeError, match=r"square_samples takes \(first_point, .*, u, v\), got 2 arg"):
        kernel(64, 1, 2)


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
