/* The densities of the network of density.cl, tabulated: a work-item computes e in all cells of VEC points, its mean
 * over the square, and from both the records that warp.cl samples by. What is added to e is uniform.
 *
 * Work-group contract: one-dimensional, any size, no local memory, no barriers.
 */

/* Sums side by side: independent ones hide the latency of FMA, and stay in registers. DENSITY_HIDDEN and CELLS are
 * multiples of it. */
#define SUMS 8

/* The densities of points first_point .. first_point + count, whose features are the first `count` columns, and
 * the mean of e over the square in `magnitude`. A share of UNIFORM_SHARE of each density is uniform. */
kernel void density_tables(const uint count, const uint stride, const uint first_point,
                           global const float *restrict features,
                           global const float *restrict feature_mean,
                           global const float *restrict feature_scale,
                           global const float *restrict parameters, global float *restrict magnitude,
                           global uint *restrict density) {
  const uint first = (uint)get_global_id(0) * VEC;
  if (first >= count) return;
  const uint valid = min((uint)VEC, count - first);
  real x[FEATURES];
  for (uint f = 0; f < FEATURES; ++f)
    x[f] = (LOAD(features + f * (ulong)stride + first) - feature_mean[f]) * feature_scale[f];
  real h[DENSITY_HIDDEN];
  for (uint j = 0; j < DENSITY_HIDDEN; j += SUMS) {
    real sum[SUMS];
#pragma unroll
    for (uint k = 0; k < SUMS; ++k) sum[k] = (real)parameters[MAGNITUDE_UNIT_BIAS + j + k];
    for (uint f = 0; f < FEATURES; ++f) {
#pragma unroll
      for (uint k = 0; k < SUMS; ++k)
        sum[k] = FMA((real)parameters[MAGNITUDE_UNITS + f * DENSITY_HIDDEN + j + k], x[f], sum[k]);
    }
#pragma unroll
    for (uint k = 0; k < SUMS; ++k) h[j + k] = max(sum[k], (real)0.0f);
  }

  real e[CELLS];
  real total = (real)0.0f;
  for (uint cell = 0; cell < CELLS; cell += SUMS) {
    global const float *restrict weights = parameters + MAGNITUDE_ROWS + cell * DENSITY_HIDDEN;
    real z[SUMS];
#pragma unroll
    for (uint k = 0; k < SUMS; ++k) z[k] = (real)parameters[MAGNITUDE_CELL_BIAS + cell + k];
    for (uint j = 0; j < DENSITY_HIDDEN; ++j) {
#pragma unroll
      for (uint k = 0; k < SUMS; ++k) z[k] = FMA((real)weights[k * DENSITY_HIDDEN + j], h[j], z[k]);
    }
#pragma unroll
    for (uint k = 0; k < SUMS; ++k) {
      e[cell + k] = exp(clamp(z[k], (real)-LOG_LIMIT, (real)LOG_LIMIT));
      total += e[cell + k];
    }
  }
  const real mean = total * (1.0f / CELLS);
  float means[VEC];
  STORE(mean, means);
  for (uint lane = 0; lane < valid; ++lane) magnitude[first_point + first + lane] = means[lane];

  global uint *restrict record = density + (first_point + first) * (ulong)DENSITY_WORDS;
  const real uniform_part = mean * (UNIFORM_SHARE / (1.0f - UNIFORM_SHARE));
  real strips[DENSITY_BINS];
  real all = (real)0.0f;
  for (uint strip = 0; strip < DENSITY_BINS; ++strip) {
    real *cells = e + strip * DENSITY_BINS;
    strips[strip] = (real)0.0f;
    for (uint bin = 0; bin < DENSITY_BINS; ++bin) {
      cells[bin] += uniform_part;
      strips[strip] += cells[bin];
    }
    store_row(cells, strips[strip], valid, record + DENSITY_CELLS + DENSITY_ROW * strip);
    all += strips[strip];
  }
  store_row(strips, all, valid, record + DENSITY_STRIPS);
}
