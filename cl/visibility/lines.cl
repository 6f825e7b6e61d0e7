/* Direct light along lines: the part of a line on a light that a point sees, found exactly, and samples within it.
 *
 * A line u = const on a light (lights.cl) is a segment along edge2: seen from the point its ray ends are base + x across +
 * y along, with x fixed by u, and y in [begin, begin + length]. A triangle blocks an interval of y. What all of
 * the point's occluders (shaft.cl) leave free of the line are its gaps; a sample (x, y) of the unit square goes to the
 * place on the line u = x below which a share y of the free length lies, as v measures length, and counts by that
 * length. So visibility is no longer in the integrand, and no shadow ray is needed. (Billen and Dutre 2016, Line
 * Sampling for Direct Illumination.)
 *
 * The interval. Which side of an edge a ray passes, and whether it reaches the triangle's plane before its end (shaft.cl),
 * are signs of functions c0 + c1 x + c2 y: each is a half-line in y that begins or ends at -(c0 + c1 x) / c2. These
 * numbers are found once for all lines, for VEC triangles at a time; lines then take VEC lanes.
 * Two triangles with a common edge get the same numbers with their signs turned, so their intervals meet bit for bit.
 *
 * Lines are brought in order of u where there are many triangles, so that those of a vector are neighbours, and
 * only some of the triangles' shadows, seen as ranges of x, reach them.
 *
 * Gaps are cut out of the whole line, triangle after triangle, in any order: what blocks twice does no harm. A line
 * with more than MOST_GAPS of them is refused: its sample stays where it was, and is tested as a point, and so are
 * samples of a lobe (lobe.cl), which are no points of a light.
 *
 * Where light would arrive from below the point's surface there is none: lines are cut at its horizon, too.
 *
 * Work-group contract: none; functions of private values, and of a point's list, which is read only.
 */

/* A function's half-line: its lower end is [0] + [1] x, its upper end [2] + [3] x, one of which is far away. */
#define HALF_LINE 4
/* Three sides of a triangle and its plane; least and largest x of its shadow. */
#define LEAST_X (4 * HALF_LINE)
#define LARGEST_X (LEAST_X + 1)
#define TRIANGLE_ROWS (LEAST_X + 2)
/* Triangles looked at together: what is known of them is kept at hand. A multiple of VEC. */
#define TRIANGLES_AT_HAND 64
#define ITEM_SAMPLES (BLOCKS_A_ITEM * VEC)
/* Half-lines begin at most this many times as far from the middle as a light does. */
#define STEEPEST 0x1.0p30f
/* What rounding may move a shadow by, of the coordinates on the light that enter. */
#define SHADOW_MARGIN 0x1.0p-14f
/* Gaps that are shorter than this part of the line, or of its distance, are rounding errors between triangles. */
#define SLIVER 0x1.0p-22f

/* The lines of one light about a point. */
typedef struct {
  LightView view;
  bool large;                  /* seen by solid angle, else by area */
  float3 base, across, along;  /* ends of rays, from their origin */
  float3 normal;               /* of the light, turned away from the point */
  float distance;              /* of the ends' plane from the rays' origin */
  float largest_x, largest_y;  /* on the light */
  real horizon[2][HALF_LINE];
} LightLines;

/* a x b, exactly the negative of b x a: no product may be fused into the difference. */
triple exact_cross_triple(const triple a, const triple b) {
#pragma OPENCL FP_CONTRACT OFF
  const triple first = {a.y * b.z, a.z * b.x, a.x * b.y};
  const triple second = {a.z * b.y, a.x * b.z, a.y * b.x};
  return (triple){first.x - second.x, first.y - second.y, first.z - second.z};
}

/* a . b, exactly the negative of -a . b. */
real exact_dot(const triple a, const float3 b) { return FMA(a.x, (real)b.x, FMA(a.y, (real)b.y, a.z * b.z)); }

