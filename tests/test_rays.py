"""Option `rays`: pictures whose rays kernels trace beside embree's, and how often the host waits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pyopencl as cl
import pytest
from mesh_files import write_image
from reference import sampling, shadowed_values

import ncv_cl as ncv
from ncv_cl.estimation.image_estimate import ImageEstimate
from ncv_cl.estimation.passes import Passes
from ncv_cl.integrands import AmbientOcclusion, DirectLight, GlobalIllumination
from ncv_cl.opencl.device import Device
from ncv_cl.opencl.limits import DeviceMemory
from ncv_cl.rendering import prepare
from ncv_cl.sampling import paths, samples
from ncv_cl.sampling.waves import embree, wave
from ncv_cl.sampling.waves.wave import knows_counts
from ncv_cl.sampling.waves.waves import Waves
from ncv_cl.scene.load import load_scene
from ncv_cl.visibility.trace import DeviceTracer

SMALL = {"size": (24, 16), "spp": 64, "seed": 3, "visibility": "points"}
SCENES = {"direct": "interior", "ao": "knot", "gi": "interior"}


@pytest.fixture()
def without_lists(monkeypatch):
    """No occluder is listed: every shadow ray to a light is traced."""
    monkeypatch.setattr(prepare, "shafts_pay", lambda scene: False)


def rendered(device, scenes, integrand, rays, **options):
    scene = scenes / f"{SCENES[integrand]}.toml"
    return ncv.render(scene, integrand, device=device, rays=rays, **{"method": "mc", **SMALL, **options})


@pytest.mark.parametrize("integrand", SCENES)
def test_pictures_are_embrees_but_for_grazing_rays(device, scenes, without_lists, integrand):
    ours, again = (rendered(device, scenes, integrand, "device") for _ in range(2))
    theirs = rendered(device, scenes, integrand, "embree")
    np.testing.assert_array_equal(ours.pixels, again.pixels)
    # Where a path goes on follows from where its ray met, in all digits.
    if integrand != "gi":
        assert np.mean(ours.pixels == theirs.pixels) > 0.99
    alike = np.isclose(ours.pixels, theirs.pixels, rtol=1e-4, atol=1e-6 * theirs.pixels.mean())
    assert np.mean(alike) > 0.95
    for name in ("rays_traced", "rays_on_device", "rays_skipped", "samples_off_lines"):
        assert ours.stats[name] == pytest.approx(theirs.stats[name], rel=1e-3)
    assert ours.stats["rays_traced"] > 10_000
    assert ours.stats["seconds"]["trace"] == 0 < theirs.stats["seconds"]["trace"]


@pytest.mark.parametrize("method", ["mc", pytest.param("ncv", marks=pytest.mark.slow)])
@pytest.mark.parametrize("integrand", SCENES)
def test_pictures_agree_with_embrees_of_another_seed(device, scenes, without_lists, integrand, method):
    options = {"method": method} | ({"spp": 256} if method == "mc" else {"train_spp": 4})
    ours = rendered(device, scenes, integrand, "device", **options)
    theirs = rendered(device, scenes, integrand, "embree", **options | {"seed": 4})
    assert ours.stats["method"] == method
    difference = (ours.pixels - theirs.pixels).astype(np.float64)
    variance = (ours.variance + theirs.variance).astype(np.float64)
    # Points are independent, so the mean's variance is the sum of theirs; channels are not.
    whole = difference.sum(axis=(0, 1)) / np.sqrt(variance.sum(axis=(0, 1)))
    assert np.abs(whole).max() < 4
    known = variance > 1e-12 * theirs.pixels.mean() ** 2
    scores = np.abs(difference[known]) / np.sqrt(variance[known])
    assert np.quantile(scores, 0.9) < 4


@pytest.mark.parametrize(
    "integrand", [DirectLight(), AmbientOcclusion(), GlobalIllumination(4)], ids=lambda one: one.name
)
def test_samples_are_embrees(device, scenes, integrand):
    scene = load_scene(scenes / "interior.toml")
    found, counts = [], []
    for on_device in (False, True):
        points, source, _ = sampling(device, scene, integrand, (12, 9), 64, on_device=on_device)
        waits = integrand.nested and knows_counts(device)
        assert source.runs_ahead == (on_device and not waits)
        batch = source.draw(range(points.active), range(64), 0)
        found.append(shadowed_values(batch, integrand.channels))
        counts.append((source.rays.traced, source.rays.skipped, source.rays.on_device))
    assert np.mean(np.isclose(*found, rtol=1e-3, atol=1e-7)) > (0.99 if integrand.nested else 0.9999)
    np.testing.assert_allclose(*counts, rtol=1e-3)
    assert counts[1][0] > 1000


class Waits:
    """Calls after which the host has waited for the device, by kind."""

    def __init__(self) -> None:
        self.calls: list[str] = []

    def counting(self, name, function, blocks=lambda given: True):
        def call(*arguments, **given):
            if blocks(given):
                self.calls.append(name)
            return function(*arguments, **given)

        return call


@pytest.fixture()
def waits(monkeypatch):
    """Counts every way to wait that the package uses, from now on."""
    found = Waits()
    for owner, name, *blocks in (
        (cl.CommandQueue, "finish"),
        (cl, "enqueue_map_buffer"),
        (cl, "enqueue_copy", lambda given: given.get("is_blocking", True)),
        (cl, "wait_for_events"),
    ):
        monkeypatch.setattr(owner, name, found.counting(name, getattr(owner, name), *blocks))
    return found


@pytest.fixture()
def passes(waits, monkeypatch):
    """What the host waited for in each pass, from its first sample until its last is added."""
    found = []
    plain_run, plain_after = Passes._run_one, ImageEstimate._keep_parts

    def run(own, target, *arguments):
        if target is own._targets[0]:
            waits.calls.clear()
        plain_run(own, target, *arguments)

    def after(own, done):
        found.append(waits.calls.copy())
        plain_after(own, done)

    monkeypatch.setattr(Passes, "_run_one", run)
    monkeypatch.setattr(ImageEstimate, "_keep_parts", after)
    # Several batches a pass.
    monkeypatch.setattr(samples, "SAMPLES_PER_BATCH", 1 << 13)
    return found


@pytest.mark.parametrize("method", ["mc", pytest.param("ncv", marks=pytest.mark.slow)])
# "lines" are slices in ambient occlusion.
@pytest.mark.parametrize("visibility", ["lines", "points"])
@pytest.mark.parametrize("integrand", ["direct", "ao"])
def test_the_host_waits_once_a_pass(one_device, scenes, passes, integrand, visibility, method):
    options = {"visibility": visibility, "method": method}
    options |= {"spp": 512} if method == "mc" else {"spp": 64, "train_spp": 4}
    rendered(one_device, scenes, integrand, "device", **options)
    assert len(passes) >= 2 and passes == [["finish"]] * len(passes)


def test_the_host_waits_for_each_of_embrees_batches_and_for_each_bounce(one_device, scenes, passes):
    """What the count of waits is when there are some."""
    rendered(one_device, scenes, "ao", "embree", spp=64)
    by_embree = passes.copy()
    passes.clear()
    rendered(one_device, scenes, "gi", "device", spp=64)
    batches = 24 * 16 * 32 / (1 << 13)
    assert all(len(one) >= 5 * batches for one in by_embree)
    # Paths: the counts of each bounce's rays, and nothing that grows with their number.
    assert all(len(one) > batches and set(one) == {"enqueue_map_buffer", "finish"} for one in passes)


def discrete(device: Device) -> Device:
    """The device as if its memory were its own."""
    memory = device.memory
    return replace(device, memory=DeviceMemory(False, memory.largest, memory.total))


# Direct light apart has points share paths, and is sampled by lines; else each has its own.
@pytest.mark.parametrize("split", ["on", "off"])
@pytest.mark.parametrize("method", ["mc", pytest.param("ncv", marks=pytest.mark.slow)])
def test_paths_wait_once_a_pass(one_device, scenes, passes, method, split):
    options = {"split_direct": split, "method": method, "visibility": "auto"}
    options |= {"train_spp": 4} if method == "ncv" else {"spp": 128}
    image = rendered(discrete(one_device), scenes, "gi", "device", **options)
    assert image.stats["rays_traced"] > 100_000
    assert len(passes) >= 2 and passes == [["finish"]] * len(passes)


@pytest.mark.parametrize(("scene", "split"), [("interior", "on"), ("cornell_box", "off")])
def test_paths_that_run_ahead_are_those_whose_rays_are_counted(
    device, scenes, monkeypatch, scene, split
):
    options = SMALL | {"method": "mc", "spp": 32, "rays": "device", "split_direct": split}
    path = scenes / f"{scene}.toml"
    expected = ncv.render(path, "gi", device=device, **options)
    # Few waves, so that paths of every length are followed, and fewer work-items than rays.
    monkeypatch.setattr(paths, "WAVES", 2)
    monkeypatch.setattr(wave, "GROUPS_A_UNIT", 1)
    found = ncv.render(path, "gi", device=discrete(device), **options)
    np.testing.assert_array_equal(found.pixels, expected.pixels)
    np.testing.assert_array_equal(found.variance, expected.variance)
    for name in ("rays_traced", "rays_on_device", "rays_skipped"):
        assert found.stats[name] == expected.stats[name]


def test_paths_of_few_bounces_run_ahead(one_device, scenes):
    """No wave more than there are bounces, and none is followed."""
    options = SMALL | {"method": "mc", "spp": 8, "rays": "device"}
    for depth in (2, 3, paths.WAVES + 1):
        integrand = GlobalIllumination(depth)
        expected, found = (
            ncv.render(scenes / "interior.toml", integrand, device=one, **options)
            for one in (one_device, discrete(one_device))
        )
        np.testing.assert_array_equal(found.pixels, expected.pixels)
        assert found.stats["rays_traced"] == expected.stats["rays_traced"]


def test_few_rays_are_left_behind_the_waves(one_device, scenes, monkeypatch):
    """Those that are followed: work-items whose paths have ended wait for their neighbours'."""
    rays = {}
    plain = Waves.trace

    def trace(own, bounce, *arguments):
        seconds = plain(own, bounce, *arguments)
        rays[bounce] = rays.get(bounce, 0) + own.now.rays
        return seconds

    monkeypatch.setattr(Waves, "trace", trace)
    rendered(one_device, scenes, "gi", "device")
    left = sum(count for bounce, count in rays.items() if bounce != "shared" and bounce > paths.WAVES)
    assert 0 < left < 0.03 * sum(rays.values())


