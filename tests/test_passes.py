"""Where passes begin and end."""

from __future__ import annotations

import pytest

from ncv_cl.estimation.passes import pass_edges


@pytest.mark.parametrize(
    ("samples", "first", "expected"),
    [
        (512, None, [0, 128, 256, 384, 512]),
        (300, None, [0, 128, 300]),
        (330, None, [0, 128, 256, 330]),
        (96, None, [0, 48, 96]),
        (2, None, [0, 1, 2]),
        (1, None, [0, 1]),
        (256, 16, [0, 16, 128, 256]),
        (96, 16, [0, 16, 96]),
        (16, 16, [0, 8, 16]),
        (1, 16, [0, 1]),
    ],
)
def test_passes_are_alike_and_two_at_least(samples, first, expected):
    assert pass_edges(samples, 128, first) == expected


def test_a_first_pass_leaves_the_others_where_they_are():
    assert set(pass_edges(1000, 128)) | {16} == set(pass_edges(1000, 128, 16))
