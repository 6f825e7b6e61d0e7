"""The samplers: Philox's published answers, nets, exact uniformity, and invariance."""

from __future__ import annotations

import numpy as np
import pytest
from reference import bare_kernel, philox
from reference import square_samples as expected_samples
from scipy import stats

from ncv_cl.opencl.memory import HostArray
from ncv_cl.points.sampler import SAMPLERS, Stream, sampler_defines, seed_words, square_samples

# Random123's kat_vectors: counter, key, result.
KNOWN_ANSWERS = [
    ((0, 0, 0, 0), (0, 0), (0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8)),
    ((2**32 - 1,) * 4, (2**32 - 1,) * 2, (0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD)),
    (
        (0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344),
        (0xA4093822, 0x299F31D0),
        (0xD16CFE09, 0x94FDCCEB, 0x5001E420, 0x24126EA1),
    ),
]
PHILOX_KERNEL = """
kernel void known(const uint key0, const uint key1, global const uint *counter, global uint *wide,
                  global uint *narrow) {
  bits state[4];
  uint scalar_state[4];
  for (int i = 0; i < 4; ++i) state[i] = (bits)(scalar_state[i] = counter[i]);
  philox(state, key0, key1);
  philox_scalar(scalar_state, key0, key1);
  for (int i = 0; i < 4; ++i) {
    STORE(state[i], wide + i * VEC);
    narrow[i] = scalar_state[i];
  }
}
"""
SEED = 0x0123456789ABCDEF


@pytest.mark.parametrize(("counter", "key", "answer"), KNOWN_ANSWERS)
def test_philox_gives_the_published_answers(device, counter, key, answer):
    kernel = bare_kernel(
        device, ("common", "sampler"), sampler_defines("independent"), PHILOX_KERNEL, "known"
    )
    wide, narrow = (
        HostArray(device, (4, device.vector_width), np.uint32),
        HostArray(device, 4, np.uint32),
    )
    kernel(
        1,
        key0=key[0],
        key1=key[1],
        counter=HostArray.of(device, np.array(counter, np.uint32)),
        wide=wide,
        narrow=narrow,
        group=1,
    )
    assert (wide.read() == np.array(answer, np.uint32)[:, None]).all()
    assert tuple(narrow.read()) == answer
    assert tuple(philox(np.array(counter)[:, None], key)[:, 0]) == answer


@pytest.mark.parametrize("sampler", SAMPLERS)
@pytest.mark.parametrize(
    ("points", "samples", "seed", "stream"),
    [
        (range(0, 7), range(0, 37), SEED, Stream.RESIDUAL),
        (range(11, 12), range(5, 6), 2**64 - 1, Stream.TRAINING),
        (range(2**32 - 3, 2**32), range(2**32 - 20, 2**32), 0, 7),
    ],
)
def test_every_device_draws_the_reference_bits(device, sampler, points, samples, seed, stream):
    drawn = square_samples(device, sampler, points, samples, seed, stream)
    np.testing.assert_array_equal(drawn, expected_samples(sampler, points, samples, seed, stream))


@pytest.mark.parametrize("log2_count", [0, 1, 3, 6, 9])
@pytest.mark.parametrize("block", [0, 5])
def test_sobol_blocks_are_nets(device, log2_count, block):
    count = 1 << log2_count
    first = block * count
    u, v = square_samples(device, "sobol", range(3, 9), range(first, first + count), SEED)
    for log2_columns in range(log2_count + 1):
        columns, rows = 1 << log2_columns, 1 << (log2_count - log2_columns)
        cell = (u * columns).astype(int) * rows + (v * rows).astype(int)
        # Each elementary interval holds exactly one point.
        np.testing.assert_array_equal(np.sort(cell, axis=1), np.tile(np.arange(count), (6, 1)))


