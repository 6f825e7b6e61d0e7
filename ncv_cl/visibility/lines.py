"""Samples along lines on the lights, whose visible part is found exactly: lines.cl."""

from __future__ import annotations

from ..opencl.device import Device
from . import tuning

# Kernel files of samples along lines, after that of shafts.
LINE_FILES = ("gaps", "lines", "walk", "along")

# Occluders that are listed at most for a point: by work-items of vectors, and by a GPU's many, each of
# which has its list at hand while it looks for them. No point of the shipped scenes has more than 848;
# where all triangles of occluders are cut into four, lines still pay, and none has more than 4095.
MOST_ON_LINES = {"vector": 4095, "single": 1023}


def most_on_lines(device: Device) -> int:
    """Occluders that are listed at most for a point whose samples are to lie along lines."""
    return MOST_ON_LINES["vector" if device.vector_width > 1 else "single"]


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
