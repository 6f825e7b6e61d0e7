/* Points of the unit square warped to a density that is constant on each of DENSITY_BINS x DENSITY_BINS cells.
 *
 * A shading point's density is a record of (DENSITY_BINS + 1)^2 floats, rows of cumulative probabilities that begin
 * with 0 and end with 1: first the distribution of the strips in u, then for each strip that of its cells
 * in v. u picks the strip and its place in it, v the cell: monotone maps, so that points which are well
 * spread over the square stay well spread under the density (Pharr, Jakob and Humphreys, Physically
 * Based Rendering, section 13.3). DENSITY_BINS is a power of two.
 *
 * Work-group contract: none; pure functions of private values, VEC samples at a time.
 */

#define DENSITY_ROW (DENSITY_BINS + 1)
#define DENSITY_FLOATS (DENSITY_ROW * DENSITY_ROW)
/* The largest number below 1. */
#define BELOW_ONE 0x1.fffffep-1f

#if VEC == 1
real gather(global const float *restrict array, const whole at) { return array[at]; }
#else
real gather(global const float *restrict array, const whole at) {
  int index[VEC];
  float element[VEC];
  STORE(at, index);
  for (uint lane = 0; lane < VEC; ++lane) element[lane] = array[index[lane]];
  return LOAD(element);
}
#endif

/* Sends x through the inverse of the distribution that starts at `row`; returns the bin it falls into and
 * divides `inverse_density` by the density along this axis. */
whole warp_axis(global const float *restrict record, const whole row, real *x, real *inverse_density) {
  whole bin = row;
  for (int step = DENSITY_BINS / 2; step > 0; step /= 2)
    bin = SELECT(bin, bin + step, *x >= gather(record, bin + step));
  const real lower = gather(record, bin);
  const real probability = gather(record, bin + 1) - lower;
  const whole number = bin - row;
  *inverse_density /= (float)DENSITY_BINS * probability;
  *x = min((TO_REAL(number) + (*x - lower) / probability) * (1.0f / (float)DENSITY_BINS), (real)BELOW_ONE);
  return number;
}

/* Warps (u, v); returns one over the density there. */
real warp_square(global const float *restrict record, real *u, real *v) {
  real inverse_density = (real)1.0f;
  const whole strip = warp_axis(record, (whole)0, u, &inverse_density);
  warp_axis(record, (strip + 1) * DENSITY_ROW, v, &inverse_density);
  return inverse_density;
}
