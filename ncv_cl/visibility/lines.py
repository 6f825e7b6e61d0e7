"""Samples along lines on the lights, whose visible part is found exactly: lines.cl."""

from __future__ import annotations

from . import tuning

# Kernel files of samples along lines, after that of shafts.
LINE_FILES = ("gaps", "lines", "walk", "along")


def lines_pay(occluders: float, samples: int) -> bool:
    """Whether `samples` lines a point reach an error sooner than points.

    `occluders` triangles stand before a point's lights on average. They are found once for all lines
    that are drawn together, so a line costs the less the more there are; and the error of lines falls
    faster than that of points. So lines pay from a number of samples on, which grows with the triangles.
    """
    return occluders <= tuning.OCCLUDERS_A_LINE * samples


def line_defines() -> dict[str, str]:
    """The `-D` constants of lines.cl, beside those of shaft.cl."""
    return {
        "MOST_GAPS": f"{tuning.MOST_GAPS}u",
        "SORTED_FROM": f"{tuning.SORTED_FROM}u",
        "BLOCKS_A_ITEM": f"{tuning.LINE_BLOCKS}u",
    }
