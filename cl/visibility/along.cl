/* Samples along lines: each is moved to where its line on a light sees the point, and counts by the visible length.
 *
 * A line u = const on a light (lights.cl) has gaps, which no triangle blocks (lines.cl, walk.cl). A sample (x, y) of the unit
 * square goes to the place on the line u = x below which a share y of the free length lies, as v measures length, and
 * counts by that length. So visibility is no longer in the integrand, and no shadow ray is needed. (Billen and
 * Dutre 2016, Line Sampling for Direct Illumination.)
 *
 * Lines are brought in order of u where there are many triangles, so that those of a vector are neighbours, and
 * only some of the triangles' shadows reach them.
 *
 * A line with more than MOST_GAPS gaps is refused: its sample stays where it was, and is tested as a point, and so are
 * samples of a lobe (lobe.cl), which are no points of a light.
 *
 * Work-group contract: none; functions of private values, of a point's list and of the hierarchy, which are read only.
 */

/* From y0 to y1 of a line: the difference of sines, without cancellation where both lie on one side of its foot. */
real sine_between(const real squared, const real y0, const real y1) {
  /* A point in the light's plane may lie on the line, at y 0. */
  const real inverse0 = rsqrt(max(FMA(y0, y0, squared), (real)FLT_MIN));
  const real inverse1 = rsqrt(max(FMA(y1, y1, squared), (real)FLT_MIN));
  const real sine0 = y0 * inverse0;
  const real sine1 = y1 * inverse1;
  const real both = inverse0 * inverse1;
  const real same = squared * both * ((y1 - y0) * (y0 + y1) * both) / (sine0 + sine1);
  return SELECT(sine1 - sine0, same, sine0 * sine1 > 0.0f);
}

/* The v below which a share y of what is free lies; returns its length, as v measures it. */
real place_in_gaps(const LightLines *lines, const Block *block, const real y, real *v) {
  const real z = lines->view.z;
  const Gaps *gaps = &block->gaps;
  const real begin = block->begin;
  const real squared = FMA(block->x, block->x, z * z);
  const real whole_line = lines->large ? sine_between(squared, begin, begin + block->length) : block->length;
  /* A line in whose plane the point lies has no length, and no part of it is free. */
  const real inverse = 1.0f / max(whole_line, (real)1e-30f);
  real start[MOST_GAPS], length[MOST_GAPS];
  real total = (real)0.0f;
  for (uint k = 0; k < gaps->used; ++k) {
    const real low = gaps->low[k];
    const real high = max(low, gaps->high[k]);
    start[k] = inverse * (lines->large ? sine_between(squared, begin, low) : low - begin);
    length[k] = inverse * (lines->large ? sine_between(squared, low, high) : high - low);
    length[k] = SELECT((real)0.0f, length[k], high > low);
    total += length[k];
  }
  const real target = y * total;
  real found = (real)-1.0f;
  *v = y;
  for (uint k = 0; k < gaps->used; ++k) {
    real below = (real)0.0f;
    for (uint other = 0; other < gaps->used; ++other)
      below += SELECT((real)0.0f, length[other], gaps->low[other] < gaps->low[k]);
    const whole holds = (length[k] > 0.0f) && (below <= target) && (below > found);
    found = SELECT(found, below, holds);
    *v = SELECT(*v, start[k] + min(target - below, length[k]), holds);
  }
  return total;
}

/* The order of u, roughly: by buckets, as many as there are. */
void order_by_u(const float *u, const uint count, uint order[ITEM_SAMPLES]) {
  uint begin[ITEM_SAMPLES + 1];
  uint bucket[ITEM_SAMPLES];
  for (uint k = 0; k <= count; ++k) begin[k] = 0;
  for (uint k = 0; k < count; ++k) {
    bucket[k] = min((uint)(u[k] * (float)count), count - 1);
    ++begin[bucket[k] + 1];
  }
  for (uint k = 0; k < count; ++k) begin[k + 1] += begin[k];
  for (uint k = 0; k < count; ++k) order[begin[bucket[k]]++] = k;
}

/* The lights that VEC lines lie on, by number, and how far across these, from 0 to 1; -1 for samples that lie on none
 * since they are the lobe's (lobe.cl). */
