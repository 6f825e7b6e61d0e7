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
 * Gaps are cut out of the whole line, triangle after triangle, in any order: what blocks twice does no harm. A line
 * with more than MOST_GAPS of them is refused: its sample stays where it was, and is tested as a point.
 *
 * Where light would arrive from below the point's surface there is none: lines are cut at its horizon, too.
 *
 * Work-group contract: none; functions of private values, and of a point's list, which is read only.
 */

/* A function's half-line: its lower end is [0] + [1] x, its upper end [2] + [3] x, one of which is far away. */
#define HALF_LINE 4
/* Three sides of a triangle and its plane. */
#define TRIANGLE_ROWS (4 * HALF_LINE)
#define FAR_AWAY FLT_MAX
/* Half-lines begin at most this many times as far from the middle as a light does. */
#define STEEPEST 0x1.0p30f
/* Gaps that are shorter than this part of the line, or of its distance, are rounding errors between triangles. */
#define SLIVER 0x1.0p-22f

/* The lines of one light about a point. */
typedef struct {
  LightView view;
  bool large;                  /* seen by solid angle, else by area */
  float3 base, across, along;  /* ends of rays, from their origin */
  float largest_x, largest_y;  /* on the light */
  real horizon[2][HALF_LINE];
} LightLines;

/* What is free of VEC lines: gaps from low to high, empty where low >= high, in any order. */
typedef struct {
  real low[MOST_GAPS], high[MOST_GAPS];
  uint used;
  whole refused;
} Gaps;

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

LightLines lines_of(const ShadingPoint *p, global const float *restrict record) {
  LightLines lines;
  const float3 begin = vload3(0, record) - p->position;
  const float3 edge1 = vload3(1, record);
  const float3 edge2 = vload3(2, record);
  const float3 normal = vload3(3, record);
  lines.along = vload3(0, record + 20);
  lines.across = vload3(0, record + 23);
  const triple middle = to_triple(begin + 0.5f * (edge1 + edge2));
  lines.large = ANY(dot_triple(middle, middle) < record[29]);
  lines.view = view_of(to_triple(begin), to_triple(normal), to_triple(lines.across), to_triple(lines.along),
                       (real)record[27], (real)record[28], (real)record[26]);
  const float height = dot(begin, normal);
  const float offset = light_offset(record, p->position);
  lines.base = (height + (height < 0.0f ? offset : -offset)) * normal - p->offset * p->geometric_normal;
  const float x0 = dot(begin, lines.across);
  const float y0 = dot(begin, lines.along);
  lines.largest_x = fmax(fabs(x0), fabs(x0 + record[27]));
  lines.largest_y = fabs(y0) + record[26] + fabs(record[27] * record[28]);
  const float3 normals[2] = {p->normal, p->geometric_normal};
  for (int k = 0; k < 2; ++k) {
    const triple n = to_triple(normals[k]);
    half_line(&lines, exact_dot(n, height * normal), exact_dot(n, lines.across), exact_dot(n, lines.along),
              lines.horizon[k]);
  }
  return lines;
}

/* The half-lines whose common part a point's occluders block: TRIANGLE_ROWS rows of OCCLUDER_WORDS triangles. */
void blocked_parts(const LightLines *lines, global const uint *restrict own, global const float *restrict corners,
                   const uint stride, const float3 origin, float parts[TRIANGLE_ROWS * OCCLUDER_WORDS]) {
  const uint count = own[0];
  for (uint first = 0; first < count; first += VEC) {
    const bits at = min(LANE_NUMBER + first, (bits)(count - 1));
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
    /* Seen edge-on, it blocks nothing. */
    half_lines[0][0] = SELECT(half_lines[0][0], (real)FAR_AWAY, volume == 0.0f);
    for (uint row = 0; row < TRIANGLE_ROWS; ++row)
      STORE(half_lines[row / HALF_LINE][row % HALF_LINE], parts + row * OCCLUDER_WORDS + first);
  }
}

/* Takes from the gaps what lies between `from` and `to`. */
void cut_gaps(Gaps *gaps, const real from, const real to, const real sliver) {
  const real left_of = from - sliver;
  const real right_of = to + sliver;
  const uint used = gaps->used;
  whole split = (whole)0;
  real end = (real)0.0f;
  for (uint k = 0; k < used; ++k) {
    const real low = gaps->low[k];
    const real high = gaps->high[k];
    const whole hit = (from < high) && (to > low);
    if (!ANY(hit)) continue;
    const whole left = hit && (left_of > low);
    const whole right = hit && (right_of < high);
    end = SELECT(end, high, left && right);
    split = split || (left && right);
    gaps->low[k] = SELECT(low, SELECT(high, to, right), hit && !left);
    gaps->high[k] = SELECT(high, from, left);
  }
  /* Cut in two: the second half takes the first place that is empty. At most one gap of a line is. */
  for (uint k = 0; ANY(split); ++k) {
    if (k == MOST_GAPS) {
      gaps->refused = gaps->refused || split;
      return;
    }
    whole here = split;
    if (k < used) {
      here = here && (gaps->low[k] >= gaps->high[k]);
    } else {
      gaps->low[k] = gaps->high[k] = (real)0.0f;
      gaps->used = k + 1;
    }
    gaps->low[k] = SELECT(gaps->low[k], to, here);
    gaps->high[k] = SELECT(gaps->high[k], end, here);
    split = split && !here;
  }
}

