/* Samples of a batch into training order: row s of `u`, `v`, plane (s * CHANNELS + c) of `target`, all with `stride`
 * columns; position[p] is the column of shading point p. One work-item VEC samples.
 *
 * Work-group contract: one-dimensional, any size, no local memory, no barriers.
 */

kernel void store_samples(const uint first_point, const uint point_count, const uint sample_count,
                          const uint batch_stride, const uint stride, const uint first_row,
                          global const uint *restrict position, global const float *restrict batch_u,
                          global const float *restrict batch_v, global const float *restrict value,
                          global const uint *restrict slot, global const uchar *restrict visible,
                          global float *restrict u, global float *restrict v,
                          global float *restrict target) {
  const uint blocks = batch_stride / VEC;
  const uint item = (uint)get_global_id(0);
  if (item >= point_count * blocks) return;
  const uint point = item / blocks;
  const uint first = (item % blocks) * VEC;
  const ulong at = (ulong)point * batch_stride + first;
  const ulong plane = (ulong)point_count * batch_stride;
  const uint column = position[first_point + point];
  float seen[VEC];
  STORE(load_visibility(slot, visible, at), seen);
  for (uint lane = 0; lane < VEC && first + lane < sample_count; ++lane) {
    const ulong row = first_row + first + lane;
    u[row * stride + column] = batch_u[at + lane];
    v[row * stride + column] = batch_v[at + lane];
    for (uint c = 0; c < CHANNELS; ++c)
      target[(row * CHANNELS + c) * stride + column] = value[c * plane + at + lane] * seen[lane];
  }
}