/* Where c0 + c1 x + c2 y is not negative. */
void half_line(const LightLines *lines, const real c0, const real c1, const real c2, real found[HALF_LINE]) {
  /* Where c2 vanishes, x decides: the end is so far away that it is never between. */
  const real least = FMA(fabs(c1), (real)lines->largest_x, fabs(c0)) * (1.0f / (STEEPEST * lines->largest_y));
  const real size = max(fabs(c2), max(least, (real)FLT_MIN));
  const whole falls = c2 < 0.0f;
  const real inverse = -1.0f / SELECT(size, -size, falls);
  const real end0 = c0 * inverse;
  const real end1 = c1 * inverse;
  found[0] = SELECT(end0, (real)-FAR_AWAY, falls);
  found[1] = SELECT(end1, (real)0.0f, falls);
  found[2] = SELECT((real)FAR_AWAY, end0, falls);
  found[3] = SELECT((real)0.0f, end1, falls);
}

float max_lanes(const real x) {
  float lane[VEC];
  STORE(x, lane);
  float largest_lane = lane[0];
  for (uint k = 1; k < VEC; ++k) largest_lane = fmax(largest_lane, lane[k]);
  return largest_lane;
}

LightLines lines_of(const ShadingPoint *p, global const float *restrict lights, const int light) {
  global const float *restrict record = lights + light * LIGHT_FLOATS;
  LightLines lines;
  const float3 begin = vload3(0, record + LIGHT_CORNER) - p->position;
  const float3 edge1 = vload3(0, record + LIGHT_EDGE1);
  const float3 edge2 = vload3(0, record + LIGHT_EDGE2);
  const float3 normal = vload3(0, record + LIGHT_NORMAL);
  lines.along = vload3(0, record + LIGHT_ALONG);
  lines.across = vload3(0, record + LIGHT_ACROSS);
  const triple middle = to_triple(begin + 0.5f * (edge1 + edge2));
  lines.large = ANY(dot_triple(middle, middle) < record[LIGHT_LARGE]);
  lines.view = light_view(lights, (whole)(light * LIGHT_FLOATS), to_triple(begin), to_triple(normal),
                          to_triple(lines.across), to_triple(lines.along));
  const float height = dot(begin, normal);
  const float offset = light_offset(record, p->position);
  lines.base = (height + (height < 0.0f ? offset : -offset)) * normal - p->offset * p->geometric_normal;
  lines.normal = height < 0.0f ? -normal : normal;
  lines.distance = dot(lines.base, lines.normal);
  const float x0 = dot(begin, lines.across);
  const float y0 = dot(begin, lines.along);
  lines.largest_x = fmax(fabs(x0), fabs(x0 + record[LIGHT_WIDTH]));
  lines.largest_y = fabs(y0) + record[LIGHT_LENGTH] + fabs(record[LIGHT_WIDTH] * record[LIGHT_SLOPE]);
  const float3 normals[2] = {p->normal, p->geometric_normal};
  for (int k = 0; k < 2; ++k) {
    const triple n = to_triple(normals[k]);
    half_line(&lines, exact_dot(n, height * normal), exact_dot(n, lines.across), exact_dot(n, lines.along),
              lines.horizon[k]);
  }
  return lines;
}

/* Least and largest x of a triangle's shadow on the light's plane. */
void shadow_range(const LightLines *lines, const triple corner[3], real range[2]) {
  const float base_x = dot(lines->base, lines->across);
  range[0] = (real)FAR_AWAY;
  range[1] = (real)-FAR_AWAY;
  whole bounded = (whole)-1;
  for (uint c = 0; c < 3; ++c) {
    const real toward = exact_dot(corner[c], lines->normal);
    const real sideways = exact_dot(corner[c], lines->across);
    /* A corner beside the point or behind it: the shadow has no end. */
    bounded = bounded && (toward * STEEPEST > fabs(sideways) + lines->distance);
    const real x = sideways * (lines->distance / toward) - base_x;
    const real margin = SHADOW_MARGIN * (fabs(x) + (lines->largest_x + fabs(base_x)));
    range[0] = min(range[0], x - margin);
    range[1] = max(range[1], x + margin);
  }
  range[0] = SELECT((real)-FAR_AWAY, range[0], bounded);
  range[1] = SELECT((real)FAR_AWAY, range[1], bounded);
}

