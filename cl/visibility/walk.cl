/* What triangles block of lines, found by a walk through the scene's boxes: for points without an occluder list.
 *
 * What is still open of VEC lines lies in a rectangle on the light. Seen from the point it fills a shaft (shaft.cl), whose
 * sides follow from the rectangle's; each box and each triangle that reaches into it may block some. Whatever is cut from the
 * lines makes the rectangle smaller, and boxes behind what is blocked are not entered any more. So the number of triangles that
 * are looked at is not bounded, and small where much is in the way.
 *
 * The shaft is wider than the rectangle by SHADOW_MARGIN, more than rounding moves a shadow by: between two
 * neighbours, of which only one is looked at, no light comes through.
 *
 * Work-group contract: none; functions of private values, and of the hierarchy, which is read only.
 */

/* Two planes through the origin, between which rays end from `low` to `high` along one axis of the light. */
void shaft_sides(const LightLines *lines, const float3 axis, const float largest, const float low, const float high,
                 const float tolerance, Plane plane[2]) {
  const float base = dot(lines->base, axis);
  const float margin = SHADOW_MARGIN * (largest + fabs(base));
  const float end[2] = {base + low - margin, base + high + margin};
  for (uint k = 0; k < 2; ++k) {
    const float length2 = end[k] * end[k] + lines->distance * lines->distance;
    /* In the light's plane no side is left. */
    const float inverse = lines->distance > 0.0f && length2 > FLT_MIN ? rsqrt(length2) : 0.0f;
    const float3 outside = inverse * (lines->distance * axis - end[k] * lines->normal);
    plane[k] = (Plane){k == 0 ? -outside : outside, tolerance};
  }
}

/* The shaft of what is open of a block's lines; false if nothing is. */
bool open_shaft(const LightLines *lines, const Block *block, const float tolerance, Plane plane[SHAFT_PLANES]) {
  real low = (real)FAR_AWAY;
  real high = (real)-FAR_AWAY;
  for (uint k = 0; k < block->gaps.used; ++k) {
    const whole is_gap = block->gaps.low[k] < block->gaps.high[k];
    low = SELECT(low, min(low, block->gaps.low[k]), is_gap);
    high = SELECT(high, max(high, block->gaps.high[k]), is_gap);
  }
  const whole open = low < high;
  if (!ANY(open)) return false;
  const float least_x = min_lanes(SELECT((real)FAR_AWAY, block->x, open));
  const float largest_x = max_lanes(SELECT((real)-FAR_AWAY, block->x, open));
  shaft_sides(lines, lines->across, lines->largest_x, least_x, largest_x, tolerance, plane);
  shaft_sides(lines, lines->along, lines->largest_y, min_lanes(low), max_lanes(high), tolerance, plane + 2);
  plane[4] = lines->ends[0];
  plane[5] = lines->ends[1];
  return true;
}

/* Cuts from VEC lines what those of a leaf's triangles block that are in `found`. */
void cut_leaf(const LightLines *lines, const float3 origin, global const float *restrict leaf, const uint found,
              Block *block) {
  for (uint first = 0; first < CHILDREN; first += VEC) {
    uint here = found >> first & (0xffffffffu >> (32 - VEC));
    if (here == 0) continue;
    triple corner[3];
    for (uint c = 0; c < 3; ++c) corner[c] = leaf_corner(leaf + first, c, origin);
    float parts[SIDES * HALF_LINE * VEC];
    here &= ~lane_mask(blocked_parts(lines, corner, VEC, parts));
    while (here != 0) cut_triangle(parts + take_lowest(&here), VEC, block);
  }
}

/* Cuts from VEC lines what all triangles block. */
void walk_block(const LightLines *lines, global const uint *restrict levels, global const float *restrict boxes,
                global const float *restrict triangles, const float tolerance, const float3 origin, Block *block) {
  Plane plane[SHAFT_PLANES];
  if (!open_shaft(lines, block, tolerance, plane)) return;
  uint found[BOX_LEVELS], node[BOX_LEVELS];
  uint level = BOX_LEVELS - 1;
  node[level] = 0;
  found[level] = boxes_in_shaft(plane, origin, boxes + levels[level] * (ulong)NODE_FLOATS);
  while (true) {
    while (found[level] == 0)
      if (++level == BOX_LEVELS) return;
    const uint child = node[level] * CHILDREN + take_lowest(&found[level]);
    if (level > 0) {
      node[--level] = child;
      found[level] = boxes_in_shaft(plane, origin, boxes + (levels[level] + child) * (ulong)NODE_FLOATS);
      continue;
    }
    global const float *restrict leaf = triangles + child * (ulong)LEAF_FLOATS;
    const uint met = triangles_in_shaft(plane, origin, leaf);
    if (met == 0) continue;
    cut_leaf(lines, origin, leaf, met, block);
    if (!open_shaft(lines, block, tolerance, plane)) return;
  }
}
