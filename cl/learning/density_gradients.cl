/* A step's gradients of the network of density.cl, a column at a time.
 *
 * Work-group contract: groups of exactly LANES work-items, which share the hidden units, VEC a work-item at a time;
 * LANES floats of local memory, barriers for sums over the lanes and for columns' activations under conditions that
 * are the same for the whole group. Every group owns one row of `partial`, and density_adam adds the rows in order:
 * the same bits every time.
 */

#define UNIT_BLOCKS (DENSITY_HIDDEN / VEC)
/* Hidden units of one work-item, in blocks of VEC. */
#define OWN_BLOCKS ((UNIT_BLOCKS + LANES - 1) / LANES)

/* Sum over the group; every work-item gets it. */
float sum_group(const float own, local float *shared) {
#if LANES == 1
  (void)shared;
  return own;
#else
  const uint lane = (uint)get_local_id(0);
  barrier(CLK_LOCAL_MEM_FENCE);
  shared[lane] = own;
  for (uint half_width = LANES / 2; half_width > 0; half_width /= 2) {
    barrier(CLK_LOCAL_MEM_FENCE);
    if (lane < half_width) shared[lane] += shared[lane + half_width];
  }
  barrier(CLK_LOCAL_MEM_FENCE);
  return shared[0];
#endif
}

/* One step's gradients: columns first .. first + count, samples sample .. sample + DENSITY_SAMPLES of each. */
kernel __attribute__((reqd_work_group_size(LANES, 1, 1))) void density_gradients(
    const uint sample, const uint first, const uint count, const uint stride, const float unit_square,
    global const float *restrict features, global const float *restrict feature_mean,
    global const float *restrict feature_scale, global const float *restrict all_u,
    global const float *restrict all_v, global const float *restrict squared,
    global const float *restrict parameters, global float *restrict partial) {
  local float shared[LANES];
  const uint lane = (uint)get_local_id(0);
  const uint group = (uint)get_group_id(0);
  const uint groups = (uint)get_num_groups(0);
  global float *restrict own = partial + group * (ulong)MAGNITUDE_FLOATS;
  const float share = 1.0f / (float)(count * DENSITY_SAMPLES);
  for (uint p = lane * VEC; p < MAGNITUDE_FLOATS; p += LANES * VEC) STORE((real)0.0f, own + p);
  barrier(CLK_GLOBAL_MEM_FENCE);

  for (uint column = first + group; column < first + count; column += groups) {
    real h[OWN_BLOCKS];
    real delta_h[OWN_BLOCKS];
    for (uint k = 0; k < OWN_BLOCKS; ++k) {
      const uint at = min(lane + k * LANES, (uint)UNIT_BLOCKS - 1) * VEC;
      real sum = LOAD(parameters + MAGNITUDE_UNIT_BIAS + at);
      for (uint f = 0; f < FEATURES; ++f) {
        const float x = (features[f * (ulong)stride + column] - feature_mean[f]) * feature_scale[f];
        sum = FMA(LOAD(parameters + MAGNITUDE_UNITS + f * DENSITY_HIDDEN + at), (real)x, sum);
      }
      /* Lanes beyond the last block take part in the sums with zeros. */
      h[k] = lane + k * LANES < UNIT_BLOCKS ? max(sum, (real)0.0f) : (real)0.0f;
      delta_h[k] = (real)0.0f;
    }
    for (uint s = 0; s < DENSITY_SAMPLES; ++s) {
      const ulong row = (sample + s) * (ulong)stride + column;
      const int cell = cell_of(all_u[row], all_v[row]);
      global const float *restrict weights = parameters + MAGNITUDE_ROWS + cell * DENSITY_HIDDEN;
      real product = (real)0.0f;
      for (uint k = 0; k < OWN_BLOCKS; ++k)
        product = FMA(LOAD(weights + min(lane + k * LANES, (uint)UNIT_BLOCKS - 1) * VEC), h[k], product);
      const float z = sum_group(sum_lanes(product), shared) + parameters[MAGNITUDE_CELL_BIAS + cell];
      const float e = exp(clamp(z, -LOG_LIMIT, LOG_LIMIT));
      /* Beyond the limit only gradients that lead back are used. */
      const float slope = e - squared[row] * unit_square / e;
      const float delta = fabs(z) < LOG_LIMIT || z * slope > 0.0f ? slope * share : 0.0f;
      for (uint k = 0; k < OWN_BLOCKS; ++k) {
        const uint block = lane + k * LANES;
        if (block < UNIT_BLOCKS) {
          global float *restrict gradient = own + MAGNITUDE_ROWS + cell * DENSITY_HIDDEN + block * VEC;
          STORE(FMA((real)delta, h[k], LOAD(gradient)), gradient);
          delta_h[k] = FMA((real)delta, LOAD(weights + block * VEC), delta_h[k]);
        }
      }
      if (lane == 0) own[MAGNITUDE_CELL_BIAS + cell] += delta;
    }
    for (uint k = 0; k < OWN_BLOCKS; ++k) {
      const uint block = lane + k * LANES;
      if (block < UNIT_BLOCKS) {
        const real delta = SELECT((real)0.0f, delta_h[k], h[k] > 0.0f);
        for (uint f = 0; f < FEATURES; ++f) {
          const float x = (features[f * (ulong)stride + column] - feature_mean[f]) * feature_scale[f];
          global float *restrict gradient = own + MAGNITUDE_UNITS + f * DENSITY_HIDDEN + block * VEC;
          STORE(FMA((real)x, delta, LOAD(gradient)), gradient);
        }
        global float *restrict gradient = own + MAGNITUDE_UNIT_BIAS + block * VEC;
        STORE(LOAD(gradient) + delta, gradient);
      }
    }
  }
}
