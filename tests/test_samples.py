"""Batches of samples: compaction of rays, padding, counting, and independence of the partition."""

from __future__ import annotations

import itertools
from types import SimpleNamespace

import numpy as np
import pytest
from reference import batch_arrays, camera_at, light_at, mesh_scene, quad, sampling, shadowed_values
from reference import square_samples as expected_samples

from ncv_cl.integrands import AmbientOcclusion, DirectLight
from ncv_cl.opencl.limits import DeviceMemory
from ncv_cl.points.sampler import SAMPLERS
from ncv_cl.sampling.samples import NO_RAY, SAMPLES_PER_BATCH
from ncv_cl.visibility.room import samples_held

# A floor and a wall under a light that faces part of them only, so that some samples get no ray.
TRIANGLES = np.concatenate(
    [quad([-3, 0, -3], [0, 0, 6], [6, 0, 0]), quad([-1, 0, 0], [2, 0, 0], [0, 1.5, 0])]
)
LIGHTS = (
    light_at([-1, 1, 1], [2, 0, 0], [0, 0.7, 0.7], (5, 0, 3)),
    light_at([-2, 0.5, -2], [0, 1, 0], [0, 0, 1], 2),
)
SIZE = (9, 7)


def scene():
    return mesh_scene(TRIANGLES, camera_at([0, 2, 5], [0, 0.5, 0]), LIGHTS)


def drawn(device, integrand, sampler, samples, parts=1, stream=0):
    """All points' u, v, value and visible value, in `parts` ranges of points."""
    points, source, _ = sampling(device, scene(), integrand, SIZE, len(samples), sampler)
    edges = np.linspace(0, points.active, parts + 1).astype(int)
    collected = []
    for first, last in itertools.pairwise(edges):
        batch = source.draw(range(first, last), samples, stream)
        arrays = batch_arrays(batch, integrand.channels)
        shadowed = shadowed_values(batch, integrand.channels)
        collected.append([arrays["u"][None], arrays["v"][None], arrays["value"], shadowed])
    return [np.concatenate(part, axis=1) for part in zip(*collected, strict=True)]


@pytest.mark.parametrize("integrand", [DirectLight(), AmbientOcclusion()], ids=["direct", "ao"])
@pytest.mark.parametrize("samples", [1, 13, 64])
def test_exactly_the_values_above_zero_get_a_slot_of_their_own(device, integrand, samples):
    points, source, rays = sampling(device, scene(), integrand, SIZE, samples)
    batch = source.draw(range(points.active), range(samples), 0)
    arrays = batch_arrays(batch, integrand.channels)
    live = (arrays["value"] > 0).any(axis=0)
    np.testing.assert_array_equal(arrays["slot"] != NO_RAY, live)
    np.testing.assert_array_equal(np.sort(arrays["slot"][live]), np.arange(live.sum()))
    assert len(rays.answers) == live.sum() == source.rays.traced
    assert source.rays.skipped == live.size - live.sum()
    if integrand.name == "direct":
        assert 0 < live.sum() < live.size


def test_each_sample_finds_its_own_rays_answer(device):
    points, source, rays = sampling(device, scene(), DirectLight(), SIZE, 50)
    slot = batch_arrays(source.draw(range(points.active), range(50), 0), 3)["slot"]
    point, _ = np.nonzero(slot != NO_RAY)
    origin = points.rows("position") + points.rows("offset") * points.rows("geometric_normal")
    np.testing.assert_allclose(rays.origins[slot[slot != NO_RAY]], origin.T[point], atol=1e-6)
    assert 0 < rays.answers.mean() < 1


@pytest.mark.parametrize("samples", [1, 13, 33])
def test_padding_has_value_zero_and_no_ray(device, samples):
    points, source, _ = sampling(device, scene(), DirectLight(), SIZE, samples)
    batch = source.draw(range(points.active), range(samples), 0)
    assert batch.stride % device.vector_width == 0 and batch.stride - samples < device.vector_width
    count = points.active * batch.stride
    value = batch.value.read().ravel()[: 3 * count].reshape(3, points.active, batch.stride)
    slot = batch.slot.read()[:count].reshape(points.active, batch.stride)
    assert not value[..., samples:].any()
    assert (slot[:, samples:] == NO_RAY).all()


