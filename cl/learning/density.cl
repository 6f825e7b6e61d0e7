/* The sampling density of the residual: a small network that says, for every shading point, how large the
 * residual |f - g| is in each of CELLS = DENSITY_BINS^2 cells of the unit square.
 *
 *   x = (features(phi) - feature_mean) * feature_scale     h = relu(W x + b)     e_k = exp(h . v_k + c_k)
 *
 * It minimises the mean over samples of r^2 / e + e, where r is the residual of the sample and e is that of the
 * sample's cell; the minimiser is e = sqrt(E[r^2]), the density of least variance. In a step each sample
 * touches one cell's row v_k only, so a sample costs about 2 DENSITY_HIDDEN multiply-adds and a column
 * FEATURES * DENSITY_HIDDEN.
 *
 * Parameters, a record of `DensitySettings.parameters`: W as FEATURES rows of DENSITY_HIDDEN floats, then b, then
 * CELLS rows v_k of DENSITY_HIDDEN, then c.
 * Samples as in train.cl: sample s of column i is element s * stride + i. `features` is structure of arrays.
 *
 * Joined after mlp.cl for FITTING, else after warp.cl; and before what computes a step's gradients or the densities:
 * density_gradients.cl and density_tables.cl, or on GPUs density_lanes.cl.
 *
 * Work-group contract: any size, no local memory, no barriers.
 */

#define CELLS (DENSITY_BINS * DENSITY_BINS)

int cell_of(const float u, const float v) {
  const int strip = clamp((int)(u * (float)DENSITY_BINS), 0, DENSITY_BINS - 1);
  return strip * DENSITY_BINS + clamp((int)(v * (float)DENSITY_BINS), 0, DENSITY_BINS - 1);
}

/* log e, kept where neither e nor 1 / e overflow or outweigh all other samples. */
#define LOG_LIMIT 7.0f

#if FITTING
/* Mean over channels of (f - g)^2 for every stored sample, over the square of its point's `unit`. One work-item
 * takes VEC samples of one column. */
kernel void squared_residuals(const uint count, const uint stride, const uint samples,
                              global const uint *restrict order, global const float *restrict all_u,
                              global const float *restrict all_v, global const float *restrict all_targets,
                              global const float *restrict unit, NETWORK_ARGUMENTS,
                              global float *restrict squared) {
  const uint column = (uint)get_global_id(0) % count;
  const uint first = (uint)get_global_id(0) / count * VEC;
  if (first >= samples) return;
  const uint point = order[column];
  const PointNetwork network = NETWORK_OF(point);
  float u[VEC], v[VEC];
  for (uint k = 0; k < VEC; ++k) {
    const ulong at = min(first + k, samples - 1) * (ulong)stride + column;
    u[k] = all_u[at];
    v[k] = all_v[at];
  }
  real g[CHANNELS];
  network_value(&network, LOAD(u), LOAD(v), g);
  const float inverse = unit[point] > 0.0f ? 1.0f / unit[point] : 0.0f;
  real sum = (real)0.0f;
  for (uint c = 0; c < CHANNELS; ++c) {
    float f[VEC];
    for (uint k = 0; k < VEC; ++k)
      f[k] = all_targets[(min(first + k, samples - 1) * CHANNELS + c) * (ulong)stride + column];
    const real residual = (LOAD(f) - g[c]) * inverse;
    sum = FMA(residual, residual, sum);
  }
  float squares[VEC];
  STORE(sum * (1.0f / CHANNELS), squares);
  for (uint k = 0; k < VEC && first + k < samples; ++k)
    squared[(first + k) * (ulong)stride + column] = squares[k];
}

/* Keeps moments of parameters without gradient from decaying to denormal numbers, with which CPUs are slow. */
#define TINY 1e-30f

/* One Adam step (Kingma and Ba 2015, algorithm 1), VEC parameters a work-item. */
kernel void density_adam(const uint groups, const float rate, const float correction1,
                         const float correction2, global const float *restrict partial,
                         global float *restrict parameters, global float *restrict moment1,
                         global float *restrict moment2) {
  const uint p = (uint)get_global_id(0) * VEC;
  if (p >= MAGNITUDE_FLOATS) return;
  real gradient = (real)0.0f;
  for (uint g = 0; g < groups; ++g) gradient += LOAD(partial + g * (ulong)MAGNITUDE_FLOATS + p);
  const real m1 = FMA((real)ADAM_BETA1, LOAD(moment1 + p), (1.0f - ADAM_BETA1) * gradient + TINY);
  const real m2 = FMA((real)ADAM_BETA2, LOAD(moment2 + p), (1.0f - ADAM_BETA2) * gradient * gradient + TINY);
  STORE(m1, moment1 + p);
  STORE(m2, moment2 + p);
  const real step = rate * correction1 * m1 / (sqrt(m2 * correction2) + ADAM_EPSILON);
  STORE(LOAD(parameters + p) - step, parameters + p);
}
#else

/* One row of a record of warp.cl for VEC points at once: edges of bins of `weight`, which sum to `total`. Every
 * bin keeps one unit at least. */
void store_row(const real weight[DENSITY_BINS], const real total, const uint valid, global uint *restrict row) {
  const real units = (float)EDGE_UNITS / total;
  real sum = (real)0.0f;
  bits words[DENSITY_ROW] = {(bits)0u, (bits)0u};
  whole before = (whole)0;
  UNROLL_FOR_LANES
  for (int edge = 1; edge < DENSITY_BINS; ++edge) {
    sum += weight[edge - 1];
    const whole nearest = TO_WHOLE(FMA(sum, units, (real)0.5f));
    before = clamp(nearest, before + 1, (whole)(EDGE_UNITS - DENSITY_BINS + edge));
    words[(edge - 1) / 4] |= TO_BITS(before) << (uint)(8 * ((edge - 1) % 4));
  }
  UNROLL_FOR_LANES
  for (uint k = 0; k < DENSITY_ROW; ++k) {
    uint word[VEC];
    STORE(words[k], word);
    for (uint lane = 0; lane < valid; ++lane) row[lane * DENSITY_WORDS + k] = word[lane];
  }
}
#endif