/* What the triangles `first` and on, TRIANGLES_AT_HAND at most, of a point's list block: rows of half-lines whose
 * common part it is, and of their shadows' ranges. */
void blocked_parts(const LightLines *lines, global const uint *restrict own, const uint first, const uint count,
                   global const float *restrict corners, const uint stride, const float3 origin,
                   float parts[TRIANGLE_ROWS * TRIANGLES_AT_HAND]) {
  for (uint block = 0; block < count; block += VEC) {
    const bits at = min(LANE_NUMBER + block, (bits)(count - 1)) + first;
    const whole triangle = TO_WHOLE(gather_bits(own + 1, at));
    triple corner[3];
    for (uint c = 0; c < 3; ++c) {
      global const float *restrict rows = corners + 3 * c * (ulong)stride;
      corner[c].x = gather(rows, triangle) - origin.x;
      corner[c].y = gather(rows + stride, triangle) - origin.y;
      corner[c].z = gather(rows + 2 * (ulong)stride, triangle) - origin.z;
    }
    triple edge[3];
    edge[0] = exact_cross_triple(corner[1], corner[2]);
    edge[1] = exact_cross_triple(corner[2], corner[0]);
    edge[2] = exact_cross_triple(corner[0], corner[1]);
    const real volume = dot_triple(corner[0], edge[0]);
    const real side = SELECT((real)1.0f, (real)-1.0f, volume < 0.0f);
    real sum[3] = {-fabs(volume), (real)0.0f, (real)0.0f};
    real half_lines[4][HALF_LINE];
    for (uint e = 0; e < 3; ++e) {
      const real c0 = side * exact_dot(edge[e], lines->base);
      const real c1 = side * exact_dot(edge[e], lines->across);
      const real c2 = side * exact_dot(edge[e], lines->along);
      half_line(lines, c0, c1, c2, half_lines[e]);
      sum[0] += c0;
      sum[1] += c1;
      sum[2] += c2;
    }
    half_line(lines, sum[0], sum[1], sum[2], half_lines[3]);
    real range[2];
    shadow_range(lines, corner, range);
    /* Seen edge-on, it blocks nothing. */
    range[0] = SELECT(range[0], (real)FAR_AWAY, (volume == 0.0f) || (LANE_NUMBER + block >= (bits)count));
    for (uint row = 0; row < LEAST_X; ++row)
      STORE(half_lines[row / HALF_LINE][row % HALF_LINE], parts + row * TRIANGLES_AT_HAND + block);
    STORE(range[0], parts + LEAST_X * TRIANGLES_AT_HAND + block);
    STORE(range[1], parts + LARGEST_X * TRIANGLES_AT_HAND + block);
  }
}

/* VEC lines of one light, and what is free of them so far. */
typedef struct {
  real x, begin, sliver;
  float least_x, largest_x;
  Gaps gaps;
} Block;

/* The lines of `here` whole, down to the surface's horizon. */
void begin_block(const LightLines *lines, const real along, const whole here, Block *block) {
  const LightView *view = &lines->view;
  const real x = lines->large ? view_x(view, along, view_angle(view)) : FMA(along, view->width, view->x0);
  block->x = x;
  block->begin = FMA(x - view->x0, view->slope, view->y0);
  block->sliver = SLIVER * min(view->length, sqrt(FMA(x, x, view->z * view->z)));
  real low = block->begin;
  real high = block->begin + view->length;
  for (int k = 0; k < 2; ++k) {
    low = max(low, FMA(lines->horizon[k][1], x, lines->horizon[k][0]));
    high = min(high, FMA(lines->horizon[k][3], x, lines->horizon[k][2]));
  }
  block->gaps.used = 1;
  block->gaps.refused = (whole)0;
  block->gaps.low[0] = low;
  block->gaps.high[0] = SELECT(low, high, here);
  const whole open = here && (low < high);
  block->least_x = -max_lanes(SELECT((real)-FAR_AWAY, -x, open));
  block->largest_x = max_lanes(SELECT((real)-FAR_AWAY, x, open));
}

