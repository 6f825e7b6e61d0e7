"""Samples along lines on the lights, whose visible part is found exactly: lines.cl."""

from __future__ import annotations

from . import tuning

# Kernel files of samples along lines, after that of shafts.
LINE_FILES = ("gaps", "lines", "walk", "along")


def lines_pay(occluders: float, samples: int) -> bool:
    """Whether lines reach an error sooner than points, with so many triangles before the lights on average.

    What stands before a point's lights is found once for all lines that are drawn together, so what a
    line costs falls with their number; their error falls faster than that of points. So lines pay from
    a number of samples a point on, which grows with the triangles.
    """
    return occluders <= tuning.OCCLUDERS_A_LINE * samples


def line_defines() -> dict[str, str]:
    """The `-D` constants of lines.cl, beside those of shaft.cl."""
    return {
        "MOST_GAPS": f"{tuning.MOST_GAPS}u",
        "SORTED_FROM": f"{tuning.SORTED_FROM}u",
        "BLOCKS_A_ITEM": f"{tuning.LINE_BLOCKS}u",
    }
