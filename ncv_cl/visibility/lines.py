"""Samples along lines on the lights, whose visible part is found exactly: lines.cl."""

from __future__ import annotations

from . import tuning

# Kernel files of samples along lines, after that of shafts.
LINE_FILES = ("gaps", "lines", "walk", "along")


def lines_pay(unknown: int, points: int) -> bool:
    """Whether lines reach an error sooner than points, where `unknown` of so many points have no list.

    A line takes up to twice the time of a point, and leaves little error where the list is known.
    The error of Sobol points falls like n^-1.5: as many points as the time would buy have 2^-1.5 = 0.35
    of it. So lines pay where less than that is left, at points without a list; this asks for less than
    a quarter, since lists of many triangles take time as well.
    """
    return 4 * unknown < points


def line_defines() -> dict[str, str]:
    """The `-D` constants of lines.cl, beside those of shaft.cl."""
    return {
        "MOST_GAPS": f"{tuning.MOST_GAPS}u",
        "SORTED_FROM": f"{tuning.SORTED_FROM}u",
        "BLOCKS_A_ITEM": f"{tuning.LINE_BLOCKS}u",
    }