whole light_of_line(global const float *restrict lights, const ShadingPoint *p, const real u, real *across) {
  real of_lights = u;
  whole in_lobe = (whole)0;
#if HAS_SPECULAR
  const float share = p->lobe_share;
  if (share > 0.0f) {
    in_lobe = u < share;
    of_lights = SELECT(past_lobe(share, u), u, in_lobe);
  }
#endif
  real first, width;
  const whole record = light_at(lights, strips_at(lights, p), of_lights, &first, &width);
  *across = (of_lights - first) / width;
  return SELECT(record / LIGHT_FLOATS, (whole)-1, in_lobe);
}

/* Moves samples (u, v) of a point along their lines to where they see the light, for `blocks` blocks of VEC; `share` gets what they count by, `refused` which ones stay where they are, and count by 1. */
void take_visible(const ShadingPoint *p, global const float *restrict lights, global const uint *restrict own,
                  global const uint *restrict levels, global const float *restrict boxes,
                  global const float *restrict triangles, const float tolerance, const uint blocks,
                  const float u[ITEM_SAMPLES], float v[ITEM_SAMPLES], float share[ITEM_SAMPLES],
                  int refused[ITEM_SAMPLES]) {
  const float3 origin = ray_origin(p);
  const uint samples = blocks * VEC;
  uint order[ITEM_SAMPLES];
  float sorted_u[ITEM_SAMPLES], sorted_v[ITEM_SAMPLES];
  if (VEC > 1 && own[0] >= SORTED_FROM) {
    order_by_u(u, samples, order);
  } else {
    for (uint k = 0; k < samples; ++k) order[k] = k;
  }
  for (uint k = 0; k < samples; ++k) {
    sorted_u[k] = u[order[k]];
    sorted_v[k] = v[order[k]];
  }
  whole light_of[BLOCKS_A_ITEM];
  real across[BLOCKS_A_ITEM];
  for (uint k = 0; k < blocks; ++k) {
    light_of[k] = light_of_line(lights, p, LOAD(sorted_u + k * VEC), &across[k]);
    int light[VEC];
    STORE(light_of[k], light);
    for (uint lane = 0; lane < VEC; ++lane)
      if (light[lane] < 0) refused[order[k * VEC + lane]] = -1;
  }
  Block block[BLOCKS_A_ITEM];
  for (int light = 0; light < LIGHT_COUNT; ++light) {
    whole any_here = (whole)0;
    for (uint k = 0; k < blocks; ++k) any_here = any_here || (light_of[k] == light);
    if (!ANY(any_here)) continue;
    const LightLines lines = lines_of(p, lights, light);
    for (uint k = 0; k < blocks; ++k) begin_block(&lines, across[k], light_of[k] == light, &block[k]);
    if (own[0] != TOO_MANY) {
      cut_lines(&lines, own, triangles, origin, blocks, block);
    } else {
      walk_lines(&lines, levels, boxes, triangles, tolerance, origin, blocks, block);
    }
    for (uint k = 0; k < blocks; ++k) {
      const whole here = light_of[k] == light;
      const whole stays = here && block[k].gaps.refused;
      real place;
      float places[VEC], lengths[VEC];
      int is_here[VEC], is_refused[VEC];
      STORE(place_in_gaps(&lines, &block[k], LOAD(sorted_v + k * VEC), &place), lengths);
      STORE(place, places);
      STORE(here, is_here);
      STORE(stays, is_refused);
      for (uint lane = 0; lane < VEC; ++lane) {
        const uint sample = order[k * VEC + lane];
        if (is_here[lane] == 0) continue;
        refused[sample] = is_refused[lane];
        if (is_refused[lane] != 0) continue;
        v[sample] = places[lane];
        share[sample] = lengths[lane];
      }
    }
  }
}

/* Takes from `open` those of the `refused` that are blocked; returns how many were tested. */
uint test_refused(global const uint *restrict own, global const float *restrict triangles, const float3 origin,
                  const real direction[BLOCKS_A_ITEM][3], const int refused[ITEM_SAMPLES],
                  whole open[BLOCKS_A_ITEM]) {
  whole tested[BLOCKS_A_ITEM];
  uint count = 0;
  for (uint k = 0; k < BLOCKS_A_ITEM; ++k) {
    tested[k] = open[k] && LOAD(refused + k * VEC);
    count += (uint)sum_lanes(SELECT((real)0.0f, (real)1.0f, tested[k]));
  }
  if (count == 0) return 0;
  close_blocked(own, triangles, origin, direction, tested);
  for (uint k = 0; k < BLOCKS_A_ITEM; ++k) open[k] = open[k] && (tested[k] || !LOAD(refused + k * VEC));
  return count;
}
