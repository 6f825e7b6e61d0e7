"""Schedules at equal seconds."""

from __future__ import annotations

import pytest
from schedules import at_equal_seconds, schedule_table


def row(schedule, seconds, residual):
    return {"schedule": schedule, "seconds": seconds, "residual": residual}


ROWS = [
    row("default", 1.0, 0.4),
    row("default", 4.0, 0.2),
    row("twice as slow", 2.0, 0.4),
    row("twice as slow", 8.0, 0.2),
]


def test_curves_are_compared_at_the_same_seconds():
    found = at_equal_seconds(ROWS)
    assert found["default"] == pytest.approx([1.0, 1.0])
    # Its first run is later than the default's; at four seconds it is half way, by logarithms.
    assert found["twice as slow"] == pytest.approx([1.0, 2**0.5])


def test_the_table_has_a_line_a_schedule():
    head, *lines = schedule_table({"a scene": ROWS})
    assert "a scene" in head and len(lines) == 2
    assert lines[1].split() == ["twice", "as", "slow", "1.000", "/", "1.414", "1.189"]
