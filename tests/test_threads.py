"""Renders in several threads at once: each gives the bits that it gives alone."""

from __future__ import annotations

import sys
from concurrent.futures import ThreadPoolExecutor
from threading import Barrier

import numpy as np
import pytest

from ncv_cl import choose_device, estimate, integrate, render
from ncv_cl.opencl import device as device_module
from ncv_cl.opencl import program
from ncv_cl.opencl.device import open_device
from ncv_cl.opencl.memory import HostArray

# Scenes, integrands and methods that share kernels with another of them, and that do not.
JOBS = (
    ("cornell_box", "direct", "ncv", {}),
    ("cornell_box", "direct", "mc", {"allocation": "pilot"}),
    ("occluders", "ao", "ncv", {"density": "subdivision"}),
    ("interior", "gi", "ncv", {}),
    ("cornell_box", "direct", "ncv", {"preset": "slides", "sampler": "independent"}),
    ("plane_light", "direct", "ncv", {"visibility": "embree"}),
)


@pytest.fixture(autouse=True)
def switching():
    """Threads take turns as often as they can."""
    usual = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    yield
    sys.setswitchinterval(usual)


def all_at_once(calls):
    """What each returns, begun together."""
    start = Barrier(len(calls))

    def run(call):
        start.wait()
        return call()

    with ThreadPoolExecutor(len(calls)) as pool:
        return [future.result() for future in [pool.submit(run, call) for call in calls]]


def assert_same_bits(first, second):
    for name, values in {"pixels": first.pixels, "variance": first.variance, **first.layers}.items():
        other = {"pixels": second.pixels, "variance": second.variance, **second.layers}[name]
        np.testing.assert_array_equal(values, other, err_msg=name)


@pytest.mark.slow
def test_renders_at_once_give_the_bits_of_renders_alone(one_device, scenes):
    def job(scene, integrand, method, options):
        return lambda: render(
            scenes / f"{scene}.toml", integrand, method, spp=32, size=(24, 16), seed=11,
            device=one_device, **({"train_spp": 16} if method == "ncv" else {}), **options,
        )  # fmt: skip

    calls = [job(*one) for one in JOBS]
    # First at once, when nothing is compiled in this process yet.
    together = [image for _ in range(2) for image in all_at_once(calls)]
    alone = [call() for call in calls]
    for image, expected in zip(together, [*alone, *alone], strict=True):
        assert_same_bits(image, expected)


def test_one_render_in_many_threads_gives_the_same_bits(device, scenes):
    def job():
        return render(
            scenes / "cornell_box.toml", "direct", "ncv", spp=16, train_spp=8, size=(16, 12),
            seed=2, device=device,
        )  # fmt: skip

    alone = job()
    for image in all_at_once([job] * 4):
        assert_same_bits(image, alone)


def test_integrals_and_estimates_at_once_are_those_alone(one_device):
    generator = np.random.default_rng(1)
    nets = [
        (
            [generator.normal(size=(width, 2)), generator.normal(size=(1, width))],
            [generator.normal(size=width), generator.normal(size=1)],
        )
        for width in (4, 8, 16)
    ]
    calls = [
        lambda net=net, method=method: integrate(*net, method=method, device=one_device)
        for net in nets
        for method in ("decoupled", "full")
    ]
    radii = np.linspace(0.1, 0.5, 100)
    calls += [
        lambda seed=seed: estimate(
            lambda u, v, point: np.hypot(u - 0.5, v - 0.5) < radii[point],
            points=100, features=radii[:, None], spp=16, train_spp=16, seed=seed, device=one_device,
        ).mean
        for seed in (1, 2)
    ]  # fmt: skip
    alone = [call() for call in calls]
    for _ in range(3):
        for found, expected in zip(all_at_once(calls), alone, strict=True):
            np.testing.assert_array_equal(found, expected)


def test_a_kernel_keeps_the_arguments_of_one_thread_from_those_of_others(one_device, monkeypatch):
    text = "kernel void put(global int *where, int what) { where[get_global_id(0)] = what; }"
    monkeypatch.setattr(program, "source", lambda files: text)
    shared = program.Program(one_device, (), {})

    def puts(what):
        where = HostArray(one_device, 64, np.int32)
        wrong = 0
        for _ in range(500):
            where.fill(-1)
            shared.kernel("put")(64, where=where, what=what)
            wrong += not (where.read() == what).all()
        return wrong

    assert all_at_once([lambda what=what: puts(what) for what in range(8)]) == [0] * 8


def test_a_device_is_opened_once_whoever_asks(one_device, monkeypatch):
    made = []
    real = device_module.cl.Context
    monkeypatch.setattr(
        device_module.cl, "Context", lambda devices: made.append(devices) or real(devices)
    )
    # Anew: what was opened before is kept.
    opened = device_module.once(open_device.__wrapped__)
    monkeypatch.setattr(
        device_module, "_context", device_module.once(device_module._context.__wrapped__)
    )
    found = all_at_once([lambda: opened(one_device.cl_device, 0)] * 8)
    assert len(set(map(id, found))) == 1 and len(made) == 1
    chosen = all_at_once([lambda: choose_device(one_device.index)] * 8)
    assert len(set(map(id, chosen))) == 1