/* Cuts from VEC lines what `count` triangles block. */
void cut_block(const float parts[TRIANGLE_ROWS * TRIANGLES_AT_HAND], const uint count, Block *block) {
  const real x = block->x;
  for (uint first = 0; first < count && block->gaps.used > 0; first += VEC) {
    const whole near = (LOAD(parts + LEAST_X * TRIANGLES_AT_HAND + first) <= block->largest_x) &&
                       (LOAD(parts + LARGEST_X * TRIANGLES_AT_HAND + first) >= block->least_x);
    if (!ANY(near)) continue;
    int is_near[VEC];
    STORE(near, is_near);
    for (uint lane = 0; lane < VEC; ++lane) {
      if (is_near[lane] == 0) continue;
      const float *part = parts + first + lane;
      real from = (real)-FAR_AWAY;
      real to = (real)FAR_AWAY;
      for (uint k = 0; k < 4; ++k) {
        from = max(from, FMA((real)part[TRIANGLES_AT_HAND], x, (real)part[0]));
        to = min(to, FMA((real)part[3 * TRIANGLES_AT_HAND], x, (real)part[2 * TRIANGLES_AT_HAND]));
        part += HALF_LINE * TRIANGLES_AT_HAND;
      }
      cut_gaps(&block->gaps, from, to, block->sliver);
    }
  }
}

/* Cuts from the lines of `blocks` blocks what the triangles of a point's list block. */
void cut_lines(const LightLines *lines, global const uint *restrict own, global const float *restrict corners,
               const uint stride, const float3 origin, const uint blocks, Block block[BLOCKS_A_ITEM]) {
  float parts[TRIANGLE_ROWS * TRIANGLES_AT_HAND];
  for (uint at = 0; at < own[0]; at += TRIANGLES_AT_HAND) {
    const uint count = min(own[0] - at, (uint)TRIANGLES_AT_HAND);
    blocked_parts(lines, own, at, count, corners, stride, origin, parts);
    for (uint k = 0; k < blocks; ++k) cut_block(parts, count, &block[k]);
  }
}

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
  const LightView *view = &lines->view;
  const Gaps *gaps = &block->gaps;
  const real begin = block->begin;
  const real squared = FMA(block->x, block->x, view->z * view->z);
  const real whole_line = lines->large ? sine_between(squared, begin, begin + view->length) : view->length;
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

/* Moves samples (u, v) of a point whose occluders are known along their lines to where they see the light, for `blocks`
 * blocks of VEC; `share` gets what they count by, `refused` which ones stay where they are, and count by 1. */
void take_visible(const ShadingPoint *p, global const float *restrict lights, global const uint *restrict own,
                  global const float *restrict corners, const uint stride, const uint blocks,
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
    cut_lines(&lines, own, corners, stride, origin, blocks, block);
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
uint test_refused(global const uint *restrict own, global const float *restrict corners, const uint stride,
                  const float3 origin, const real direction[BLOCKS_A_ITEM][3], const int refused[ITEM_SAMPLES],
                  whole open[BLOCKS_A_ITEM]) {
  whole tested[BLOCKS_A_ITEM];
  uint count = 0;
  for (uint k = 0; k < BLOCKS_A_ITEM; ++k) {
    tested[k] = open[k] && LOAD(refused + k * VEC);
    count += (uint)sum_lanes(SELECT((real)0.0f, (real)1.0f, tested[k]));
  }
  if (count == 0) return 0;
  close_blocked(own, corners, stride, origin, direction, tested);
  for (uint k = 0; k < BLOCKS_A_ITEM; ++k) open[k] = open[k] && (tested[k] || !LOAD(refused + k * VEC));
  return count;
}
