"""The hash grid's gather lists, built by the host and by the device, against plain numpy."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from test_network import knot_points

from ncv_cl.network.encode import Encoder, Encoding, GridCube
from ncv_cl.network.grid_index import on_device, on_host
from ncv_cl.opencl.device import GPU_LANES, open_device
from ncv_cl.opencl.memory import HostArray

LISTS = ("entries", "starts", "places", "weights")


def expected_lists(encoding, corner, weight, batches):
    """The index by its definition, pair after pair: touched, batches and the arrays of `LISTS`."""
    touched = np.unique(corner)
    entries, starts, places, weights, ranges = [], [], [], [], []
    for batch in batches:
        pairs = [(corner[row, c], row, c) for row in range(len(corner)) for c in batch]
        # Sorting is stable: pairs of an entry stay in the order of their rows and columns.
        first = len(entries)
        for entry, own in itertools.groupby(
            sorted(pairs, key=lambda pair: pair[0]), lambda pair: pair[0]
        ):
            entries.append(np.searchsorted(touched, entry))
            starts.append(len(places))
            for _, row, c in own:
                level = row // 8
                places.append((c - batch.start) * encoding.grid_rows + level * encoding.grid_features)
                weights.append(weight[row, c])
        ranges.append(range(first, len(entries)))
    return touched, ranges, (entries, [*starts, len(places)], places, weights)


@pytest.mark.parametrize("build", [on_host, on_device])
@pytest.mark.parametrize("edges", [(0, 37), (0, 1, 20, 37), (0, 16, 32, 37)])
def test_lists_are_those_of_the_definition(one_device, scenes, build, edges):
    device = open_device(one_device.cl_device, one_device.index, vector_width=1, lanes=GPU_LANES)
    scene, points = knot_points(device, scenes)
    encoding = Encoding(("position",), grid_levels=3, grid_features=4, grid_base=2, grid_entries=64)
    order = np.random.default_rng(0).permutation(points.active)[: edges[-1]].astype(np.uint32)
    cube = GridCube.around(scene.bounds)
    encoder = Encoder(device, encoding, points, cube, HostArray.of(device, order))
    corner, weight = (one.read()[:, : len(order)] for one in encoder.corners())
    batches = [range(a, b) for a, b in itertools.pairwise(edges)]
    touched, ranges, lists = expected_lists(encoding, corner, weight, batches)

    index = build(encoder, encoding, batches)

    assert np.array_equal(index.touched, touched)
    assert np.array_equal(index.corner.read(), np.searchsorted(touched, corner.T))
    assert index.batches == ranges
    for name, list_ in zip(LISTS, lists, strict=True):
        assert np.array_equal(index.arrays[name].read(), list_), name