/* What is free of the lines at x, those of `here` that begin at `begin`. */
Gaps free_gaps(const LightLines *lines, const float parts[TRIANGLE_ROWS * OCCLUDER_WORDS], const uint count, const real x,
               const real begin, const whole here) {
  Gaps gaps;
  gaps.used = 1;
  gaps.refused = (whole)0;
  real low = begin;
  real high = begin + lines->view.length;
  for (int k = 0; k < 2; ++k) {
    low = max(low, FMA(lines->horizon[k][1], x, lines->horizon[k][0]));
    high = min(high, FMA(lines->horizon[k][3], x, lines->horizon[k][2]));
  }
  gaps.low[0] = low;
  gaps.high[0] = SELECT(low, high, here);
  const real sliver = SLIVER * min(lines->view.length, sqrt(FMA(x, x, lines->view.z * lines->view.z)));
  for (uint triangle = 0; triangle < count; ++triangle) {
    const float *part = parts + triangle;
    real from = (real)-FAR_AWAY;
    real to = (real)FAR_AWAY;
    for (uint k = 0; k < 4; ++k) {
      from = max(from, FMA((real)part[OCCLUDER_WORDS], x, (real)part[0]));
      to = min(to, FMA((real)part[3 * OCCLUDER_WORDS], x, (real)part[2 * OCCLUDER_WORDS]));
      part += HALF_LINE * OCCLUDER_WORDS;
    }
    const whole blocks = (from < to) && (from < high) && (to > low);
    if (ANY(blocks)) cut_gaps(&gaps, SELECT((real)FAR_AWAY, from, blocks), to, sliver);
  }
  return gaps;
}

/* From y0 to y1 of a line: the difference of sines, without cancellation where both lie on one side of its foot. */
real sine_between(const real squared, const real y0, const real y1) {
  const real inverse0 = rsqrt(FMA(y0, y0, squared));
  const real inverse1 = rsqrt(FMA(y1, y1, squared));
  const real sine0 = y0 * inverse0;
  const real sine1 = y1 * inverse1;
  const real both = inverse0 * inverse1;
  const real same = squared * both * ((y1 - y0) * (y0 + y1) * both) / (sine0 + sine1);
  return SELECT(sine1 - sine0, same, sine0 * sine1 > 0.0f);
}

/* The v below which a share y of what is free lies; returns its length, as v measures it. */
real place_in_gaps(const LightLines *lines, const Gaps *gaps, const real x, const real begin, const real y, real *v) {
  const LightView *view = &lines->view;
  const real squared = FMA(x, x, view->z * view->z);
  const real whole_line = lines->large ? sine_between(squared, begin, begin + view->length) : view->length;
  const real inverse = 1.0f / whole_line;
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

/* Moves samples (u, v) of a point whose occluders are known along their lines to where they see the light, for `blocks`
 * blocks of VEC; `share` gets what they count by, `refused` which ones stay where they are, and count by 1. */
void take_visible(const ShadingPoint *p, global const float *restrict lights, global const uint *restrict own,
                  global const float *restrict corners, const uint stride, const uint blocks,
                  const real u[BLOCKS_A_ITEM], real v[BLOCKS_A_ITEM], real share[BLOCKS_A_ITEM],
                  whole refused[BLOCKS_A_ITEM]) {
  const float3 origin = ray_origin(p);
  global const float *restrict strips = strips_at(lights, p);
  float parts[TRIANGLE_ROWS * OCCLUDER_WORDS];
  for (uint light = 0; light < LIGHT_COUNT; ++light) {
    const float first = strips[2 * light];
    const float width = strips[2 * light + 1];
    whole any_here = (whole)0;
    for (uint k = 0; k < blocks; ++k) any_here = any_here || ((u[k] >= first) && (u[k] < first + width));
    if (!ANY(any_here)) continue;
    const LightLines lines = lines_of(p, lights + light * LIGHT_FLOATS);
    const LightView *view = &lines.view;
    blocked_parts(&lines, own, corners, stride, origin, parts);
    for (uint k = 0; k < blocks; ++k) {
      const whole here = (u[k] >= first) && (u[k] < first + width);
      if (!ANY(here)) continue;
      const real along = (u[k] - first) / width;
      const real x = lines.large ? view_x(view, along, view_angle(view)) : FMA(along, view->width, view->x0);
      const real begin = FMA(x - view->x0, view->slope, view->y0);
      const Gaps gaps = free_gaps(&lines, parts, own[0], x, begin, here);
      const whole moved = here && !gaps.refused;
      real place;
      const real length = place_in_gaps(&lines, &gaps, x, begin, v[k], &place);
      v[k] = SELECT(v[k], place, moved);
      share[k] = SELECT(share[k], length, moved);
      refused[k] = refused[k] || (here && gaps.refused);
    }
  }
}

/* Takes from `open` those of the `refused` that are blocked; returns how many were tested. */
uint test_refused(global const uint *restrict own, global const float *restrict corners, const uint stride,
                  const float3 origin, const real direction[BLOCKS_A_ITEM][3], const whole refused[BLOCKS_A_ITEM],
                  whole open[BLOCKS_A_ITEM]) {
  whole tested[BLOCKS_A_ITEM];
  uint count = 0;
  for (uint k = 0; k < BLOCKS_A_ITEM; ++k) {
    tested[k] = open[k] && refused[k];
    count += (uint)sum_lanes(SELECT((real)0.0f, (real)1.0f, tested[k]));
  }
  if (count == 0) return 0;
  close_blocked(own, corners, stride, origin, direction, tested);
  for (uint k = 0; k < BLOCKS_A_ITEM; ++k) open[k] = open[k] && (tested[k] || !refused[k]);
  return count;
}
