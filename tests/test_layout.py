"""Records: kernels and the host find the same numbers under the same names."""

from __future__ import annotations

import numpy as np
import pytest
from reference import bare_kernel

from ncv_cl.opencl.layout import Record
from ncv_cl.opencl.memory import HostArray

LAMP = Record("LAMP", {"corner": 3, "power": 1, "tint": 2}, multiple=4)
COUNTS = Record("COUNT", {"first": 1, "rest": 2}, np.uint32)
KERNEL = """
kernel void fields(global const float *lamps, global const uint *counts, global float *result) {
  const uint i = (uint)get_global_id(0);
  if (i >= 5u) return;
  global const float *lamp = lamps + i * LAMP_FLOATS;
  global const uint *count = counts + i * COUNT_WORDS;
  result[4 * i] = lamp[LAMP_CORNER + 2];
  result[4 * i + 1] = lamp[LAMP_POWER];
  result[4 * i + 2] = lamp[LAMP_TINT + 1];
  result[4 * i + 3] = (float)(count[COUNT_FIRST] + count[COUNT_REST + 1]);
}
"""


def test_names_are_those_of_the_fields_and_sizes_are_padded():
    assert LAMP.defines() == {"LAMP_CORNER": 0, "LAMP_POWER": 3, "LAMP_TINT": 4, "LAMP_FLOATS": 8}
    assert COUNTS.defines() == {"COUNT_FIRST": 0, "COUNT_REST": 1, "COUNT_WORDS": 3}
    assert list(LAMP) == ["corner", "power", "tint"]
    assert (LAMP.size, LAMP["tint"], COUNTS["first"]) == (8, slice(4, 6), slice(0, 1))


def test_values_are_packed_in_order_and_broadcast():
    corner = np.arange(6.0).reshape(2, 3)
    packed = LAMP.pack(tint=[7, 8], corner=corner, power=[0.1, 0.2])
    assert packed.dtype == np.float32
    expected = np.array([[0, 1, 2, 0.1, 7, 8, 0, 0], [3, 4, 5, 0.2, 7, 8, 0, 0]])
    np.testing.assert_array_equal(packed, expected.astype(np.float32))
    np.testing.assert_array_equal(LAMP.pack(corner=corner[1], power=0.2, tint=[7, 8]), packed[1])
    words = COUNTS.pack(first=[[1, 2]], rest=[2**32 - 1, 5])
    assert words.dtype == np.uint32 and words.tolist() == [[[1, 2**32 - 1, 5], [2, 2**32 - 1, 5]]]


@pytest.mark.parametrize(
    ("values", "error", "message"),
    [
        ({"corner": [0, 0, 0], "power": 1}, TypeError, "LAMP has .* corner, power, tint: see tint"),
        ({"corner": [0, 0, 0], "power": 1, "tint": [0, 0], "hue": 1}, TypeError, "see hue"),
        (
            {"corner": [0], "power": 1, "tint": [0, 0]},
            ValueError,
            r"corner is 3 numbers, .* \(1,\)",
        ),
        (
            {"corner": 1.0, "power": 1, "tint": [0, 0]},
            ValueError,
            r"corner is 3 numbers, .* \(\)",
        ),
        ({"corner": [0, 0, 0], "power": 1, "tint": np.zeros((4, 3))}, ValueError, "tint is 2 numbers"),
    ],
)
def test_what_does_not_fit_is_refused(values, error, message):
    with pytest.raises(error, match=message):
        LAMP.pack(**values)


def test_kernels_find_what_the_host_packed(device):
    generator = np.random.default_rng(0)
    corner, power = generator.random((5, 3), np.float32), generator.random(5, np.float32)
    tint, first = generator.random((5, 2), np.float32), np.arange(5)
    rest = np.stack([first * 100, first * 10], 1)
    lamps = LAMP.pack(corner=corner, power=power, tint=tint)
    kernel = bare_kernel(device, ("common",), {**LAMP.defines(), **COUNTS.defines()}, KERNEL, "fields")
    result = HostArray(device, (5, 4), np.float32)
    counts = HostArray.of(device, COUNTS.pack(first=first, rest=rest))
    kernel(5, lamps=HostArray.of(device, lamps), counts=counts, result=result)
    found = result.read().T
    for column, expected in zip(found, (corner[:, 2], power, tint[:, 1], 11 * first), strict=True):
        np.testing.assert_array_equal(column, expected)
    np.testing.assert_array_equal(lamps[:, LAMP["corner"]], corner)
