/* Coordinates of samples for integrands that are evaluated on the host: points of the unit square,
 * uniform or, with WARPED (warp.cl or warp_triangles.cl joined before), by each point's record in
 * `density`.
 *
 * Layout as in samples.cl: sample s of batch point p is element p * stride + s of `u`, `v` and `weight`;
 * batch point p is point order[first_point + p], its random numbers those of point first_id more.
 *
 * Work-group contract: one-dimensional, any size, no local memory, no barriers; one work-item handles
 * VEC consecutive samples of one point.
 */

kernel void draw_coordinates(const uint first_point, const uint point_count, const uint first_id,
                             const uint first_sample,
                             const uint stride, const uint stream, const uint seed_low, const uint seed_high,
                             global const uint *restrict order,
#if WARPED
                             global const uint *restrict density, global float *restrict weight,
#endif
                             global float *restrict u, global float *restrict v) {
  const uint blocks = stride / VEC;
  const uint item = (uint)get_global_id(0);
  if (item >= point_count * blocks) return;
  const uint point = order[first_point + item / blocks];
  const ulong at = (ulong)(item / blocks) * stride + (item % blocks) * VEC;
  real sample_u, sample_v;
  sample_square(point + first_id, LANE_NUMBER + (first_sample + (item % blocks) * VEC), stream, seed_low, seed_high, &sample_u,
                &sample_v);
#if WARPED
  global const uint *record = density + (ulong)RECORD_NUMBER(point, item / blocks) * DENSITY_WORDS;
  STORE(warp_square(record, &sample_u, &sample_v), weight + at);
#endif
  STORE(sample_u, u + at);
  STORE(sample_v, v + at);
}
