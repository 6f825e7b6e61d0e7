"""Samples along lines on the lights, whose visible part is found exactly: lines.cl."""

from __future__ import annotations

from ..opencl.device import Device

# All by ``python bench/bench_lines.py constants``, on a CPU with PoCL 3.1.
# Free parts of a line that are kept apart; a line with more leaves its sample to be tested as a point.
# In the shipped scenes none has more than 16, and one in 10,000 more than 8; room costs no time.
MOST_GAPS = 16
# Occluders that are listed at most for a point: by work-items of vectors, and by a GPU's many, each of
# which has its list at hand while it looks for them. No point of the shipped scenes has more than 848;
# where all triangles of occluders are cut into four, lines still pay, and none has more than 4095.
MOST_ON_LINES = {"vector": 4095, "single": 1023}
# Blocks of VEC lines of one point that one work-item draws: the more, the nearer are neighbours.
LINE_BLOCKS = 16
# Occluders from which on lines are brought in order. From 2 to 48 no difference was to be seen.
SORTED_FROM = 12


def most_on_lines(device: Device) -> int:
    """Occluders that are listed at most for a point whose samples are to lie along lines."""
    return MOST_ON_LINES["vector" if device.vector_width > 1 else "single"]


def line_defines() -> dict[str, str]:
    """The `-D` constants of lines.cl, beside those of shaft.cl."""
    return {
        "MOST_GAPS": f"{MOST_GAPS}u",
        "SORTED_FROM": f"{SORTED_FROM}u",
        "BLOCKS_A_ITEM": f"{LINE_BLOCKS}u",
    }
