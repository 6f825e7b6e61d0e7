/* The lines of a light about a point, and what a point's listed occluders leave free of them: exactly, without a ray.
 *
 * A line u = const on a light (lights.cl) is a segment along edge2: seen from the point its ray ends are base + x across +
 * y along, with x fixed by u, and y in [begin, begin + length]. A triangle blocks an interval of y. What all triangles
 * leave free of the line are its gaps (gaps.cl).
 *
 * The interval. Which side of an edge a ray passes, and whether it reaches the triangle's plane before its end (shaft.cl),
 * are signs of functions c0 + c1 x + c2 y: each is a half-line in y that begins or ends at -(c0 + c1 x) / c2. These
 * numbers are found once for all lines, for VEC triangles at a time; lines then take VEC lanes.
 * Two triangles with a common edge get the same numbers with their signs turned, so their intervals meet bit for bit.
 *
 * Only those of the listed triangles are looked at whose shadows, seen as ranges of x, reach the VEC lines.
 *
 * Gaps are cut out of the whole line, triangle after triangle, in any order: what blocks twice does no harm.
 * Where light would arrive from below the point's surface there is none: lines are cut at its horizon, too.
 *
 * Work-group contract: none; functions of private values, and of a point's list, which is read only.
 */

/* A function's half-line: its lower end is [0] + [1] x, its upper end [2] + [3] x, one of which is far away. */
#define HALF_LINE 4
/* Of a triangle: three sides and its plane. */
#define SIDES 4
/* After their half-lines the least and the largest x of the shadow. */
#define LEAST_X (SIDES * HALF_LINE)
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
  Plane ends[2];               /* as a shaft's last two */
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
#if VEC == 1
  return x;
#else
#if VEC == 16
  const float8 m8 = max(x.lo, x.hi);
  const float4 m4 = max(m8.lo, m8.hi);
#elif VEC == 8
  const float4 m4 = max(x.lo, x.hi);
#else
  const float4 m4 = x;
#endif
  const float2 m2 = max(m4.lo, m4.hi);
  return max(m2.x, m2.y);
#endif
}

float min_lanes(const real x) { return -max_lanes(-x); }

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
  lines.ends[0] = (Plane){lines.normal, lines.distance + 0.5f * offset};
  lines.ends[1] = (Plane){-p->geometric_normal, 0.5f * p->offset};
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

/* What VEC triangles block: half-lines whose common part it is, each a row of `parts`. Returns which block nothing, seen
 * edge-on. */
whole blocked_parts(const LightLines *lines, const triple corner[3], const uint row_floats, float *parts) {
  triple edge[3];
  edge[0] = exact_cross_triple(corner[1], corner[2]);
  edge[1] = exact_cross_triple(corner[2], corner[0]);
  edge[2] = exact_cross_triple(corner[0], corner[1]);
  const real volume = dot_triple(corner[0], edge[0]);
  const real side = SELECT((real)1.0f, (real)-1.0f, volume < 0.0f);
  real sum[3] = {-fabs(volume), (real)0.0f, (real)0.0f};
  real half_lines[SIDES][HALF_LINE];
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
  for (uint row = 0; row < SIDES * HALF_LINE; ++row)
    STORE(half_lines[row / HALF_LINE][row % HALF_LINE], parts + row * row_floats);
  return volume == 0.0f;
}

/* The same of the triangles `first` and on, TRIANGLES_AT_HAND at most, of a point's list, and their shadows' ranges. */
void listed_parts(const LightLines *lines, global const uint *restrict own, const uint first, const uint count,
                  global const float *restrict triangles, const float3 origin,
                  float parts[TRIANGLE_ROWS * TRIANGLES_AT_HAND]) {
  for (uint block = 0; block < count; block += VEC) {
    const bits at = min(LANE_NUMBER + block, (bits)(count - 1)) + first;
    const bits number = gather_bits(own + 1, at);
    const whole row = TO_WHOLE(number / CHILDREN * LEAF_FLOATS + number % CHILDREN);
    triple corner[3];
    for (uint c = 0; c < 3; ++c) {
      global const float *restrict rows = triangles + 3 * c * CHILDREN;
      corner[c].x = gather(rows, row) - origin.x;
      corner[c].y = gather(rows + CHILDREN, row) - origin.y;
      corner[c].z = gather(rows + 2 * CHILDREN, row) - origin.z;
    }
    const whole flat = blocked_parts(lines, corner, TRIANGLES_AT_HAND, parts + block);
    real range[2];
    shadow_range(lines, corner, range);
    range[0] = SELECT(range[0], (real)FAR_AWAY, flat || (LANE_NUMBER + block >= (bits)count));
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
  block->least_x = min_lanes(SELECT((real)FAR_AWAY, x, open));
  block->largest_x = max_lanes(SELECT((real)-FAR_AWAY, x, open));
}

/* Cuts from VEC lines what one triangle blocks, whose parts are `row_floats` apart. */
void cut_triangle(const float *part, const uint row_floats, Block *block) {
  const real x = block->x;
  real from = (real)-FAR_AWAY;
  real to = (real)FAR_AWAY;
  for (uint k = 0; k < SIDES; ++k) {
    from = max(from, FMA((real)part[row_floats], x, (real)part[0]));
    to = min(to, FMA((real)part[3 * row_floats], x, (real)part[2 * row_floats]));
    part += HALF_LINE * row_floats;
  }
  cut_gaps(&block->gaps, from, to, block->sliver);
}

/* Cuts from VEC lines what `count` listed triangles block. */
void cut_block(const float parts[TRIANGLE_ROWS * TRIANGLES_AT_HAND], const uint count, Block *block) {
  for (uint first = 0; first < count && block->gaps.used > 0; first += VEC) {
    uint near = lane_mask((LOAD(parts + LEAST_X * TRIANGLES_AT_HAND + first) <= block->largest_x) &&
                          (LOAD(parts + LARGEST_X * TRIANGLES_AT_HAND + first) >= block->least_x));
    while (near != 0) cut_triangle(parts + first + take_lowest(&near), TRIANGLES_AT_HAND, block);
  }
}

/* Cuts from the lines of `blocks` blocks what the triangles of a point's list block. */
void cut_lines(const LightLines *lines, global const uint *restrict own, global const float *restrict triangles,
               const float3 origin, const uint blocks, Block block[BLOCKS_A_ITEM]) {
  float parts[TRIANGLE_ROWS * TRIANGLES_AT_HAND];
  for (uint at = 0; at < own[0]; at += TRIANGLES_AT_HAND) {
    const uint count = min(own[0] - at, (uint)TRIANGLES_AT_HAND);
    listed_parts(lines, own, at, count, triangles, origin, parts);
    for (uint k = 0; k < blocks; ++k) cut_block(parts, count, &block[k]);
  }
}
