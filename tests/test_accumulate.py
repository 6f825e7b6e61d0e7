"""Running means and variances against float64, however the samples arrive."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from ncv_cl.network.encode import Encoding
from ncv_cl.network.network import NetworkDescription
from ncv_cl.opencl.device import open_device, widest_vectors
from ncv_cl.opencl.memory import HostArray
from ncv_cl.points.points import ShadingPoints
from ncv_cl.sampling.accumulate import Accumulator
from ncv_cl.sampling.samples import NO_RAY, Batch

POINTS = 37


def some_points(count=POINTS):
    return ShadingPoints(None, np.arange(count), np.full(count, -1), count, 0)


def make_batch(device, first, values, uv=None, seed=0):
    """A batch of `values` (channels, points, samples) whose rays are answered in random order.

    Returns it with the values after visibility, float64.
    """
    channels, count, samples = values.shape
    stride = -(-samples // device.vector_width) * device.vector_width
    generator = np.random.default_rng(seed)
    # Padding is never to be read: NaN would show.
    padded = np.full((channels, count, stride), np.nan, np.float32)
    padded[..., :samples] = values
    slot = generator.permutation(count * stride).astype(np.uint32).reshape(count, stride)
    untraced = generator.uniform(size=slot.shape) < 0.1
    visible = (generator.uniform(size=slot.size) < 0.8).astype(np.uint8)
    if uv is None:
        untraced[...], visible[...] = False, 1
        uv = np.zeros((2, count, samples), np.float32)
    slot[untraced] = NO_RAY
    seen = np.where(untraced, 0, visible[np.where(untraced, 0, slot)])[:, :samples]
    wide = np.zeros((2, count, stride), np.float32)
    wide[..., :samples] = uv
    arrays = [HostArray.of(device, array) for array in (wide[0], wide[1], padded, slot, visible)]
    everything = HostArray.of(device, np.arange(POINTS, dtype=np.uint32))
    batch = Batch(range(first, first + count), everything, samples, stride, *arrays)
    return batch, values.astype(np.float32).astype(np.float64) * seen


def accumulated(device, passes, channels, uv=None, network=None, split=11):
    """Accumulator after `passes` of values, each given in two batches, and the values seen."""
    accumulator = Accumulator(device, some_points(), channels, network)
    seen = []
    for number, values in enumerate(passes):
        parts = []
        for points in (slice(0, split), slice(split, POINTS)):
            own_uv = None if uv is None else uv[number][:, points]
            batch, part = make_batch(device, points.start, values[:, points], own_uv, seed=number)
            accumulator.add(batch)
            parts.append(part)
        accumulator.finish_pass(values.shape[-1])
        seen.append(np.concatenate(parts, axis=1))
    return accumulator, np.concatenate(seen, axis=-1)


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("lengths", [(1,), (2,), (37,), (16, 33, 5), (1, 1, 200, 3)])
@pytest.mark.parametrize(("mean", "spread"), [(0, 1), (1e3, 1e-1), (1e3, 1e-3), (1e-12, 1e-13)])
def test_means_and_variances_match_float64(device, channels, lengths, mean, spread):
    generator = np.random.default_rng(8)
    passes = [mean + spread * generator.normal(size=(channels, POINTS, n)) for n in lengths]
    accumulator, values = accumulated(device, passes, channels)
    estimate = accumulator.result()
    assert np.array_equal(estimate.samples, np.full(POINTS, sum(lengths)))
    # Of means, single precision keeps this much; of a batch's few samples not more.
    ulp = np.spacing(np.float32(abs(mean) + 4 * spread)).astype(float)
    np.testing.assert_allclose(estimate.mean, values.mean(-1), atol=2 * ulp, rtol=0)
    variance = values.var(-1, ddof=1) if sum(lengths) > 1 else np.full_like(estimate.variance, np.nan)
    # Each mean that enters a merge is off by half an ulp, and so enters squared or times the spread.
    slack = 4 * ulp * spread + ulp**2
    np.testing.assert_allclose(estimate.variance, variance, rtol=2e-4, atol=slack)
    np.testing.assert_allclose(estimate.variance_of_mean, estimate.variance / sum(lengths))


def test_visibility_is_read_through_the_slots(device):
    generator = np.random.default_rng(3)
    lengths = (21, 7)
    passes = [generator.uniform(size=(3, POINTS, n)) for n in lengths]
    uv = [generator.uniform(size=(2, POINTS, n)) for n in lengths]
    accumulator, values = accumulated(device, passes, 3, uv)
    assert 0.6 < np.mean(values > 0) < 0.8
    estimate = accumulator.result()
    np.testing.assert_allclose(estimate.mean, values.mean(-1), rtol=1e-5)
    np.testing.assert_allclose(estimate.variance, values.var(-1, ddof=1), rtol=1e-4)


@pytest.mark.parametrize("modulated", [(), ("B1",), ("W1", "B1", "B2", "W3", "B3")])
def test_residuals_are_taken_against_the_network(device, modulated):
    generator = np.random.default_rng(5)
    description = NetworkDescription(Encoding(("position",)), 3, (5, 7), modulated)
    shapes = {**description.group_shapes, "W2": (7, 5)}
    part = {
        name: generator.normal(size=(POINTS, *shape) if name in modulated else (1, *shape))
        for name, shape in shapes.items()
    }
    network = SimpleNamespace(
        network=SimpleNamespace(description=description),
        arrays={name.lower(): HostArray.of(device, x.astype(np.float32)) for name, x in part.items()},
    )
    passes = [generator.uniform(size=(3, POINTS, n)) for n in (19, 40)]
    uv = [generator.uniform(size=(2, POINTS, n)).astype(np.float32) for n in (19, 40)]
    accumulator, values = accumulated(device, passes, 3, uv, network)

    part = {name: np.broadcast_to(array, (POINTS, *array.shape[1:])) for name, array in part.items()}
    both = np.concatenate(uv, axis=-1).astype(float)
    first = np.einsum("pji,ips->jps", part["W1"], both) + part["B1"].T[:, :, None]
    second = np.einsum("pkj,jps->kps", part["W2"], np.maximum(first, 0)) + part["B2"].T[:, :, None]
    output = np.einsum("pck,kps->cps", part["W3"], np.maximum(second, 0)) + part["B3"].T[:, :, None]
    for quantity, expected in enumerate([values, values - output]):
        estimate = accumulator.result(quantity)
        scale = np.abs(output).max() if quantity else 1
        np.testing.assert_allclose(estimate.mean, expected.mean(-1), atol=2e-6 * scale)
        np.testing.assert_allclose(estimate.variance, expected.var(-1, ddof=1), rtol=1e-4)


@pytest.mark.parametrize("lanes", [1, 2, 32])
@pytest.mark.parametrize("vector_width", [1, 4, 8, 16])
def test_every_width_and_number_of_lanes_agrees(one_device, vector_width, lanes):
    if vector_width > widest_vectors(one_device.cl_device):
        pytest.skip(f"{one_device.name} compiles no vectors of {vector_width}")
    device = open_device(one_device.cl_device, one_device.index, vector_width, lanes)
    generator = np.random.default_rng(1)
    passes = [10 + generator.normal(size=(2, POINTS, n)) for n in (1, 100, 29)]
    accumulator, values = accumulated(device, passes, 2)
    estimate = accumulator.result()
    np.testing.assert_allclose(estimate.mean, values.mean(-1), rtol=3e-7)
    np.testing.assert_allclose(estimate.variance, values.var(-1, ddof=1), rtol=1e-5)


@pytest.mark.parametrize("samples", [1, 3])
def test_thousands_of_passes_lose_nothing(device, samples):
    generator = np.random.default_rng(6)
    values = (100 + generator.normal(size=(1, POINTS, samples))).astype(np.float32)
    other = values + np.float32(0.01)
    batches = [make_batch(device, 0, array)[0] for array in (values, other)]
    accumulator = Accumulator(device, some_points(), 1)
    passes = 4000
    for number in range(passes):
        # Late passes move the mean by less than its last bit.
        accumulator.add(batches[number >= passes // 2])
        accumulator.finish_pass(samples)
    everything = np.concatenate([values, other], axis=-1).astype(np.float64)
    estimate = accumulator.result()
    np.testing.assert_allclose(estimate.mean, everything.mean(-1), rtol=1e-7)
    expected = everything.var(-1) * passes * samples / (passes * samples - 1)
    np.testing.assert_allclose(estimate.variance, expected, rtol=1e-4)


def test_equal_values_have_no_variance(device):
    values = np.full((1, POINTS, 64), 0.7)
    accumulator, _ = accumulated(device, [values, values[..., :5]], 1)
    estimate = accumulator.result()
    np.testing.assert_allclose(estimate.mean, 0.7, rtol=1e-7)
    assert (estimate.variance <= (1e-7) ** 2).all()


@pytest.mark.parametrize("points", [0, POINTS])
def test_no_samples_give_zeros_of_unknown_variance(one_device, points):
    estimate = Accumulator(one_device, some_points(points), 3).result()
    np.testing.assert_array_equal(estimate.mean, np.zeros((3, points)))
    for array in (estimate.variance, estimate.variance_of_mean):
        np.testing.assert_array_equal(array, np.full((3, points), np.nan))


def test_only_chosen_points_are_counted(one_device):
    chosen = np.array([3, 20, 5], np.uint32)
    accumulator = Accumulator(one_device, some_points(), 1, chosen=chosen)
    values = np.arange(12, dtype=float).reshape(1, 3, 4)
    batch, _ = make_batch(one_device, 0, values)
    accumulator.add(replace(batch, order=HostArray.of(one_device, chosen)))
    accumulator.finish_pass(4)
    estimate = accumulator.result()
    expected = np.zeros(POINTS)
    expected[chosen] = values[0].mean(-1)
    np.testing.assert_allclose(estimate.mean[0], expected)
    assert np.array_equal(estimate.samples, np.where(expected > 0, 4, 0))