@pytest.fixture()
def crossings(waits, monkeypatch):
    """Of each wave that embree traces: what the host waited for, bytes that were copied, and rays."""
    found = []
    copied = [0]
    plain_copy, plain_trace = cl.enqueue_copy, embree.Copies.trace

    def copy(queue, to, source, **given):
        copied[0] += (to if isinstance(to, np.ndarray) else source).nbytes
        return plain_copy(queue, to, source, **given)

    def trace(own, wave, *arguments):
        waits.calls.clear()
        copied[0] = 0
        seconds = plain_trace(own, wave, *arguments)
        found.append((waits.calls.copy(), copied[0], wave.rays + wave.shadows))
        return seconds

    monkeypatch.setattr(cl, "enqueue_copy", copy)
    monkeypatch.setattr(embree.Copies, "trace", trace)
    monkeypatch.setattr(samples, "SAMPLES_PER_BATCH", 1 << 13)
    return found


@pytest.mark.parametrize("split", ["on", "off"])
def test_embree_gets_what_it_needs_of_each_bounce_at_once(one_device, scenes, crossings, split):
    options = {"split_direct": split, "visibility": "embree", "spp": 128}
    found = rendered(discrete(one_device), scenes, "gi", "embree", **options)
    expected = rendered(one_device, scenes, "gi", "embree", **options)
    waited, copied, rays = zip(*crossings, strict=True)
    # Memory to copy to is mapped when it grows; and a wave may have more rays than were expected.
    asked = [one.count("wait_for_events") for one in waited]
    assert len(asked) > 100 and min(asked) == 1 and max(asked) == 2 and np.mean(asked) < 1.2
    assert all(set(one) <= {"wait_for_events", "enqueue_map_buffer"} for one in waited)
    assert sum(one.count("enqueue_map_buffer") for one in waited) < 32
    assert sum(copied) <= 41 * sum(rays) and sum(rays) > 100_000
    np.testing.assert_array_equal(found.pixels, expected.pixels)


