"""Numbers of sampling that were measured; each names the script that finds it again.

``python bench/bench_tuning.py NAME`` prints what other values do to error times processor time.
"""

from __future__ import annotations

# Russian roulette: from which bounce on, and at which multiple of its throughput a path goes on; where
# the mean of what is ended is known, of its deviation from that (Guide.needs) times the throughput; the
# fewest that go on then, and the most: python bench/bench_tuning.py ROULETTE GUIDED_ROULETTE
# LEAST_SURVIVE MOST_SURVIVE. Where a surface's albedo squared is more than MOST_SURVIVE, what paths
# bring between such surfaces has no finite variance.
ROULETTE = (2, 2.0)
GUIDED_ROULETTE = (2, 6.0)
LEAST_SURVIVE = 0.05
MOST_SURVIVE = 0.99
# Paths behind the second vertex of a guided path, since what is left of a sample's variance is mostly
# theirs: python bench/bench_tuning.py BRANCHES.
BRANCHES = 2

# Points that share paths, and groups that points which lie together are dealt to in turn:
# python bench/bench_tuning.py MEMBERS GROUP_WINDOW.
MEMBERS = 8
GROUP_WINDOW = 8
# The part of paths' mean square that sharing leaves to each point (OwnNoise.part), above which a block's
# points share none: python bench/bench_gi_equal.py --sharing prints it of rooms, hills and leaves, and
# what sharing does there; of other values python bench/bench_tuning.py MOST_OWN.
MOST_OWN = 0.5

# What guides paths: boxes along each axis of the scene, a power of two, the part of every density that
# is uniform, and the samples that what is known of coarser boxes counts for:
# python bench/bench_tuning.py GUIDE_SIDE GUIDE_UNIFORM_SHARE GUIDE_PRIOR_SAMPLES.
GUIDE_SIDE = 8
GUIDE_UNIFORM_SHARE = 0.3
GUIDE_PRIOR_SAMPLES = 16.0
