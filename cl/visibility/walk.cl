/* What triangles block of lines, found by a walk through the scene's boxes: for points without an occluder list.
 *
 * What is still open of the lines lies in a rectangle on the light. Seen from the point it fills a shaft (shaft.cl), whose
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

/* The shaft of what is open of the lines; false if nothing is. */
bool open_shaft(const LightLines *lines, const uint blocks, const Block block[BLOCKS_A_ITEM], const float tolerance,
                Plane plane[SHAFT_PLANES]) {
  Extent all = block[0].open;
  for (uint k = 1; k < blocks; ++k) {
    const Extent *own = &block[k].open;
    all.least_x = fmin(all.least_x, own->least_x);
    all.largest_x = fmax(all.largest_x, own->largest_x);
    all.least_y = fmin(all.least_y, own->least_y);
    all.largest_y = fmax(all.largest_y, own->largest_y);
  }
  if (all.least_x > all.largest_x) return false;
  shaft_sides(lines, lines->across, lines->largest_x, all.least_x, all.largest_x, tolerance, plane);
  shaft_sides(lines, lines->along, lines->largest_y, all.least_y, all.largest_y, tolerance, plane + 2);
  plane[4] = lines->ends[0];
  plane[5] = lines->ends[1];
  return true;
}

/* Where the shadow of a box begins and ends along an axis of the light; `toward` and `across` are its ends along the light's
 * normal, which are positive, and along the axis. */
float2 shadow_between(const LightLines *lines, const float3 axis, const float largest, const float2 toward,
                      const float2 across) {
  const float base = dot(lines->base, axis);
  const float low = across.x * lines->distance / (across.x < 0.0f ? toward.x : toward.y) - base;
  const float high = across.y * lines->distance / (across.y > 0.0f ? toward.x : toward.y) - base;
  const float margin = SHADOW_MARGIN * (fmax(fabs(low), fabs(high)) + (largest + fabs(base)));
  return (float2)(low - margin, high + margin);
}

/* The ends of a box along an axis. */
float2 box_ends(const float3 axis, const float3 middle, const float3 reach) {
  const float at = dot(axis, middle);
  const float most = dot(fabs(axis), reach);
  return (float2)(at - most, at + most);
}

/* A rectangle on the light that holds the shadow of a box, whose numbers are CHILDREN apart; all of it if there is none. */
Extent box_shadow(const LightLines *lines, const float3 origin, global const float *restrict box, const float tolerance) {
  const float3 low = (float3)(box[0], box[CHILDREN], box[2 * CHILDREN]) - origin;
  const float3 high = (float3)(box[3 * CHILDREN], box[4 * CHILDREN], box[5 * CHILDREN]) - origin;
  const float3 middle = 0.5f * (low + high);
  const float3 reach = 0.5f * (high - low) + tolerance;
  const float2 toward = box_ends(lines->normal, middle, reach);
  if (toward.x <= tolerance || lines->distance <= tolerance)
    return (Extent){-FAR_AWAY, FAR_AWAY, -FAR_AWAY, FAR_AWAY};
  const float2 x = shadow_between(lines, lines->across, lines->largest_x, toward,
                                  box_ends(lines->across, middle, reach));
  const float2 y = shadow_between(lines, lines->along, lines->largest_y, toward,
                                  box_ends(lines->along, middle, reach));
  return (Extent){x.x, x.y, y.x, y.y};
}

/* Whether a rectangle reaches into some gap. */
bool meets_gaps(const Extent *extent, const uint blocks, const Block block[BLOCKS_A_ITEM]) {
  for (uint k = 0; k < blocks; ++k) {
    const Extent *open = &block[k].open;
    if (extent->least_x > open->largest_x || extent->largest_x < open->least_x ||
        extent->least_y > open->largest_y || extent->largest_y < open->least_y)
      continue;
    const Gaps *gaps = &block[k].gaps;
    whole meets = (whole)0;
    for (uint g = 0; g < gaps->used; ++g)
      meets = meets || ((gaps->low[g] < gaps->high[g]) && (gaps->low[g] <= extent->largest_y) &&
                        (gaps->high[g] >= extent->least_y));
    meets = meets && (block[k].x >= extent->least_x) && (block[k].x <= extent->largest_x);
    if (ANY(meets)) return true;
  }
  return false;
}

/* Cuts from the lines what a leaf's triangles block; returns whether that is something. */
bool cut_leaf(const LightLines *lines, const float3 origin, global const float *restrict leaf, const uint blocks,
              Block block[BLOCKS_A_ITEM]) {
  bool cuts = false;
  for (uint first = 0; first < CHILDREN; first += VEC) {
    triple corner[3];
    for (uint c = 0; c < 3; ++c) corner[c] = leaf_corner(leaf + first, c, origin);
    /* Of the light's and the surface's own planes rounding would make any side. */
    const uint between = triangles_inside(lines->ends, 2, corner);
    if (between != 0) cuts = cut_triangles(lines, corner, between, blocks, block) || cuts;
  }
  return cuts;
}

/* Cuts from the lines of `blocks` blocks what all triangles block. */
void walk_lines(const LightLines *lines, global const uint *restrict levels, global const float *restrict boxes,
                global const float *restrict triangles, const float tolerance, const float3 origin, const uint blocks,
                Block block[BLOCKS_A_ITEM]) {
  Plane plane[SHAFT_PLANES];
  if (!open_shaft(lines, blocks, block, tolerance, plane)) return;
  uint found[BOX_LEVELS], node[BOX_LEVELS];
  uint level = BOX_LEVELS - 1;
  node[level] = 0;
  found[level] = boxes_in_shaft(plane, origin, boxes + levels[level] * (ulong)NODE_FLOATS);
  while (true) {
    while (found[level] == 0)
      if (++level == BOX_LEVELS) return;
    const uint own = take_lowest(&found[level]);
    const uint child = node[level] * CHILDREN + own;
    const Extent shadow =
        box_shadow(lines, origin, boxes + (levels[level] + node[level]) * (ulong)NODE_FLOATS + own, tolerance);
    if (!meets_gaps(&shadow, blocks, block)) continue;
    if (level > 0) {
      node[--level] = child;
      found[level] = boxes_in_shaft(plane, origin, boxes + (levels[level] + child) * (ulong)NODE_FLOATS);
      continue;
    }
    global const float *restrict leaf = triangles + child * (ulong)LEAF_FLOATS;
    if (!cut_leaf(lines, origin, leaf, blocks, block)) continue;
    if (!open_shaft(lines, blocks, block, tolerance, plane)) return;
  }
}
