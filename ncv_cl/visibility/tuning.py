"""Numbers of visibility that were measured; each names the script that finds it again.

``python bench/bench_tuning.py NAME`` prints what other values do to error times processor time.
"""

from __future__ import annotations

# Of more lights the shafts are not looked for: they cost by their number, and together hold something
# nearly everywhere, so that rays are traced all the same: python bench/bench_tuning.py MOST_LIGHTS, in a
# hall with pillars.
MOST_LIGHTS = 8
# Blocks of VEC rays of one point that one work-item draws and tests: python bench/bench_tuning.py
# BLOCKS_A_ITEM.
BLOCKS_A_ITEM = 4
# Triangles of a scene whose paths' shadow rays are each tested against all of them instead of traced:
# python bench/bench_tuning.py MOST_CASTERS, on a Cornell box cut into 128 triangles.
MOST_CASTERS = 128
