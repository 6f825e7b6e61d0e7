/* What slices cost in a scene: how many leaves of its triangles some of them walk through, and how many are given up.
 *
 * Joined after slices.cl. Slice k of `slice_count` is taken at shading point k * point_count / slice_count, at the
 * azimuth that multiples of the golden ratio give it; `leaves` gets the leaves that it met, `refused` 1 where there was
 * no room for what is blocked, else 0. Counts, not seconds, so that what is decided by them is the same in every run.
 *
 * Work-group contract: one-dimensional, any size, no local memory, no barriers; one work-item a slice.
 */

kernel void count_leaves(const uint slice_count, const uint point_count, const uint total_points, const float radius,
                         global const float *restrict surface, const float unit,
                         global const uint *restrict levels, global const float *restrict boxes,
                         global const float *restrict triangles, global uint *restrict leaves,
                         global uint *restrict refused) {
  const uint item = (uint)get_global_id(0);
  if (item >= slice_count) return;
  const uint point = (uint)((ulong)item * point_count / slice_count);
  const ShadingPoint p = load_shading_point(surface, total_points, point);
  /* 2^32 over the golden ratio; the product wraps around. */
  const float turn = (float)((item * 2654435769u) >> 8) / (float)(1 << 24);
  Slice slice = slice_at(&p, radius, unit, turn);
  refused[item] = walk_slice(&slice, levels, boxes, triangles) ? 0u : 1u;
  leaves[item] = slice.leaves;
}
