"""Numbers of sampling that were measured; each names the script that finds it again.

``python bench/bench_tuning.py NAME`` prints what other values do to error times processor time.
"""

from __future__ import annotations

# What guides paths: boxes along each axis of the scene, the part of every density that is uniform, and
# the samples that what is known of a cell, and of all cells, counts for: python bench/bench_tuning.py
# GUIDE_SIDE GUIDE_UNIFORM_SHARE GUIDE_PRIOR_SAMPLES.
GUIDE_SIDE = 8
GUIDE_UNIFORM_SHARE = 0.3
GUIDE_PRIOR_SAMPLES = 8.0
