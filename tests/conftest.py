"""Fixtures: every OpenCL device present, and the first CPU in the shape of a GPU."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from hypothesis import settings

from ncv_cl.opencl.choose import all_devices, choose_device
from ncv_cl.opencl.device import GPU_LANES, Device, open_device

# Property tests draw the same examples everywhere; `pytest --hypothesis-profile explore` looks further.
settings.register_profile("repeatable", max_examples=50, derandomize=True, database=None)
settings.register_profile("explore", max_examples=2000, derandomize=False, print_blob=True)
settings.load_profile("repeatable")

SCENES = Path(__file__).parent.parent / "scenes"


def _devices() -> dict[str, Device]:
    """By name for pytest; NCV_CL_DEVICE or PYOPENCL_TEST narrows the list to one."""
    wanted = os.environ.get("NCV_CL_DEVICE") or os.environ.get("PYOPENCL_TEST")
    devices = [choose_device(wanted)] if wanted else all_devices()
    named = {f"device{device.index}": device for device in devices}
    for device in devices:
        if device.is_cpu:
            # Not a GPU, but the code path of one: scalar work-items that cooperate on a point.
            named["gpu-shape"] = open_device(
                device.cl_device, device.index, vector_width=1, lanes=GPU_LANES
            )
            break
    return named


_NAMED = _devices()


@pytest.fixture(params=list(_NAMED), scope="session")
def device(request: pytest.FixtureRequest) -> Device:
    """Each device in turn, and the GPU shape."""
    return _NAMED[request.param]


@pytest.fixture(scope="session")
def one_device() -> Device:
    """Some device, for tests whose subject is not the kernel."""
    return next(iter(_NAMED.values()))


@pytest.fixture(scope="session")
def gpu_shape() -> Device:
    """A device in the shape of a GPU: one, or the first CPU in its place."""
    return _NAMED.get("gpu-shape", next(iter(_NAMED.values())))


@pytest.fixture(scope="session")
def scenes() -> Path:
    """The folder of the shipped scenes."""
    return SCENES


@pytest.fixture
def scalar():
    """Mitsuba in its scalar variant; others' is restored."""
    mitsuba = pytest.importorskip("mitsuba", reason="mitsuba is not installed")
    variant = mitsuba.variant()
    mitsuba.set_variant("scalar_rgb")
    yield mitsuba
    if variant:
        mitsuba.set_variant(variant)