def test_of_auto_a_gpu_traces_what_it_can(one_device, scenes, monkeypatch):
    options = {"method": "mc", "spp": 2, "size": (4, 4), "device": one_device}
    asked = []
    monkeypatch.setattr(prepare, "DeviceTracer", lambda *given: asked.append(1) or DeviceTracer(*given))
    ncv.render(scenes / "knot.toml", "ao", **options)
    assert not asked or not one_device.is_cpu
    monkeypatch.setattr(Device, "is_gpu", property(lambda device: True))
    for visibility, rays, expected in (
        ("auto", "auto", 1),
        ("points", "auto", 1),
        ("embree", "auto", 0),
        ("auto", "embree", 0),
    ):
        asked.clear()
        ncv.render(scenes / "knot.toml", "ao", visibility=visibility, rays=rays, **options)
        assert len(asked) == expected


def test_holes_are_embrees(one_device, tmp_path, monkeypatch):
    write_image(tmp_path / "leaf.exr", np.full((2, 2, 3), 0.2, np.float32), "half")
    text = """
[camera]
position = [0, 0, 3]
target = [0, 0, 0]
vertical_fov = 40
[materials.leaf]
albedo = 0.5
opacity = { file = "leaf.exr" }
[[quads]]
corner = [-1, -1, 0]
edge1 = [2, 0, 0]
edge2 = [0, 2, 0]
material = "leaf"
"""
    (tmp_path / "leaf.toml").write_text(text)
    options = {"method": "mc", "spp": 2, "size": (4, 4), "device": one_device}
    with pytest.raises(ValueError, match="'device' take triangles for whole"):
        ncv.render(tmp_path / "leaf.toml", "ao", rays="device", **options)
    monkeypatch.setattr(Device, "is_gpu", property(lambda device: True))
    assert np.isfinite(ncv.render(tmp_path / "leaf.toml", "ao", **options).pixels).all()


def test_options_that_contradict_are_refused(scenes):
    with pytest.raises(ValueError, match="leave out rays 'device'"):
        ncv.render(scenes / "knot.toml", "ao", visibility="embree", rays="device")
    with pytest.raises(ValueError, match="rays"):
        ncv.estimate(lambda u, v, point: u, spp=2, rays="device")


def test_points_far_away_are_seen_alike(one_device, scenes):
    """Where occluders are not listed: from many times the scene's extent."""
    scene = load_scene(scenes / "knot.toml")
    extent = np.abs(scene.world_bounds).max()
    generator = np.random.default_rng(2)
    positions = generator.normal(size=(64, 3))
    positions *= 100 * extent / np.linalg.norm(positions, axis=1, keepdims=True)
    found = [
        ncv.ambient_occlusion(
            scene, positions, -positions, spp=256, method="mc", device=one_device, rays=rays,
            mapping="cosine",
        ).values
        for rays in ("embree", "device")
    ]  # fmt: skip
    np.testing.assert_allclose(*found, atol=1 / 128)
    assert np.mean(found[0] == found[1]) > 0.9