@pytest.mark.parametrize("sampler", SAMPLERS)
@pytest.mark.parametrize("integrand", [DirectLight(), AmbientOcclusion()], ids=["direct", "ao"])
def test_the_partition_into_batches_changes_nothing(device, sampler, integrand):
    whole = drawn(device, integrand, sampler, range(37))
    for array, part in zip(whole, drawn(device, integrand, sampler, range(37), parts=5), strict=True):
        np.testing.assert_array_equal(array, part)
    later = drawn(device, integrand, sampler, range(11, 30))
    for array, part in zip(whole, later, strict=True):
        np.testing.assert_array_equal(array[..., 11:30], part)


@pytest.mark.parametrize("sampler", SAMPLERS)
@pytest.mark.parametrize("stream", [0, 1])
def test_coordinates_are_the_samplers(device, sampler, stream):
    u, v, *_ = drawn(device, DirectLight(), sampler, range(5, 24), stream=stream)
    expected = expected_samples(sampler, range(u.shape[1]), range(5, 24), 1, stream)
    np.testing.assert_array_equal(np.concatenate([u, v]), expected)


def test_batches_cover_the_active_points_and_respect_the_scratch_memory(one_device, monkeypatch):
    monkeypatch.setattr("ncv_cl.sampling.samples.SAMPLES_PER_BATCH", 160)
    points, source, _ = sampling(one_device, scene(), DirectLight(), SIZE, 17)
    parts = source.batches()
    assert [point for part in parts for point in part] == list(range(points.active))
    assert all(len(part) * source.stride <= 160 for part in parts) and len(parts) > 5
    values = [shadowed_values(source.draw(part, range(17), 0), 3) for part in parts]
    monkeypatch.undo()
    np.testing.assert_array_equal(
        np.concatenate(values, axis=1), drawn(one_device, DirectLight(), "sobol", range(17))[3]
    )


def test_batches_of_a_gpu_grow_with_its_compute_units():
    def of(is_gpu: bool, units: int) -> int:
        device = SimpleNamespace(
            is_gpu=is_gpu,
            cl_device=SimpleNamespace(max_compute_units=units),
            memory=DeviceMemory(False, 1 << 40, 1 << 40),
        )
        return samples_held(device, SAMPLES_PER_BATCH, 1)

    assert of(False, 64) == of(False, 2) == of(True, 2) == SAMPLES_PER_BATCH
    # A path has eight samples, and a multiprocessor holds 2048 work-items.
    assert of(True, 132) / 8 >= 4 * 132 * 2048


def test_more_samples_than_a_batch_should_hold_still_fit_a_point(one_device, monkeypatch):
    monkeypatch.setattr("ncv_cl.sampling.samples.SAMPLES_PER_BATCH", 8)
    points, source, _ = sampling(one_device, scene(), DirectLight(), SIZE, 40)
    assert source.points_per_batch == 1
    assert len(source.batches()) == points.active


def test_counts_of_rays_add_up_over_draws(one_device):
    points, source, _ = sampling(one_device, scene(), DirectLight(), SIZE, 40)
    for samples in (range(40), range(40, 61)):
        for part in source.batches():
            source.draw(part, samples, 0)
    assert source.rays.traced + source.rays.skipped == 61 * points.active
    assert source.rays.trace_seconds > 0 and source.rays.sample_seconds > 0


def test_a_picture_without_active_points_has_no_batches(one_device):
    light = light_at([-1, -1, 0], [2, 0, 0], [0, 2, 0])
    alone = mesh_scene(np.empty((0, 3, 3)), camera_at([0, 0, 2], [0, 0, 0]), (light,))
    points, source, _ = sampling(one_device, alone, DirectLight(), SIZE, 4)
    assert points.total > 0 and points.active == 0
    assert source.batches() == []
