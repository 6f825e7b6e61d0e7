"""Renders where host and device share no memory, as on a discrete GPU.

On CPUs a mapped array is the array itself, so a kernel would see what the host writes after the block,
and the host what a kernel writes later. Here every mapped block works on a copy of its own: it begins
with rubbish or with what the device has, goes back if it may have been changed, and is rubbish again
when the block is over.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pyopencl as cl
import pytest
from test_pictures import PICTURES, SCENES, SMALL

import ncv_cl as ncv
from ncv_cl.opencl.memory import HostArray

RUBBISH = 0xCD


@contextmanager
def _copied(
    array: HostArray, write: bool = False, count: int | None = None, update: bool = False
) -> Iterator[np.ndarray]:
    """`HostArray.mapped` by copies."""
    shape = array.shape if count is None else (count, *array.shape[1:])
    own = np.empty(shape, array.dtype)
    own.reshape(-1).view(np.uint8)[...] = RUBBISH
    if own.size and not write:
        cl.enqueue_copy(array.device.queue, own, array.buffer)
    before = own.tobytes()
    try:
        yield own
        # What is written where only reading was announced would be lost.
        assert write or update or own.tobytes() == before
    finally:
        if own.size and (write or update):
            cl.enqueue_copy(array.device.queue, array.buffer, own)
        own.reshape(-1).view(np.uint8)[...] = RUBBISH


@pytest.fixture()
def separate(monkeypatch):
    """From now on arrays are copied whenever they are mapped."""

    def begin() -> None:
        monkeypatch.setattr(HostArray, "mapped", _copied)

    return begin


@pytest.mark.parametrize("name", list(PICTURES))
def test_pictures_need_no_shared_memory(one_device, separate, name):
    """The same bits, of the picture, its variance and its layers."""
    scene, integrand, options = PICTURES[name]
    path, settings = SCENES / f"{scene}.toml", SMALL | options
    shared = ncv.render(path, integrand, device=one_device, **settings)
    separate()
    apart = ncv.render(path, integrand, device=one_device, **settings)
    assert np.array_equal(shared.pixels, apart.pixels)
    assert np.array_equal(shared.variance, apart.variance)
    assert shared.layers.keys() == apart.layers.keys()
    for layer, values in shared.layers.items():
        assert np.array_equal(values, apart.layers[layer]), layer


def test_values_at_points_need_no_shared_memory(one_device, separate):
    scene = ncv.load_scene(SCENES / "cornell_box.toml")
    points = np.random.default_rng(1).uniform(100, 400, (64, 3))
    normals = np.tile([0.0, 1.0, 0.0], (64, 1))
    options = {"spp": 64, "device": one_device}
    shared = ncv.irradiance(scene, points, normals, integrand="gi", **options)
    separate()
    apart = ncv.irradiance(scene, points, normals, integrand="gi", **options)
    assert np.array_equal(shared.values, apart.values)


def test_a_view_that_is_kept_is_noticed(one_device, separate):
    """What these tests would see."""
    array = HostArray.of(one_device, np.arange(4, dtype=np.float32))
    separate()
    with array.mapped() as view:
        kept = view[1:]
        assert kept.tolist() == [1, 2, 3]
    assert kept.tolist() != [1, 2, 3]
    with pytest.raises(AssertionError), array.mapped() as view:
        view[0] = 1
    with array.mapped(write=True) as view:
        assert view.tolist() != [0, 1, 2, 3]
        view[...] = 5
    view[...] = 7
    assert array.read().tolist() == [5, 5, 5, 5]
