"""How much memory a device has: batches shrink to fit it, and what cannot fit is refused."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from test_pictures import SCENES, SMALL

import ncv_cl as ncv
from ncv_cl.opencl.limits import DeviceMemory, DeviceMemoryError
from ncv_cl.opencl.memory import HostArray
from ncv_cl.rendering import pipeline
from ncv_cl.sampling.paths import PathSource
from ncv_cl.sampling.samples import SampleSource
from ncv_cl.visibility.room import sample_bytes

MIB = 1 << 20


def small(device: ncv.Device, total: int, largest: int | None = None) -> ncv.Device:
    """The same device, as if it had so little memory, of its own."""
    return replace(device, memory=DeviceMemory(False, largest or total, total, "a small device"))


def test_arrays_are_counted_while_they_live(one_device):
    device = small(one_device, MIB)
    array = HostArray(device, (100, 3), np.float32)
    other = HostArray.of(device, np.zeros(10))
    assert device.memory.taken == 1200 + 80
    assert device.memory.left == MIB - 1280
    del array
    assert device.memory.taken == 80
    # Empty ones have a buffer of one element.
    other = HostArray(device, 0, np.uint8)
    assert device.memory.taken == 1 and other.shape == (0,)


def test_what_does_not_fit_says_how_much_is_asked_for_and_left(one_device):
    device = small(one_device, 4000, 3000)
    with pytest.raises(DeviceMemoryError, match=r"needs 3,004 bytes, the device allows 3,000 in one"):
        HostArray(device, 751, np.float32)
    kept = HostArray(device, 600, np.float32)
    with pytest.raises(MemoryError, match=r"needs 2,400 bytes, 1,600 of 4,000 are left.*smaller image"):
        HostArray(device, 600, np.float32)
    assert kept.device.memory.taken == 2400
    with pytest.raises(ncv.DeviceError):
        HostArray(device, 600, np.float32)


def test_memory_of_cycles_is_taken_back_before_an_array_is_refused(one_device):
    device = small(one_device, 4000)
    cycle = [HostArray(device, 600, np.float32)]
    cycle.append(cycle)
    del cycle
    assert HostArray(device, 600, np.float32).shape == (600,)


@pytest.mark.parametrize(
    ("integrand", "visibility", "mebibytes"),
    [("direct", "embree", 8), ("ao", "points", 8), ("gi", "auto", 48)],
)
def test_batches_shrink_to_fit_and_pictures_stay(
    one_device, monkeypatch, integrand, visibility, mebibytes
):
    """Of another size they give each point the same samples in the same order."""
    capacities = []
    init = SampleSource.__init__

    def noting(source: SampleSource, *arguments: object, **options: object) -> None:
        init(source, *arguments, **options)
        capacities.append(source._capacity)

    monkeypatch.setattr(SampleSource, "__init__", noting)
    options = SMALL | {"method": "mc", "visibility": visibility, "spp": 64}
    found = [
        ncv.render(SCENES / "occluders.toml", integrand, device=device, **options)
        for device in (one_device, small(one_device, mebibytes * MIB))
    ]
    assert capacities[-1] < capacities[0]
    assert np.array_equal(found[0].pixels, found[1].pixels)
    assert np.array_equal(found[0].variance, found[1].variance)


def test_samples_take_no_more_than_batches_are_made_for(one_device, monkeypatch):
    """Direct light beside guided paths that points share: nothing takes more."""
    taken = []
    init, draw = PathSource.__init__, PathSource.draw

    def begun(source: PathSource, *arguments: object, **options: object) -> None:
        source.before = source_device.memory.taken
        init(source, *arguments, **options)

    def drawn(source: PathSource, *arguments: object, **options: object) -> object:
        batch = draw(source, *arguments, **options)
        grown = source_device.memory.taken - source.before
        # Textures, records of triangles and what others have made since are no part of it.
        taken.append((grown - 16 * MIB) / source._capacity)
        return batch

    source_device = small(one_device, 8192 * MIB)
    monkeypatch.setattr(PathSource, "__init__", begun)
    monkeypatch.setattr(PathSource, "draw", drawn)
    options = {"size": (96, 96), "spp": 64, "train_spp": 1, "device": source_device, "time_limit": 0.01}
    ncv.render(SCENES / "interior.toml", "gi", "ncv", **options)
    assert 0.4 * sample_bytes(3, True) < max(taken) < sample_bytes(3, True)


@pytest.mark.parametrize(("method", "mebibytes"), [("mc", 2.75), ("ncv", 8)])
def test_a_render_that_cannot_fit_is_refused_before_it_samples(
    one_device, monkeypatch, method, mebibytes
):
    drawn = []
    monkeypatch.setattr(SampleSource, "_asked", lambda *_: drawn.append(True))
    monkeypatch.setattr(pipeline, "_learned", lambda *_: drawn.append(True))
    device = small(one_device, int(mebibytes * MIB))
    options = {"size": (128, 128), "spp": 64, "device": device, "visibility": "embree"}
    with pytest.raises(
        DeviceMemoryError,
        match=r"a small device: a render of [\d,]+ points.* needs [\d,]+ bytes, .*smaller",
    ):
        ncv.render(SCENES / "veach_plates.toml", "direct", method, **options)
    assert not drawn


def test_what_is_checked_is_what_a_render_takes(one_device, monkeypatch):
    """The arrays that grow with the points, in all, of a render with everything."""
    checked, before = [], []
    device = small(one_device, 8192 * MIB)
    check = pipeline.check_memory

    def noting(*arguments: object) -> None:
        before.append(device.memory.taken)
        with monkeypatch.context() as patch:
            patch.setattr(DeviceMemory, "check", lambda memory, size, what: checked.append((size, what)))
            check(*arguments)

    monkeypatch.setattr(pipeline, "check_memory", noting)
    most = []
    ask = SampleSource._asked

    def asking(source: SampleSource, *arguments: object) -> object:
        most.append(device.memory.taken)
        return ask(source, *arguments)

    monkeypatch.setattr(SampleSource, "_asked", asking)
    options = {"size": (128, 96), "spp": 64, "train_spp": 1, "device": device}
    ncv.render(SCENES / "cornell_box.toml", "direct", "ncv", **options)
    total, what = checked[-1]
    assert re.search(r"[\d,]+ points with a network", what)
    grown = max(most) - before[0]
    # Beside them there are the network's table and what training leaves.
    assert total < grown < 1.3 * total + 64 * MIB
