"""Warps to densities: records, points that follow them, and weights that are one over them."""

from __future__ import annotations

import numpy as np
import pytest
from reference import camera_at, light_at, mesh_scene, quad, unpack_records
from scipy import stats

from ncv_cl.integrands import DirectLight
from ncv_cl.opencl.memory import HostArray
from ncv_cl.points.points import find_points
from ncv_cl.points.sampler import Stream
from ncv_cl.points.trace import Tracer
from ncv_cl.sampling.samples import SampleSource
from ncv_cl.sampling.warp import DENSITY_BINS, DENSITY_WORDS, EDGE_UNITS, TableWarp, pack_records

BINS = DENSITY_BINS


def random_probabilities(points, seed=1):
    """Of all kinds: uniform, peaked, with cells of almost no probability."""
    weight = np.random.default_rng(seed).gamma(0.3, size=(points, BINS, BINS)) + 1e-3
    weight[0] = 1
    return weight / weight.sum(axis=(1, 2), keepdims=True)


def representable(points):
    """Probabilities that records stand for exactly."""
    return unpack_records(pack_records(random_probabilities(points))).reshape(points, BINS, BINS)


@pytest.fixture
def plane():
    light = light_at([-1, -1, 2], [0, 2, 0], [2, 0, 0], (1, 1, 1))
    return mesh_scene(
        quad([-1, -1, 0], [2, 0, 0], [0, 2, 0]), camera_at([0, 0, 1.5], [0, 0, 0]), (light,)
    )


def warped(device, scene, sampler, probability, samples):
    """u, v and weights (points, samples) drawn by the densities of `probability`."""
    tracer = Tracer(scene, 1)
    points = find_points(device, scene, tracer, 6, 6)
    assert points.active >= len(probability)
    source = SampleSource(device, scene, tracer, points, DirectLight(), sampler, 5, samples)
    padded = np.broadcast_to(probability[:1], (points.active, BINS, BINS)).copy()
    padded[: len(probability)] = probability
    density = TableWarp(HostArray.of(device, pack_records(padded)))
    batch = source.draw(range(len(probability)), range(samples), Stream.RESIDUAL, None, density)
    shape = (len(probability), batch.stride)
    return [
        array.read()[: shape[0] * shape[1]].reshape(shape)[:, :samples]
        for array in (batch.u, batch.v, batch.weight)
    ]


def cells(u, v):
    return (u * BINS).astype(int) * BINS + (v * BINS).astype(int)


def test_independent_points_follow_the_density(device, plane):
    probability = representable(4)
    u, v, _ = warped(device, plane, "independent", probability, 20000)
    for own_u, own_v, expected in zip(u, v, probability.reshape(4, -1), strict=True):
        counts = np.bincount(cells(own_u, own_v), minlength=BINS**2)
        # Cells with few expected points are lumped, as the test's approximation asks.
        large = expected * 20000 > 8
        observed = np.append(counts[large], counts[~large].sum())
        wanted = np.append(expected[large], expected[~large].sum()) * 20000
        keep = wanted > 0
        assert stats.chisquare(observed[keep], wanted[keep], sum_check=False).pvalue > 1e-4
        # And within a cell they are uniform.
        for coordinate in (own_u, own_v):
            assert stats.kstest(coordinate * BINS % 1, "uniform").pvalue > 1e-4


@pytest.mark.parametrize("sampler", ["independent", "sobol"])
def test_weights_are_one_over_the_density(device, plane, sampler):
    probability = representable(4)
    u, v, weight = warped(device, plane, sampler, probability, 512)
    assert ((u >= 0) & (u < 1) & (v >= 0) & (v < 1)).all()
    density = np.take_along_axis(probability.reshape(4, -1), cells(u, v), axis=1) * BINS**2
    np.testing.assert_allclose(weight * density, 1, rtol=1e-6)


def decoded(record):
    """Cell probabilities of one record, read byte by byte."""

    def row(low, high):
        edges = [0, *low.to_bytes(4, "little"), *high.to_bytes(4, "little")[:3], EDGE_UNITS]
        return np.diff(edges) / EDGE_UNITS

    words = [int(word) for word in record]
    rows = [row(*words[first : first + 2]) for first in range(0, DENSITY_WORDS, 2)]
    return np.array([share * cells for share, cells in zip(rows[0], rows[1:], strict=True)])


def test_records_are_read_as_they_are_packed():
    records = pack_records(random_probabilities(50))
    assert records.shape == (50, DENSITY_WORDS) and records.dtype == np.uint32
    found = unpack_records(records).reshape(50, BINS, BINS)
    np.testing.assert_array_equal(found, [decoded(record) for record in records])
    np.testing.assert_array_equal(pack_records(found), records)


def test_packing_rounds_to_units_and_leaves_no_cell_out():
    probability = random_probabilities(50)
    found = unpack_records(pack_records(probability)).reshape(50, BINS, BINS)
    assert (found >= EDGE_UNITS**-2.0).all()
    strips, wanted = found.sum(axis=2), probability.sum(axis=2)
    # Half a unit at either edge, and what bins next to it took that would have had less than one.
    assert np.abs(strips - wanted).max() <= (1 + BINS) / EDGE_UNITS
    assert np.abs(strips - wanted).mean() <= 1 / EDGE_UNITS


def test_the_density_of_a_record_integrates_to_one():
    probability = np.random.default_rng(4).dirichlet(np.full(BINS**2, 0.05), 200) + 1e-30
    np.testing.assert_allclose(unpack_records(pack_records(probability)).sum(axis=1), 1, atol=1e-12)


def test_a_uniform_density_changes_nothing(device, plane):
    probability = np.full((2, BINS, BINS), 1 / BINS**2)
    u, v, weight = warped(device, plane, "sobol", probability, 64)
    tracer = Tracer(plane, 1)
    points = find_points(device, plane, tracer, 6, 6)
    source = SampleSource(device, plane, tracer, points, DirectLight(), "sobol", 5, 64)
    batch = source.draw(range(2), range(64), Stream.RESIDUAL)
    for warped_one, plain in ((u, batch.u), (v, batch.v)):
        np.testing.assert_allclose(warped_one, plain.read()[:128].reshape(2, 64), atol=2e-7)
    np.testing.assert_allclose(weight, 1, rtol=1e-6)


def test_sobol_points_stay_spread_over_the_strips(device, plane):
    probability = representable(4)
    u, _, _ = warped(device, plane, "sobol", probability, 256)
    for own, expected in zip(u, probability.sum(axis=2), strict=True):
        counts = np.bincount((own * BINS).astype(int), minlength=BINS)
        # A strip is an interval of the unwarped axis, and each of 256 equal ones holds one point.
        assert (np.abs(counts - 256 * expected) <= 2).all()
