"""Renders where host and device share no memory, as on a discrete GPU.

The device says so of itself, so arrays are plain buffers, and what the host asks for is copied. On CPUs
a mapped array is the array itself: a kernel would see what the host writes after the block, and the host
what a kernel writes later. Here every view begins with rubbish or with what the device has, and is
rubbish again when the block is over.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pyopencl as cl
import pytest
from reference import RayRecorder, sampling, shadowed_values
from test_pictures import PICTURES, SCENES, SMALL

import ncv_cl as ncv
from ncv_cl.opencl.device import Device
from ncv_cl.opencl.kernel import Kernel
from ncv_cl.opencl.limits import DeviceMemory
from ncv_cl.opencl.memory import HostArray, Window
from ncv_cl.opencl.staging import copy_queue
from ncv_cl.sampling.accumulate import STATE

RUBBISH = 0xCD
_mapped = HostArray.mapped


def _spoil(view: np.ndarray) -> None:
    if view.size:
        view.reshape(-1).view(np.uint8)[...] = RUBBISH


@contextmanager
def _spoilt(array: HostArray, write: bool = False, **options: object) -> Iterator[np.ndarray]:
    """`HostArray.mapped` of a discrete device, which leaves rubbish where the host may not look."""
    update = options.get("update", False)
    assert not array.device.memory.shared
    with _mapped(array, write=write, **options) as own:
        assert own.flags.c_contiguous
        if write:
            _spoil(own)
        before = own.tobytes()
        yield own
        # What is written where only reading was announced would be lost.
        assert write or update or own.tobytes() == before
    for queue in (copy_queue(array.device), array.device.queue):
        queue.finish()
    _spoil(own)


@pytest.fixture(scope="module")
def discrete(one_device) -> Device:
    """The device as if its memory were its own."""
    memory = one_device.memory
    return replace(one_device, memory=DeviceMemory(False, memory.largest, memory.total, "discrete"))


@pytest.fixture()
def separate(monkeypatch, discrete) -> Device:
    """The same; views are rubbish before and after."""
    monkeypatch.setattr(HostArray, "mapped", _spoilt)
    return discrete


@pytest.fixture()
def in_place(one_device, monkeypatch):
    """Renders a picture where memory is shared, whatever `separate` does."""

    def render(*arguments: object, **options: object) -> ncv.Image:
        with monkeypatch.context() as patch:
            patch.setattr(HostArray, "mapped", _mapped)
            return ncv.render(*arguments, device=one_device, **options)

    return render


@pytest.mark.parametrize("name", list(PICTURES))
def test_pictures_need_no_shared_memory(separate, in_place, name):
    """The same bits, of the picture, its variance and its layers."""
    scene, integrand, options = PICTURES[name]
    path, settings = SCENES / f"{scene}.toml", SMALL | options
    shared = in_place(path, integrand, **settings)
    apart = ncv.render(path, integrand, device=separate, **settings)
    assert np.array_equal(shared.pixels, apart.pixels)
    assert np.array_equal(shared.variance, apart.variance)
    assert shared.layers.keys() == apart.layers.keys()
    for layer, values in shared.layers.items():
        assert np.array_equal(values, apart.layers[layer]), layer


def test_values_at_points_need_no_shared_memory(one_device, discrete, monkeypatch):
    scene = ncv.load_scene(SCENES / "cornell_box.toml")
    points = np.random.default_rng(1).uniform(100, 400, (64, 3))
    normals = np.tile([0.0, 1.0, 0.0], (64, 1))
    options = {"spp": 64, "integrand": "gi"}
    shared = ncv.irradiance(scene, points, normals, device=one_device, **options)
    monkeypatch.setattr(HostArray, "mapped", _spoilt)
    apart = ncv.irradiance(scene, points, normals, device=discrete, **options)
    assert np.array_equal(shared.values, apart.values)


def test_a_view_that_is_kept_is_noticed(separate):
    """What these tests would see."""
    array = HostArray.of(separate, np.arange(4, dtype=np.float32))
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


WINDOWS = [
    (range(3), range(39)),
    (range(2, 10), range(5, 40)),
    (range(9, 10), range(40)),
    (range(10), range(40)),
    (range(1, 4), range(38, 40)),
    (range(2), range(0)),
]


@pytest.mark.parametrize("streams", [False, True])
@pytest.mark.parametrize("is_discrete", [False, True])
@pytest.mark.parametrize(("rows", "columns"), WINDOWS)
def test_a_window_reads_and_writes_its_own_elements(
    one_device, discrete, is_discrete, streams, rows, columns
):
    device = discrete if is_discrete else one_device
    expected = np.arange(32 + 10 * 40, dtype=np.float32)
    array = HostArray(device, expected.shape, np.float32, streams)
    with array.mapped(write=True) as view:
        view[...] = expected
    window = Window(32, 40, rows, columns)
    part = expected[32:].reshape(10, 40)[rows.start : rows.stop, columns.start : columns.stop]
    assert np.array_equal(array.read(window=window), part)
    with array.mapped(write=True, window=window, after=cl.enqueue_marker(device.queue)) as view:
        view[...] = -part
    part *= -1
    assert np.array_equal(array.read(), expected)
    with array.mapped(update=True, window=window) as view:
        view += 1
    part += 1
    assert np.array_equal(array.read(), expected)


@pytest.mark.parametrize("integrand", [ncv.DirectLight(), ncv.AmbientOcclusion()], ids=["direct", "ao"])
def test_the_next_batch_is_computed_while_rays_are_answered(
    one_device, discrete, monkeypatch, integrand
):
    """It draws what one batch after the other does; copies of rays have a queue of their own."""
    scene = ncv.load_scene(SCENES / "occluders.toml")
    done, copies, call, copy = [], [], Kernel.__call__, cl.enqueue_copy
    visible = RayRecorder.visible

    def launched(kernel: Kernel, *items: object, **arguments: object) -> object:
        done.append(kernel.name)
        return call(kernel, *items, **arguments)

    def answered(tracer: RayRecorder, *arguments: object) -> None:
        done.append("answer")
        visible(tracer, *arguments)

    def copied(queue: cl.CommandQueue, *arguments: object, **options: object) -> cl.Event:
        copies.append(queue)
        return copy(queue, *arguments, **options)

    drawn = []
    for device in (one_device, discrete):
        points, source, _ = sampling(device, scene, integrand, (12, 9), 64)
        parts = [(range(a, min(a + 20, points.active)), range(64)) for a in range(0, points.active, 20)]
        with monkeypatch.context() as patch:
            patch.setattr(Kernel, "__call__", launched)
            patch.setattr(RayRecorder, "visible", answered)
            patch.setattr(cl, "enqueue_copy", copied)
            done.clear(), copies.clear()
            batches = source.drawn(parts, 0)
            drawn.append([shadowed_values(batch, integrand.channels) for batch in batches])
    for alone, overlapped in zip(*drawn, strict=True):
        assert np.array_equal(alone, overlapped)
    number = len(parts)
    assert number > 3
    assert done == ["draw_samples"] + ["draw_samples", "answer"] * (number - 1) + ["answer"]
    # Count, origins, directions, distances and answers; all else is the test's own.
    assert copies.count(copy_queue(discrete)) >= 4 * number


@pytest.mark.parametrize("method", ["mc", "ncv"])
@pytest.mark.parametrize(("scene", "integrand"), [("cornell_box", "direct"), ("occluders", "ao")])
def test_passes_by_lines_move_nothing_but_statistics(discrete, monkeypatch, scene, integrand, method):
    """Bytes between host and device that four times as many samples add."""
    copy, sizes = cl.enqueue_copy, []

    def noted(queue: cl.CommandQueue, to: object, of: object, **options: object) -> cl.Event:
        sizes.append((to if isinstance(to, np.ndarray) else of).nbytes)
        return copy(queue, to, of, **options)

    monkeypatch.setattr(cl, "enqueue_copy", noted)
    totals = []
    for spp in (256, 1024):
        sizes.clear()
        image = ncv.render(
            SCENES / f"{scene}.toml", integrand, method, device=discrete, size=(12, 8), spp=spp,
            seed=1, visibility="lines", rays="device", **({"train_spp": 8} if method == "ncv" else {}),
        )  # fmt: skip
        totals.append(sum(sizes))
    points, quantities = image.stats["points"], 1 + (method == "ncv")
    channels = 3 if integrand == "direct" else 1
    sums = 4 * points * quantities * channels * STATE.size
    # Means of two estimates are compared after one, two, four and eight passes.
    assert totals[1] - totals[0] <= 4 * sums + 1024
    assert (totals[1] - totals[0]) / (768 * points) < 0.2
