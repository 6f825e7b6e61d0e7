"""Samples along lines on the lights, whose visible part is found exactly: lines.cl."""

from __future__ import annotations

# Free parts of a line that are kept apart; of a line with more samples are tested as points.
MOST_GAPS = 8

# Occluders that are listed at most for a point.
MOST_ON_LINES = 1023
# Blocks of VEC lines of one point that one work-item draws.
LINE_BLOCKS = 16
# Occluders from which on it pays to bring lines in order.
SORTED_FROM = 12


def line_defines() -> dict[str, str]:
    """The `-D` constants of lines.cl, beside those of shaft.cl."""
    return {
        "MOST_GAPS": f"{MOST_GAPS}u",
        "SORTED_FROM": f"{SORTED_FROM}u",
        "BLOCKS_A_ITEM": f"{LINE_BLOCKS}u",
    }
