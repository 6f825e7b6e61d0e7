"""Numbers of training that were measured; each names the script that finds it again.

``python bench/bench_tuning.py NAME`` prints what other values do to error times processor time.
"""

from __future__ import annotations

# Samples of the first round and of all rounds at most; each round has about as many as all before:
# python bench/bench_tuning.py FIRST_ROUND MOST_TRAINING_SAMPLES.
FIRST_ROUND = 1 << 17
MOST_TRAINING_SAMPLES = 1 << 21
# Training samples over samples of the estimate, at most: python bench/bench_tuning.py
# LARGEST_TRAINING_SHARE.
LARGEST_TRAINING_SHARE = 0.25
# Samples of a point in a round with fewer than that on average. More at fewer points leave about the
# same residual, and points cost their gather lists: python bench/bench_tuning.py SAMPLES_A_POINT.
SAMPLES_A_POINT = 32
# Points that are held out, and the part of all points that may be: python bench/bench_tuning.py
# HELD_OUT_POINTS HELD_OUT_SHARE.
HELD_OUT_POINTS = 512
HELD_OUT_SHARE = 1 / 16
# What one use of a training sample costs, and one traced ray, in residual samples whose visibility is
# tested on the device; and the power of the residual's variance that the samples go as which the
# estimate needs. They decide whether another round pays: python bench/bench_tuning.py USE_COST RAY_COST
# GAIN. Never what the clock says, since a render must be the same again.
USE_COST = 8.0
RAY_COST = 3.0
GAIN = 0.25

# How often a sample is used with `train_spp` "auto": python bench/bench_tuning.py AUTO_EPOCHS.
AUTO_EPOCHS = 2
# Samples in all with "auto" where held-out variance does not decide, as for nested integrands: python
# bench/bench_tuning.py UNDECIDED_SAMPLES.
UNDECIDED_SAMPLES = 1 << 19
# Few points make few steps of an epoch; samples are used more often then, up to so often. Points that
# fit one minibatch bear many steps; where there are more, with few samples each, the network soon knows
# the samples by heart: python bench/bench_tuning.py FEWEST_STEPS FEWEST_STEPS_OF_ONE_BATCH MOST_EPOCHS.
FEWEST_STEPS = 64
FEWEST_STEPS_OF_ONE_BATCH = 512
MOST_EPOCHS = 128

# Columns of a minibatch that one work-group holds, at most, and the bytes of cache they may take on a
# CPU. There, small tiles share a step's columns among more threads: python bench/bench_tuning.py
# CPU_TILE CPU_LOCAL_BYTES.
CPU_TILE = 16
CPU_LOCAL_BYTES = 256 << 10

# Samples of a step for each compute unit of a GPU: a warp for each of its four schedulers. What
# minibatches so large leave of the residual: python bench/bench_growth.py.
GPU_STEP_ITEMS = 128

# A tile of the image has about so many training samples, whose points share one control coefficient a
# channel: python bench/bench_tuning.py SAMPLES_A_TILE.
SAMPLES_A_TILE = 256
# Samples that speak for a coefficient of 1, whatever was seen: python bench/bench_tuning.py
# PSEUDO_SAMPLES.
PSEUDO_SAMPLES = 32
# Below the least coefficient the network is worth less than it costs, and counts as nothing; what is far
# above 1 was seen by chance: python bench/bench_tuning.py SMALLEST_COEFFICIENT LARGEST_COEFFICIENT.
SMALLEST_COEFFICIENT = 0.1
LARGEST_COEFFICIENT = 2.0

# The network that predicts the residual's magnitude: hidden units (a multiple of 16), training points a
# minibatch, samples of each that a step sees, steps, uses of a sample at most, Adam's first and last
# step size and its constants, and the part of the density that is uniform: python bench/bench_tuning.py
# DENSITY_HIDDEN DENSITY_COLUMNS DENSITY_SAMPLES_A_STEP DENSITY_STEPS DENSITY_EPOCHS DENSITY_RATE
# DENSITY_FINAL_RATE DENSITY_BETA1 DENSITY_BETA2 DENSITY_UNIFORM_SHARE.
DENSITY_HIDDEN = 32
DENSITY_COLUMNS = 128
DENSITY_SAMPLES_A_STEP = 16
DENSITY_STEPS = 640
DENSITY_EPOCHS = 8
DENSITY_RATE = 1e-2
DENSITY_FINAL_RATE = 1e-3
DENSITY_BETA1 = 0.9
DENSITY_BETA2 = 0.99
DENSITY_UNIFORM_SHARE = 0.1
