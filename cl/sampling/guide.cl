/* Guided bounces: for every part of the scene a density of directions from which light arrives, learned
 * in training.
 *
 * The scene's bounding box is cut into GUIDE_SIDE^3 boxes with six directions of normals each. Each of these
 * cells has one density of the unit square (a record of warp.cl in `guide`), by which the coordinates of a
 * matte surface's next direction are warped. guide_frame: a record of FRAME in guide.py, the box's lower
 * corner and one over the extent of its cells.
 *
 * `guide_known` holds a record of KNOWN a cell: the mean over the square of the radiance that arrives there from other
 * surfaces, which roulette adds in place of the path that it ends, and how far from it a path may be (paths.cl).
 *
 * Joined after warp.cl, whose warp_axis applies one row of a record to a coordinate.
 *
 * Work-group contract: none; pure functions of private values, VEC paths at a time.
 */

whole guide_step(const real place) { return clamp(TO_WHOLE(place), (whole)0, (whole)(GUIDE_SIDE - 1)); }

whole guide_cell(global const float *restrict guide_frame, const triple position, const triple normal) {
  const whole x = guide_step((position.x - guide_frame[GUIDE_FRAME_CORNER]) * guide_frame[GUIDE_FRAME_CELLS]);
  const whole y = guide_step((position.y - guide_frame[GUIDE_FRAME_CORNER + 1]) * guide_frame[GUIDE_FRAME_CELLS + 1]);
  const whole z = guide_step((position.z - guide_frame[GUIDE_FRAME_CORNER + 2]) * guide_frame[GUIDE_FRAME_CELLS + 2]);
  const real size_x = fabs(normal.x);
  const real size_y = fabs(normal.y);
  const real size_z = fabs(normal.z);
  const whole along_x = (size_x >= size_y) && (size_x >= size_z);
  const whole along_y = size_y >= size_z;
  const real largest = SELECT(SELECT(normal.z, normal.y, along_y), normal.x, along_x);
  const whole axis = SELECT(SELECT((whole)2, (whole)1, along_y), (whole)0, along_x);
  const whole side = SELECT((whole)0, (whole)1, largest > 0.0f);
  return ((z * GUIDE_SIDE + y) * GUIDE_SIDE + x) * 6 + axis * 2 + side;
}

/* The index of the bin of the square that (u, v) lies in, row after row. */
whole guide_bin(const real u, const real v) {
  return TO_WHOLE(u * (float)DENSITY_BINS) * DENSITY_BINS + TO_WHOLE(v * (float)DENSITY_BINS);
}

/* warp_square, with a record a lane. */
real guide_square(global const uint *restrict guide, const whole cell, real *u, real *v) {
  real inverse_density = (real)1.0f;
  const bits record = TO_BITS(cell * DENSITY_WORDS);
  const bits strips = record + DENSITY_STRIPS;
  const whole strip = warp_axis(gather_bits(guide, strips), gather_bits(guide, strips + 1u), u, &inverse_density);
  const bits row = record + TO_BITS(DENSITY_ROW * strip + DENSITY_CELLS);
  warp_axis(gather_bits(guide, row), gather_bits(guide, row + 1u), v, &inverse_density);
  return inverse_density;
}