@pytest.mark.parametrize("sampler", SAMPLERS)
@pytest.mark.parametrize("index", [0, 1, 1023, 12345])
def test_each_sample_is_uniform_over_scrambles(one_device, sampler, index):
    u, v = square_samples(one_device, sampler, range(0, 40000), range(index, index + 1), SEED)
    counts = np.histogram2d(u[:, 0], v[:, 0], bins=16, range=[[0, 1], [0, 1]])[0]
    assert 1e-4 < stats.chisquare(counts.ravel()).pvalue < 1 - 1e-4
    deviation = np.array([u.mean(), v.mean()]) - 0.5
    assert np.abs(deviation * np.sqrt(12 * len(u))).max() < 4


@pytest.mark.parametrize("sampler", SAMPLERS)
def test_points_streams_and_seeds_are_uncorrelated(one_device, sampler):
    count = 20000
    base = np.concatenate(square_samples(one_device, sampler, range(0, count), range(1), SEED))[:, 0]
    others = {
        "next point": (range(1, count + 1), SEED, Stream.RESIDUAL),
        "stream": (range(0, count), SEED, Stream.TRAINING),
        "low seed": (range(0, count), SEED + 1, Stream.RESIDUAL),
        "high seed": (range(0, count), SEED + 2**32, Stream.RESIDUAL),
    }
    pairs = {"u and v": (base[:count], base[count:])}
    for name, (points, seed, stream) in others.items():
        other = np.concatenate(square_samples(one_device, sampler, points, range(1), seed, stream))
        pairs[name] = (base, other[:, 0])
    for name, (x, y) in pairs.items():
        assert abs(np.corrcoef(x, y)[0, 1]) * np.sqrt(len(x)) < 4, name


def test_independent_samples_of_a_point_are_uncorrelated(one_device):
    u, v = square_samples(one_device, "independent", range(4), range(20000), SEED)
    for x in (*u, *v):
        assert abs(np.corrcoef(x[:-1], x[1:])[0, 1]) * np.sqrt(len(x)) < 4


@pytest.mark.parametrize("sampler", SAMPLERS)
def test_samples_do_not_depend_on_how_they_are_batched(device, sampler):
    whole = np.array(square_samples(device, sampler, range(20), range(67), SEED))
    for points, samples in [(range(3, 4), range(0, 67)), (range(5, 20), range(1, 34))]:
        part = np.array(square_samples(device, sampler, points, samples, SEED))
        expected = whole[:, points.start : points.stop, samples.start : samples.stop]
        np.testing.assert_array_equal(part, expected)


@pytest.mark.parametrize("sampler", SAMPLERS)
def test_coordinates_are_24_bit_fractions_below_one(device, sampler):
    words = np.array(square_samples(device, sampler, range(50), range(999), SEED)) * 2.0**24
    assert (words == np.floor(words)).all()
    assert words.min() >= 0 and words.max() < 2**24


@pytest.mark.parametrize("seed", [-1, 2**64, 1.5, True, float("nan"), float("inf"), "seven", None])
def test_bad_seeds_are_refused(seed):
    with pytest.raises(ValueError, match="seed must be an integer"):
        seed_words(seed)


