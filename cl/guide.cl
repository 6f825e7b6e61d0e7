/* Guided bounces: where light comes from, learned in training, for every part of the scene.
 *
 * The scene's bounding box is cut into GUIDE_SIDE^3 boxes with six directions of normals each. Each of these
 * cells has one density of the unit square (a record of warp.cl in `guide`), by which the coordinates of a
 * matte surface's next direction are warped. guide_frame: six floats, the box's lower corner and one over
 * the extent of its cells.
 *
 * `guide_mean` holds GUIDE_CHANNELS floats a cell: the mean radiance that arrives there from other surfaces,
 * over the square. It replaces what roulette ends.
 *
 * Joined after warp.cl, which finds the place of a coordinate in a record.
 *
 * Work-group contract: none; pure functions of private values, VEC paths at a time.
 */

whole guide_step(const real place) { return clamp(TO_WHOLE(place), (whole)0, (whole)(GUIDE_SIDE - 1)); }

whole guide_cell(global const float *restrict guide_frame, const triple position, const triple normal) {
  const whole x = guide_step((position.x - guide_frame[0]) * guide_frame[3]);
  const whole y = guide_step((position.y - guide_frame[1]) * guide_frame[4]);
  const whole z = guide_step((position.z - guide_frame[2]) * guide_frame[5]);
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

/* Which of the square's cells, row after row, a point lies in. */
whole guide_bin(const real u, const real v) {
  return TO_WHOLE(u * (float)DENSITY_BINS) * DENSITY_BINS + TO_WHOLE(v * (float)DENSITY_BINS);
}

/* warp_square, with a record a lane. */
real guide_square(global const float *restrict guide, const whole cell, real *u, real *v) {
  real inverse_density = (real)1.0f;
  const whole record = cell * DENSITY_FLOATS;
  whole strip = record;
  for (int step = DENSITY_BINS / 2; step > 0; step /= 2)
    strip = SELECT(strip, strip + step, *u >= gather(guide, strip + step));
  place_in_bin(strip - record, gather(guide, strip), gather(guide, strip + 1), u, &inverse_density);
  const whole row = record + (strip - record + 1) * DENSITY_ROW;
  whole in_strip = row;
  for (int step = DENSITY_BINS / 2; step > 0; step /= 2)
    in_strip = SELECT(in_strip, in_strip + step, *v >= gather(guide, in_strip + step));
  place_in_bin(in_strip - row, gather(guide, in_strip), gather(guide, in_strip + 1), v, &inverse_density);
  return inverse_density;
}
