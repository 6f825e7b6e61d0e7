"""Samples along lines on the lights, whose visible part is found exactly: lines.cl."""

from __future__ import annotations

# Free parts of a line that are kept apart; of a line with more samples are tested as points.
MOST_GAPS = 8


def line_defines() -> dict[str, str]:
    """The `-D` constants of lines.cl, beside those of shaft.cl."""
    return {"MOST_GAPS": f"{MOST_GAPS}u"}
