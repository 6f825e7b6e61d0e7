"""Numbers of the estimate that were measured; each names the script that finds it again.

``python bench/bench_tuning.py NAME`` prints what other values do to error times processor time.
"""

from __future__ import annotations

import math

# Samples of an image, samples a point times lit points, from which on a control variate reaches plain
# Monte Carlo's error sooner, training included; of paths that kernels trace, samples a point, beside
# those of the image. On PoCL 3.1 with AVX-512, python bench/bench_method.py
# printed:
#
#     LIGHT_SAMPLES_THAT_PAY = math.inf
#       this     : ratio 0.99 at worst, 1.00 mean
#       mc       : ratio 0.99 at worst, 1.00 mean
#       ncv      : ratio 0.12 at worst, 0.47 mean
#     NOISY_SAMPLES_THAT_PAY = 1 << 20
#       this     : ratio 0.84 at worst, 1.00 mean
#       mc       : ratio 0.54 at worst, 0.94 mean
#       ncv      : ratio 0.18 at worst, 0.73 mean
#     SAMPLES_THAT_PAY = 1 << 23
#       this     : ratio 0.97 at worst, 1.00 mean
#       mc       : ratio 0.81 at worst, 0.98 mean
#       ncv      : ratio 0.32 at worst, 0.69 mean
#     QUICK_PATHS_THAT_PAY = 1 << 9
#       this     : ratio 1.00 at worst, 1.00 mean
#       mc       : ratio 0.74 at worst, 0.98 mean
#       ncv      : ratio 0.35 at worst, 0.65 mean
#     SLICES_THAT_PAY = math.inf
#       this     : ratio 1.00 at worst, 1.00 mean
#       mc       : ratio 1.00 at worst, 1.00 mean
#       ncv      : ratio 0.14 at worst, 0.41 mean
#
# PATHS_THAT_PAY: at 64 x 64 points, two or three seeds, processor seconds of a busy machine. With
# 2^18 paths a control variate's variance times seconds is 0.56 to 0.91 of plain paths' in seven scenes,
# and 1.08 in `gloss` of bench/rooms.py; with 2^20 paths 0.4 to 0.8, and 1.08 in foliage
# (python bench/bench_auto.py --integrand gi tells it of scenes anew).
#
# A ratio is the sooner method's seconds to the same error over those of what is chosen: 1 is best. With
# 65536 samples a point of direct light, plain Monte Carlo's is 0.63 in the Cornell box, and the control
# variate's 0.39 in `interior`. The table is bench/results/method.json (--table prints it).
SAMPLES_THAT_PAY = 1 << 23
NOISY_SAMPLES_THAT_PAY = 1 << 20
PATHS_THAT_PAY = 1 << 18
QUICK_PATHS_THAT_PAY = 1 << 9
LIGHT_SAMPLES_THAT_PAY = math.inf
SLICES_THAT_PAY = math.inf

# Of paths, in whatever number: lights, beyond which a network leaves their noise, and what lobes reflect
# over what matte parts do: python bench/bench_auto.py --integrand gi, and
# of other values python bench/bench_tuning.py LIGHTS_OF_A_NETWORK LOBES_OF_A_NETWORK.
LIGHTS_OF_A_NETWORK = 16
LOBES_OF_A_NETWORK = 1.0

# Samples go as this power of the residual's predicted magnitude. Independent samples would want 1, well
# spread ones, whose error falls faster than 1 / n, a little less: python bench/bench_tuning.py
# MAGNITUDE_POWER.
MAGNITUDE_POWER = 0.9
# A point whose residual is predicted to be nothing still gets so many, a power of two: predictions are
# not certainties. No point gets more than this multiple of the average: python bench/bench_tuning.py
# FEWEST_SAMPLES LARGEST_MULTIPLE.
FEWEST_SAMPLES = 4
LARGEST_MULTIPLE = 64
# Samples a point that the points' variances are learned from, at most, and as a part of all: python
# bench/bench_tuning.py PILOT_SAMPLES PILOT_SHARE.
PILOT_SAMPLES = 64
PILOT_SHARE = 1 / 4

# Samples a point of direct light that is estimated apart, at least, over the root of those of the rest;
# its mean square error over the rest's, above which it gets more; and then its samples over those of the
# rest, at most: python bench/bench_tuning.py DIRECT_SAMPLES DIRECT_ERROR MOST_DIRECT.
DIRECT_SAMPLES = 8.0
DIRECT_ERROR = 1 / 32
MOST_DIRECT = 4

# Points that are estimated a second time: a share of all, within bounds, and of a small image no larger
# share than the last: python bench/bench_tuning.py TWICE_SHARE FEWEST_TWICE MOST_TWICE
# LARGEST_TWICE_SHARE prints how well variances fit the errors.
TWICE_SHARE = 1 / 32
FEWEST_TWICE = 256
MOST_TWICE = 4096
LARGEST_TWICE_SHARE = 1 / 4
# Values that a point of the variance's curve is estimated from, at least; points of the curve, at most:
# python bench/bench_tuning.py VALUES_A_CLASS MOST_CLASSES.
VALUES_A_CLASS = 96
MOST_CLASSES = 16
# A prior of the variance counts as much as so many samples: python bench/bench_tuning.py PRIOR_SAMPLES.
PRIOR_SAMPLES = 12
# What neighbours say is a mean over so many sub-pixels to each side; and of what is expected of a
# point's error, the part that its own halves say, the rest being its neighbours': python
# bench/bench_tuning.py LOCAL_RADIUS OWN_SHARE.
LOCAL_RADIUS = 3
OWN_SHARE = 0.3
