"""Devices and the memory that host and device share."""

from __future__ import annotations

from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pyopencl as cl
import pytest

from ncv_cl.opencl.device import GPU_LANES, DeviceError, default_widths, open_device, widest_vectors
from ncv_cl.opencl.memory import HostArray


@pytest.mark.parametrize(
    "array",
    [
        np.arange(7, dtype=np.float32),
        np.arange(30, dtype=np.uint32).reshape(2, 3, 5),
        np.array([[1, 255]], np.uint8),
        np.array([2**63], np.uint64),
        np.arange(6.0).reshape(2, 3).T,
        np.float32(3.5),
    ],
    ids=["float32", "three axes", "uint8", "uint64", "transposed", "scalar"],
)
def test_what_is_stored_is_read(device, array):
    shared = HostArray.of(device, array)
    result = shared.read()
    assert (result.dtype, result.shape) == (np.asarray(array).dtype, np.shape(array))
    np.testing.assert_array_equal(result, array)
    result[...] = 0
    np.testing.assert_array_equal(shared.read(), array)


@pytest.mark.parametrize("count", [0, 1, 5])
def test_only_the_first_rows_are_mapped(device, count):
    shared = HostArray.of(device, np.arange(15, dtype=np.float32).reshape(5, 3))
    assert shared.read(count).shape == (count, 3)
    with shared.mapped(write=True, count=count) as view:
        view[...] = -1
    expected = np.arange(15.0).reshape(5, 3)
    expected[:count] = -1
    np.testing.assert_array_equal(shared.read(), expected)


def test_cpu_devices_share_one_address_with_the_host(device):
    if not device.is_cpu:
        pytest.skip("memory is shared on CPU devices only")
    shared = HostArray.of(device, np.arange(1000, dtype=np.float32))
    addresses = set()
    for write in (False, True, False):
        with shared.mapped(write=write) as view:
            addresses.add(view.__array_interface__["data"][0])
            view[0] = 7
    assert len(addresses) == 1
    # What the device does to the buffer appears at that address without a copy.
    shared.fill(9.0)
    with shared.mapped() as view:
        assert view.__array_interface__["data"][0] in addresses
        assert (view == 9).all()


def test_a_view_is_released_when_the_block_fails(device):
    shared = HostArray.of(device, np.zeros(4, np.float32))
    with pytest.raises(KeyError), shared.mapped(write=True) as view:
        view[...] = 5
        raise KeyError
    shared.fill(2.0)
    np.testing.assert_array_equal(shared.read(), np.full(4, 2.0))


@pytest.mark.parametrize("shape", [0, (0,), (3, 0), (0, 4)])
def test_empty_arrays_work(device, shape):
    shared = HostArray(device, shape, np.float32)
    shared.fill(1.0)
    assert shared.read().size == 0
    assert shared.read().shape == ((shape,) if isinstance(shape, int) else shape)
    assert HostArray.of(device, shared.read()).read().size == 0


@pytest.mark.parametrize(
    ("dtype", "value"), [(np.float32, -1.5), (np.uint32, 2**32 - 1), (np.uint8, 200)]
)
def test_fill_sets_every_element(device, dtype, value):
    shared = HostArray(device, (5, 7), dtype)
    shared.fill(value)
    np.testing.assert_array_equal(shared.read(), np.full((5, 7), value, dtype))


def test_descriptions_name_the_device_and_its_widths(device):
    line = device.describe()
    for part in (f"[{device.index}]", device.name, device.platform_version, "compute units"):
        assert part in line
    assert f"VEC {device.vector_width}, LANES {device.lanes}" in line
    assert "\n" not in line and "\n" not in device.identity
    assert device.name in device.identity


@pytest.mark.parametrize(
    ("kind", "native", "compiled_for", "expected"),
    [
        (cl.device_type.CPU, 16, "skylake-avx512", (16, 1)),
        (cl.device_type.CPU, 16, "znver4", (16, 1)),
        (cl.device_type.CPU, 16, "znver3", (8, 1)),
        (cl.device_type.CPU, 16, "generic", (8, 1)),
        (cl.device_type.CPU, 8, "haswell", (8, 1)),
        (cl.device_type.CPU, 4, "x86-64", (4, 1)),
        (cl.device_type.CPU, 1, "", (4, 1)),
        (cl.device_type.GPU, 1, "", (1, GPU_LANES)),
    ],
)
def test_widths_follow_the_kind_of_device(kind, native, compiled_for, expected):
    version = f"OpenCL 3.0 PoCL HSTR: pthread-x86_64-unknown-linux-gnu-{compiled_for} "
    cl_device = SimpleNamespace(type=kind, native_vector_width_float=native, version=version)
    assert default_widths(cl_device) == expected


@pytest.mark.parametrize(
    ("told", "lanes"),
    [
        ({"warp_size_nv": 32, "preferred_work_group_size_multiple": 64}, 32),
        ({"wavefront_width_amd": 64}, 64),
        ({"preferred_work_group_size_multiple": 16}, 16),
        ({"preferred_work_group_size_multiple": 1}, GPU_LANES),
    ],
)
def test_lanes_of_a_gpu_are_the_work_items_that_run_in_step(told, lanes):
    cl_device = SimpleNamespace(type=cl.device_type.GPU, native_vector_width_float=1, **told)
    assert default_widths(cl_device) == (1, lanes)


@pytest.mark.parametrize(("native", "widest"), [(16, (8, 4)), (8, (16, 16))])
def test_only_what_contradicts_itself_is_held_back(native, widest):
    version = "OpenCL 3.0 PoCL HSTR: pthread-x86_64-unknown-linux-gnu-znver3"
    cl_device = SimpleNamespace(native_vector_width_float=native, version=version)
    assert (widest_vectors(cl_device), widest_vectors(cl_device, 8)) == widest


def test_vectors_that_would_abort_the_compiler_are_refused():
    version = "OpenCL 3.0 PoCL HSTR: pthread-x86_64-unknown-linux-gnu-znver3"
    cl_device = Mock(version=version, native_vector_width_float=16)
    cl_device.name = "pthread-AMD EPYC"
    with pytest.raises(
        DeviceError, match=r"pthread-AMD EPYC .* vectors of 16 floats; ask for at most 8"
    ):
        open_device(cl_device, vector_width=16)


def test_opening_twice_gives_the_same_device_and_context(one_device):
    cl_device = one_device.cl_device
    first, shaped = open_device(cl_device), open_device(cl_device, vector_width=1, lanes=32)
    assert open_device(cl_device) is first and shaped is not first
    assert (shaped.vector_width, shaped.lanes) == (1, 32)
    assert shaped.context == first.context