@pytest.mark.parametrize("seed", [np.int64(5), np.uint64(2**64 - 1), 2.0**40, 2**64 - 1])
def test_every_kind_of_whole_seed_is_split_into_words(seed):
    words = {"seed_low": int(seed) % 2**32, "seed_high": int(seed) // 2**32}
    assert seed_words(seed) == words


def test_unknown_sampler_is_refused_with_the_choices(one_device):
    with pytest.raises(ValueError, match="independent, sobol, got 'halton'"):
        square_samples(one_device, "halton", range(1), range(1), 0)


def test_no_points_give_no_samples(device):
    u, v = square_samples(device, "sobol", range(0), range(5), 0)
    assert u.shape == v.shape == (0, 5)


NESTED_KERNEL = """
kernel void nested(const uint count, const uint bounce, global float *result) {
  const uint first = (uint)get_global_id(0) * VEC;
  if (first >= count) return;
  real coordinates[5];
  sample_nested((bits)7, LANE_NUMBER + first, 0u, bounce, 1u, 2u, coordinates);
  for (uint row = 0; row < 5; ++row) STORE(coordinates[row], result + row * count + first);
}
"""


@pytest.mark.parametrize("sampler", SAMPLERS)
def test_coordinates_of_bounces_are_uniform_and_independent(device, sampler):
    count, bounces = 1024, 6
    kernel = bare_kernel(
        device, ("common", "sampler"), sampler_defines(sampler), NESTED_KERNEL, "nested"
    )
    result = HostArray(device, (5, count), np.float32)
    found = []
    for bounce in range(1, bounces + 1):
        kernel(count // device.vector_width, count=count, bounce=bounce, result=result)
        found.append(result.read())
    coordinates = np.concatenate(found)
    assert (coordinates >= 0).all() and (coordinates < 1).all()
    for row in coordinates:
        assert stats.kstest(row, "uniform").pvalue > 1e-4
    if sampler == "sobol":
        # From the third bounce on each pair is a net: one point in each of 32 x 32 cells.
        for pair in range(0, 4, 2):
            cells = (found[2][pair : pair + 2] * 32).astype(int)
            assert len(set(map(tuple, cells.T))) == count
        # Before, each coordinate is, in as many parts as there are points.
        for row in np.concatenate([one[:4] for one in found[:2]]):
            assert len(set((row * count).astype(int))) == count
    # No two of different pairs go together: correlations stay within their deviations.
    correlation = np.corrcoef(coordinates)[np.triu_indices(len(coordinates), 1)]
    assert np.abs(correlation).max() < 5.5 / np.sqrt(count)


SOBOL_KERNEL = """
kernel void dimensions(const uint count, global const uint *index, global uint *result) {
  const uint first = (uint)get_global_id(0) * VEC;
  if (first >= count) return;
  for (uint k = 2; k < SOBOL_DIMENSIONS; ++k)
    STORE(reverse_bits(sobol_reversed(LOAD(index + first), k)), result + (k - 2) * count + first);
}
"""


def test_dimensions_are_those_of_joe_and_kuo(device):
    """As scipy has them, whose points come in the order of the Gray code."""
    count = 1 << 12
    exact = stats.qmc.Sobol(10, scramble=False, bits=32).random(count)
    gray = np.arange(count, dtype=np.uint32)
    gray ^= gray >> np.uint32(1)
    kernel = bare_kernel(
        device, ("common", "sampler"), sampler_defines("sobol"), SOBOL_KERNEL, "dimensions"
    )
    result = HostArray(device, (8, count), np.uint32)
    kernel(count // device.vector_width, count=count, index=HostArray.of(device, gray), result=result)
    np.testing.assert_array_equal(result.read().T, (exact[:, 2:] * 2.0**32).astype(np.uint32))
    single = np.uint32(1) << np.arange(32, dtype=np.uint32)
    kernel(32 // device.vector_width, count=32, index=HostArray.of(device, single), result=result)
    found = result.read().ravel()[: 8 * 32].reshape(8, 32)
    np.testing.assert_array_equal(found, direction_numbers())


# Joe's and Kuo's table (new-joe-kuo-6.21201): degree, inner coefficients, first odd numbers.
JOE_KUO = [
    (2, (1,), (1, 3)), (3, (0, 1), (1, 3, 1)), (3, (1, 0), (1, 1, 1)), (4, (0, 0, 1), (1, 1, 3, 3)),
    (4, (1, 0, 0), (1, 3, 5, 13)), (5, (0, 0, 1, 0), (1, 1, 5, 5, 17)),
    (5, (0, 1, 0, 0), (1, 1, 5, 5, 5)), (5, (0, 1, 1, 1), (1, 1, 7, 11, 19)),
]  # fmt: skip


def direction_numbers():
    """Of the dimensions 2 to 9, uint32 (8, 32), by the recurrence of odd numbers (Joe and Kuo 2008)."""
    numbers = []
    for degree, inner, first in JOE_KUO:
        odd = list(first)
        for k in range(degree, 32):
            following = odd[k - degree] ^ odd[k - degree] << degree
            for j, coefficient in enumerate(inner, 1):
                following ^= coefficient * odd[k - j] << j
            odd.append(following)
        numbers.append([one << 31 - k for k, one in enumerate(odd)])
    return np.array(numbers, np.uint32)
