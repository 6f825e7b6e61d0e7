"""Where passes begin and end."""

from __future__ import annotations

import pytest

from ncv_cl.estimation.passes import pass_edges


@pytest.mark.parametrize(
    ("samples", "expected"),
    [
        (512, [0, 128, 256, 384, 512]),
        (300, [0, 128, 300]),
        (330, [0, 128, 256, 330]),
        (96, [0, 48, 96]),
        (2, [0, 1, 2]),
        (1, [0, 1]),
    ],
)
def test_passes_are_alike_and_two_at_least(samples, expected):
    assert pass_edges(samples, 128) == expected
