/* The control coefficient alpha: covariance of f and g over the training samples of each column.
 *
 * Memory layout: samples as in train.cl: number s of column i is u, v [s * stride + i], and f in plane
 * s * CHANNELS + c of `all_targets`. `moments` has a plane of `stride` floats for each channel's sum
 * over the column's samples of (f - mean f)(g - mean g), then one for each channel's sum of (g - mean
 * g)^2.
 *
 * Joined after mlp.cl.
 *
 * Work-group contract: one-dimensional, any size, no local memory, no barriers. column_moments: a
 * work-item a column. scale_outputs: a work-item a point.
 */

real load_samples(global const float *restrict rows, const uint first, const uint samples, const ulong stride) {
  float values[VEC];
  for (uint k = 0; k < VEC; ++k) values[k] = rows[min(first + k, samples - 1) * stride];
  return LOAD(values);
}

kernel void column_moments(const uint count, const uint stride, const uint samples,
                           global const uint *restrict order, global const float *restrict all_u,
                           global const float *restrict all_v, global const float *restrict all_targets,
                           NETWORK_ARGUMENTS, global float *restrict moments) {
  const uint column = (uint)get_global_id(0);
  if (column >= count) return;
  const PointNetwork network = NETWORK_OF(order[column]);
  /* Sums are of differences to values near the means, so that little is lost to rounding. */
  real f_shift[CHANNELS], g_shift[CHANNELS], f_sum[CHANNELS], g_sum[CHANNELS], product[CHANNELS], square[CHANNELS];
#pragma unroll
  for (uint c = 0; c < CHANNELS; ++c)
    f_sum[c] = g_sum[c] = product[c] = square[c] = f_shift[c] = g_shift[c] = (real)0.0f;
  for (uint first = 0; first < samples; first += VEC) {
    const whole valid = LANE_NUMBER + first < samples;
    real g[CHANNELS];
    network_value(&network, load_samples(all_u + column, first, samples, stride),
                  load_samples(all_v + column, first, samples, stride), g);
#pragma unroll
    for (uint c = 0; c < CHANNELS; ++c) {
      const real f = load_samples(all_targets + c * (ulong)stride + column, first, samples, CHANNELS * (ulong)stride);
      if (first == 0) {
        f_shift[c] = (real)(sum_lanes(f) / VEC);
        g_shift[c] = (real)(sum_lanes(g[c]) / VEC);
      }
      const real f_distance = SELECT((real)0.0f, f - f_shift[c], valid);
      const real g_distance = SELECT((real)0.0f, g[c] - g_shift[c], valid);
      f_sum[c] += f_distance;
      g_sum[c] += g_distance;
      product[c] = FMA(f_distance, g_distance, product[c]);
      square[c] = FMA(g_distance, g_distance, square[c]);
    }
  }
#pragma unroll
  for (uint c = 0; c < CHANNELS; ++c) {
    const float f_total = sum_lanes(f_sum[c]);
    const float g_total = sum_lanes(g_sum[c]);
    moments[c * (ulong)stride + column] = sum_lanes(product[c]) - f_total * g_total / (float)samples;
    moments[(CHANNELS + c) * (ulong)stride + column] =
        fmax(sum_lanes(square[c]) - g_total * g_total / (float)samples, 0.0f);
  }
}

/* g becomes alpha g at every point: `alpha` has a plane of `count` floats a channel. */
kernel void scale_outputs(const uint count, global const float *restrict alpha, global float *restrict w3,
                          global float *restrict b3) {
  const uint point = (uint)get_global_id(0);
  if (point >= count) return;
  for (uint c = 0; c < CHANNELS; ++c) {
    const float own = alpha[c * (ulong)count + point];
    global float *restrict row = w3 + (ulong)point * STRIDE_W3 + c * HIDDEN2;
    for (uint j = 0; j < HIDDEN2; ++j) row[j] *= own;
    b3[(ulong)point * STRIDE_B3 + c] *= own;
  }
}
