/* Folding: phi is multiplied into the weights, so that each shading point has a small network of (u, v)
 * alone.
 *
 * Every group of weights that phi acts on is `base + H features(phi)`. A work-item encodes VEC points
 * (encode.cl) and multiplies: here the vector's lanes are rows of H, so that a point's weights are
 * stored as they come. `heads` is H transposed: FEATURES + 1 rows of FOLD_ROWS floats (the last row
 * multiplies the constant 1), group X from FOLD_X on, each group padded to whole vectors. Group X of
 * point p is written to x[p * STRIDE_X ...]; groups with stride 0 are not touched.
 *
 * With DEMODULATED the network has learned f over a factor (a plane of `factor_stride` floats a
 * channel), and the output layer is multiplied by it.
 *
 * Work-group contract: one-dimensional, any size, no local memory, no barriers.
 */

/* Points that are computed together: independent sums hide the latency of FMA. */
#define POINT_BLOCK (VEC < 8 ? VEC : 8)

/* The factors of rows row .. row + VEC of a group, `rows_a_channel` of which belong to each channel. */
real row_factors(global const float *restrict factor, const uint factor_stride, const uint point,
                 const uint row, const uint rows_a_channel) {
  if (rows_a_channel % VEC == 0) return (real)factor[row / rows_a_channel * (ulong)factor_stride + point];
  float each[VEC];
  for (uint k = 0; k < VEC; ++k) {
    const uint channel = min((row + k) / rows_a_channel, (uint)CHANNELS - 1);
    each[k] = factor[channel * (ulong)factor_stride + point];
  }
  return LOAD(each);
}

/* `rows` rows of the heads for points first .. min(first + VEC, end); factor: null for none. */
void fold_group(const uint rows, const uint first, const uint end, const float *features,
                global const float *restrict heads, global const float *restrict factor,
                const uint rows_a_channel, global float *restrict group) {
  for (uint row = 0; row < rows; row += VEC) {
    for (uint block = 0; block < VEC; block += POINT_BLOCK) {
      real sum[POINT_BLOCK];
#pragma unroll
      for (uint p = 0; p < POINT_BLOCK; ++p) sum[p] = LOAD(heads + FEATURES * FOLD_ROWS + row);
      UNROLL_FOR_LANES
      for (uint f = 0; f < FEATURES; ++f) {
        const real head = LOAD(heads + f * FOLD_ROWS + row);
#pragma unroll
        for (uint p = 0; p < POINT_BLOCK; ++p) sum[p] = FMA(head, (real)features[f * VEC + block + p], sum[p]);
      }
      for (uint p = 0; p < POINT_BLOCK && first + block + p < end; ++p) {
        const uint point = first + block + p;
        real values = sum[p];
        if (factor) values *= row_factors(factor, end, point, row, rows_a_channel);
        global float *restrict own = group + point * (ulong)rows + row;
        if (row + VEC <= rows) {
          STORE(values, own);
        } else {
          float each[VEC];
          STORE(values, each);
          for (uint k = 0; k < rows - row; ++k) own[k] = each[k];
        }
      }
    }
  }
}

/* The per-point groups of points 0 .. count. */
kernel void fold(const uint count, const uint total_points, const float lower_x, const float lower_y,
                 const float lower_z, const float inverse_side, global const float *restrict surface,
                 global const float *restrict table, global const float *restrict heads,
                 global const float *restrict factor, global float *restrict w1,
                 global float *restrict b1, global float *restrict b2, global float *restrict w3,
                 global float *restrict b3) {
  /* Arguments of groups that phi does not act on go unused. */
  (void)factor, (void)heads, (void)w1, (void)b1, (void)b2, (void)w3, (void)b3;
  const uint first = (uint)get_global_id(0) * VEC;
  if (first >= count) return;
  uint point[VEC];
  for (uint lane = 0; lane < VEC; ++lane) point[lane] = min(first + lane, count - 1);
  real unit[3];
  unit_position(surface, total_points, point, (float4)(lower_x, lower_y, lower_z, inverse_side), unit);
  float features[FEATURES * VEC];
  grid_features(unit, table, GRID_FEATURES, features);
  fixed_features(surface, total_points, point, features + GRID_ROWS * VEC);
#if STRIDE_W1
  fold_group(STRIDE_W1, first, count, features, heads + FOLD_W1, 0, 1, w1);
#endif
#if STRIDE_B1
  fold_group(STRIDE_B1, first, count, features, heads + FOLD_B1, 0, 1, b1);
#endif
#if STRIDE_B2
  fold_group(STRIDE_B2, first, count, features, heads + FOLD_B2, 0, 1, b2);
#endif
#if STRIDE_W3
  fold_group(STRIDE_W3, first, count, features, heads + FOLD_W3, DEMODULATED ? factor : 0, HIDDEN2, w3);
#endif
#if STRIDE_B3
  fold_group(STRIDE_B3, first, count, features, heads + FOLD_B3, DEMODULATED ? factor : 0, 1, b3);
#endif
}
