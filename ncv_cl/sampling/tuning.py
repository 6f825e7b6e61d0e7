"""Numbers of sampling that were measured; each names the script that finds it again.

``python bench/bench_tuning.py NAME`` prints what other values do to error times processor time.
"""

from __future__ import annotations

# Russian roulette: from which bounce on, and at which multiple of its throughput a path goes on, plain
# and where the mean of what is ended is known; the most that go on: python bench/bench_tuning.py
# ROULETTE GUIDED_ROULETTE MOST_SURVIVE. Where a surface's albedo squared is more than MOST_SURVIVE, what
# paths bring between such surfaces has no finite variance.
ROULETTE = (2, 2.0)
GUIDED_ROULETTE = (2, 3.0)
MOST_SURVIVE = 0.99

# What guides paths: boxes along each axis of the scene, the part of every density that is uniform, and
# the samples that what is known of a cell, and of all cells, counts for: python bench/bench_tuning.py
# GUIDE_SIDE GUIDE_UNIFORM_SHARE GUIDE_PRIOR_SAMPLES.
GUIDE_SIDE = 8
GUIDE_UNIFORM_SHARE = 0.3
GUIDE_PRIOR_SAMPLES = 8.0
