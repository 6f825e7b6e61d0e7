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
/* Records are those of all points. */
#define RECORD_NUMBER(point, in_batch) (point)
/* The largest number below 1. */
#define BELOW_ONE 0x1.fffffep-1f

/* Places x, which lies between the cumulative probabilities of bin `number`, in the bin; divides
 * `inverse_density` by the density along this axis. */
void place_in_bin(const whole number, const real lower, const real upper, real *x, real *inverse_density) {
  const real inverse = 1.0f / (upper - lower);
  *inverse_density *= inverse * (1.0f / (float)DENSITY_BINS);
  *x = min((TO_REAL(number) + (*x - lower) * inverse) * (1.0f / (float)DENSITY_BINS), (real)BELOW_ONE);
}

/* Sends u through the inverse of the strips' distribution, whose edges all lanes share; returns the strips. */
whole warp_to_strip(global const float *restrict record, real *u, real *inverse_density) {
  whole strip = (whole)0;
  real lower = (real)0.0f;
  real upper = (real)record[1];
  for (int edge = 1; edge < DENSITY_BINS; ++edge) {
    const whole above = *u >= record[edge];
    strip = SELECT(strip, (whole)edge, above);
    lower = SELECT(lower, (real)record[edge], above);
    upper = SELECT(upper, (real)record[edge + 1], above);
  }
  place_in_bin(strip, lower, upper, u, inverse_density);
  return strip;
}

/* Sends v through the inverse of the distribution of its strip's cells: each lane searches a row of its own. */
void warp_in_strip(global const float *restrict record, const whole strip, real *v, real *inverse_density) {
  const whole row = (strip + 1) * DENSITY_ROW;
  whole cell = row;
  for (int step = DENSITY_BINS / 2; step > 0; step /= 2)
    cell = SELECT(cell, cell + step, *v >= gather(record, cell + step));
  place_in_bin(cell - row, gather(record, cell), gather(record, cell + 1), v, inverse_density);
}

/* Warps (u, v); returns one over the density there. */
real warp_square(global const float *restrict record, real *u, real *v) {
  real inverse_density = (real)1.0f;
  const whole strip = warp_to_strip(record, u, &inverse_density);
  warp_in_strip(record, strip, v, &inverse_density);
  return inverse_density;
}
