"""Numbers of integrands that were measured; each names the script that finds it again.

``python bench/bench_tuning.py NAME`` prints what other values do to error times processor time.
"""

from __future__ import annotations

# Lights whose sides make less than this part of the distance to their middle (the root of the sum of
# squares) are sampled by area. By less, samples of those where shadows are all of the error cost more
# than they gain: python bench/bench_tuning.py SMALL_LIGHT.
SMALL_LIGHT = 1.0
# Part of the unit square that all lights share alike: one step a light. With half of it the variance of
# `interior` is 1.7 times as large and that of a hall of 1,000 lamps 2.4 times; with less a light would
# be left out, or steps would be finer than those of few Sobol points: python bench/bench_lights.py
# --equal 0.125 0.25 0.5, and in whole renders python bench/bench_tuning.py EQUAL_PART.
EQUAL_PART = 0.25
# Shares of the unit square that the lobe may have: eighths, so that strips stay on the dyadic grid. The
# most leaves the lights an eighth: where the lobe alone does better, that costs a seventh more samples.
# There is a strip where it is predicted to divide the second moment by LOBE_GAIN: lights' samples are
# smooth in the square, so Sobol points gain more with them than with directions, which meet a light or
# do not. Or where a direction to a light is LOBE_NEED times denser in the lobe than among the light's
# samples: these would have values that large, however little the light brings. All by python
# bench/lobe_shares.py, and in whole renders python bench/bench_tuning.py LOBE_SHARES LOBE_GAIN
# LOBE_NEED.
LOBE_SHARES = (0.0, 0.5, 0.875)
LOBE_GAIN = 3.0
LOBE_NEED = 8.0
# What every direction of the environment that is not black has in its maps beside its own radiance, of
# the mean: so that what is in front of the bright parts does not leave the rest to few samples. And the
# least weight of a map's cell that some surface's hemisphere reaches into, of the most that it can have.
# Both by python bench/bench_tuning.py SKY_EQUAL_PART SKY_LEAST_WEIGHT.
SKY_EQUAL_PART = 0.05
SKY_LEAST_WEIGHT = 0.1
