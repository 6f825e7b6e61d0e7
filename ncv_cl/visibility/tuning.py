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
# Triangles of a scene whose paths' rays are each tested against all of them instead of traced:
# python bench/bench_tuning.py MOST_CASTERS, on a Cornell box cut into 128 triangles.
MOST_CASTERS = 128

# Lines on the lights. Free parts of a line that are kept apart, beyond which its sample is tested as a
# point: in the shipped scenes none has more than 16, and one in 10,000 more than 8; room costs no time.
# Blocks of VEC lines of one point that one work-item draws: the more, the nearer are neighbours.
# Occluders from which on lines are brought in order, where from 2 to 48 no difference was to be seen:
# python bench/bench_lines.py constants, and in whole renders python bench/bench_tuning.py MOST_GAPS
# LINE_BLOCKS SORTED_FROM.
MOST_GAPS = 16
LINE_BLOCKS = 16
SORTED_FROM = 12

# Occluders that are listed at most for a point on lines: lists spare a walk through boxes, which takes
# some tenth more of the time, but take memory. Triangles before the lights for which one line pays;
# where there are more to each of a point's samples points are drawn: in cut scenes lines paid with 8 to
# 90 of them: python bench/bench_lines.py large, and in whole renders
# python bench/bench_tuning.py MOST_ON_LINES OCCLUDERS_A_LINE.
MOST_ON_LINES = 1023
OCCLUDERS_A_LINE = 16

# Slices of the hemisphere. Intervals, apart from the lowest and the highest, that the union of what is
# blocked is kept in; slices that need more take rays: of the shipped scenes' a few in 100,000 at most,
# where 8 would refuse one in 1000, and room costs no time. Triangles of a box that tell along which axis
# it is halved; of more, slices are no faster: python bench/bench_slices.py constants, and in whole
# renders python bench/bench_tuning.py MOST_BLOCKED SAMPLED_TRIANGLES.
MOST_BLOCKED = 16
SAMPLED_TRIANGLES = 64
# Visibility "auto" in ambient occlusion. What a slice costs, in rays, by the leaves of triangles that it
# meets: python bench/bench_slices.py cost. Slices that are worth it at least; how many may be refused,
# over the powers of cost and number that tell; and of independent samples what a slice may cost. Samples
# of an image, over triangles, from which on boxes are built, which takes the time of 16 rays a triangle:
# python bench/bench_slices.py auto, and of other values python bench/bench_tuning.py RAYS_A_SLICE
# RAYS_A_LEAF FEWEST_SLICES MOST_REFUSED MOST_RAYS_A_SLICE SAMPLES_A_TRIANGLE.
RAYS_A_SLICE = 0.5
RAYS_A_LEAF = 0.65
FEWEST_SLICES = 8
MOST_REFUSED = 2.0
MOST_RAYS_A_SLICE = 3.0
SAMPLES_A_TRIANGLE = 64
# Where there are more than so many triangles a slice takes the time of so many rays at least, of 3.1 to
# 7.4 in rooms, on hills and among leaves, and is not looked at where so dear ones are too few: python
# bench/bench_slices.py cost, python bench/bench_tuning.py MANY_TRIANGLES LEAST_RAYS_OF_MANY.
MANY_TRIANGLES = 128
LEAST_RAYS_OF_MANY = 3.0
