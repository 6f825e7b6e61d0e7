"""Numbers of network and schedule that were measured; each names the script that finds it again.

``python bench/bench_tuning.py NAME`` prints what other values do to error times processor time.
"""

from __future__ import annotations

# Neurons of the two hidden layers: the default's, which integrate and evaluate for a third of what the
# wide network's cost, and those of the least residual: python bench/bench_tuning.py HIDDEN WIDE_HIDDEN.
HIDDEN = (8, 8)
WIDE_HIDDEN = (16, 16)
# The hash grid: levels, features a level, cells an axis of the coarsest, entries of a level's table:
# python bench/bench_tuning.py GRID_LEVELS GRID_FEATURES GRID_BASE GRID_ENTRIES.
GRID_LEVELS = 6
GRID_FEATURES = 8
GRID_BASE = 4
GRID_ENTRIES = 1 << 16
# The schedule: training points a minibatch, samples of each that a step sees, uses of a sample, Adam's
# first and last step size, and the weight of the past in the average of parameters: python
# bench/bench_train.py varies them at equal training seconds, and in whole renders python
# bench/bench_tuning.py BATCH SAMPLES_A_STEP EPOCHS RATE FINAL_RATE AVERAGE_DECAY.
BATCH = 64
SAMPLES_A_STEP = 16
EPOCHS = 8
RATE = 1e-2
FINAL_RATE = 1e-3
AVERAGE_DECAY = 0.99
# Adam's constants; the table's step size over the network's, and the weight of the past in its second
# moment; the power of a point's factor that its samples weigh: python bench/bench_tuning.py BETA1 BETA2
# TABLE_RATE TABLE_BETA2 WEIGHT_POWER.
BETA1 = 0.9
BETA2 = 0.99
TABLE_RATE = 5.0
TABLE_BETA2 = 0.9
WEIGHT_POWER = 0.5
