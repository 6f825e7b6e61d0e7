/* Points of the unit square warped to a density that is constant on each of DENSITY_BINS x DENSITY_BINS cells.
 *
 * A shading point's density is a record of rows (DENSITY in warp.py): first the distribution of the strips in u, then
 * for each strip that of its cells in v. u picks the strip and its place in it, v the cell: monotone maps, so that
 * points which are well spread over the square stay well spread under the density (Pharr, Jakob and Humphreys,
 * Physically Based Rendering, section 13.3).
 *
 * Memory layout: a row is DENSITY_ROW = 2 words. Its eight bins have seven inner edges, cumulative probabilities in
 * units of 1 / EDGE_UNITS, strictly rising: edges 1 to 4 are the bytes of the first word, lowest first, 5 to 7 those of
 * the second. Nothing is lost by so few digits: the density is what the edges say, exactly, its integral 1 exactly;
 * edges on multiples of 1 / 256 suit Sobol points, of which 256 have one in each such interval; and records stay in
 * the cache.
 *
 * Work-group contract: none; pure functions of private values, VEC samples at a time.
 */

#if DENSITY_BINS != 8 || EDGE_UNITS != 256 || DENSITY_ROW != 2
#error "a row's edges are seven bytes"
#endif
/* Records are those of all points. */
#define RECORD_NUMBER(point, in_batch) (point)
/* The largest number below 1. */
#define BELOW_ONE 0x1.fffffep-1f

/* Sends x through the inverse of the distribution of the row `low`, `high`, a row a lane; divides `inverse_density` by
 * the density there. Returns the bin. */
whole warp_axis(const bits low, const bits high, real *x, real *inverse_density) {
  const real place = *x * (float)EDGE_UNITS;
  /* A binary search: the fourth edge, then the second or sixth, then an odd one. */
  real edge = TO_REAL(low >> 24);
  whole above = place >= edge;
  whole bin = SELECT((whole)0, (whole)4, above);
  real lower = SELECT((real)0.0f, edge, above);
  real upper = SELECT(edge, (real)EDGE_UNITS, above);
  bits edges = SELECT(low, high, above);
  edge = TO_REAL((edges >> 8) & 255u);
  above = place >= edge;
  bin = SELECT(bin, bin + 2, above);
  lower = SELECT(lower, edge, above);
  upper = SELECT(edge, upper, above);
  edges = SELECT(edges, edges >> 16, above);
  edge = TO_REAL(edges & 255u);
  above = place >= edge;
  bin = SELECT(bin, bin + 1, above);
  lower = SELECT(lower, edge, above);
  upper = SELECT(edge, upper, above);
  const real inverse = 1.0f / (upper - lower);
  *inverse_density *= inverse * ((float)EDGE_UNITS / (float)DENSITY_BINS);
  *x = min((TO_REAL(bin) + (place - lower) * inverse) * (1.0f / (float)DENSITY_BINS), (real)BELOW_ONE);
  return bin;
}

/* The edge before bin number `bin` of a row, from 0 to EDGE_UNITS. */
uint row_edge(global const uint *restrict row, const int bin) {
  if (bin == 0) return 0u;
  return bin == DENSITY_BINS ? (uint)EDGE_UNITS : row[(bin - 1) / 4] >> (8 * ((bin - 1) % 4)) & 255u;
}

float bin_probability(global const uint *restrict row, const int bin) {
  return (float)(row_edge(row, bin + 1) - row_edge(row, bin)) / (float)EDGE_UNITS;
}

/* Warps (u, v); returns one over the density there. */
real warp_square(global const uint *restrict record, real *u, real *v) {
  real inverse_density = (real)1.0f;
  const whole strip =
      warp_axis((bits)record[DENSITY_STRIPS], (bits)record[DENSITY_STRIPS + 1], u, &inverse_density);
  const whole row = DENSITY_ROW * strip + DENSITY_CELLS;
  warp_axis(gather_bits(record, TO_BITS(row)), gather_bits(record, TO_BITS(row + 1)), v, &inverse_density);
  return inverse_density;
}
