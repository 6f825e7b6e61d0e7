/* The lines of a light about a point, and what a point's listed occluders leave free of them: exactly, without a ray.
 *
 * A line u = const on a light (lights.cl) is a segment along edge2: seen from the point its ray ends are base + x across +
 * y along, with x fixed by u, and y in [begin, begin + length]. A triangle blocks an interval of y. What all triangles
 * leave free of the line are its gaps (gaps.cl).
 *
 * The interval. Which side of an edge a ray passes, and whether it reaches the triangle's plane before its end (shaft.cl),
 * are signs of functions c0 + c1 x + c2 y: each is a half-line in y that begins or ends at -(c0 + c1 x) / c2. These
 * numbers are found once for all lines of an item, for VEC triangles at a time; lines then take VEC lanes.
 * Two triangles with a common edge get the same numbers with their signs turned, so their intervals meet bit for bit.
 *
 * Of the triangles only those are looked at whose shadows on the light reach a rectangle about what is still open of the
 * lines.
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

/* A rectangle on a light: x across it and y along it, from the foot of the point. */
typedef struct {
  float least_x, largest_x, least_y, largest_y;
} Extent;

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

/* Which of VEC triangles cast their shadows on some of the rectangle, but for rounding. */
uint shadows_on(const real shadow[4], const Extent *extent) {
  return lane_mask((shadow[0] <= extent->largest_x) && (shadow[1] >= extent->least_x) &&
                   (shadow[2] <= extent->largest_y) && (shadow[3] >= extent->least_y));
}

/* Where the shadows of triangles on the light's plane begin and end: in x, and in y. */
void find_shadows(const LightLines *lines, const triple corner[3], real shadow[4]) {
  const float3 axis[2] = {lines->across, lines->along};
  const float largest[2] = {lines->largest_x, lines->largest_y};
  real shrinks[3];
  whole bounded = (whole)-1;
  for (uint c = 0; c < 3; ++c) {
    const real toward = exact_dot(corner[c], lines->normal);
    /* A corner beside the point or behind it: the shadow has no end. */
    const real size = fabs(corner[c].x) + fabs(corner[c].y) + fabs(corner[c].z);
    bounded = bounded && (toward * STEEPEST > size + lines->distance);
    shrinks[c] = lines->distance / toward;
  }
  for (uint k = 0; k < 2; ++k) {
    const float base = dot(lines->base, axis[k]);
    real low = (real)FAR_AWAY;
    real high = (real)-FAR_AWAY;
    for (uint c = 0; c < 3; ++c) {
      const real at = FMA(exact_dot(corner[c], axis[k]), shrinks[c], (real)-base);
      const real margin = SHADOW_MARGIN * (fabs(at) + (largest[k] + fabs(base)));
      low = min(low, at - margin);
      high = max(high, at + margin);
    }
    shadow[2 * k] = SELECT((real)-FAR_AWAY, low, bounded);
    shadow[2 * k + 1] = SELECT((real)FAR_AWAY, high, bounded);
  }
}

/* What VEC triangles block: half-lines whose common part it is, each a row of `parts`. Returns which block nothing, seen
 * edge-on. */
whole blocked_parts(const LightLines *lines, const triple corner[3], float parts[SIDES * HALF_LINE * VEC]) {
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
    STORE(half_lines[row / HALF_LINE][row % HALF_LINE], parts + row * VEC);
  return volume == 0.0f;
}

/* VEC lines of one light, and what is free of them so far. */
typedef struct {
  real x, begin, length, sliver;
  Gaps gaps;
  Extent open; /* about all gaps, empty if there is none */
} Block;

/* Narrows what is open of a block to the gaps that are left. */
void narrow_block(Block *block) {
  const Gaps *gaps = &block->gaps;
  real low = (real)FAR_AWAY;
  real high = (real)-FAR_AWAY;
  for (uint k = 0; k < gaps->used; ++k) {
    const whole is_gap = gaps->low[k] < gaps->high[k];
    low = SELECT(low, min(low, gaps->low[k]), is_gap);
    high = SELECT(high, max(high, gaps->high[k]), is_gap);
  }
  const whole open = low < high;
  block->open.least_x = min_lanes(SELECT((real)FAR_AWAY, block->x, open));
  block->open.largest_x = max_lanes(SELECT((real)-FAR_AWAY, block->x, open));
  block->open.least_y = min_lanes(low);
  block->open.largest_y = max_lanes(high);
}

/* The lines of `here` whole, down to the surface's horizon. */
void begin_block(const LightLines *lines, const real along, const whole here, Block *block) {
  const LightView *view = &lines->view;
#if HAS_SHAPES
  real density;
  const real share = toward_tip(view->shape, along, &density);
#else
  const real share = along;
#endif
  const real x = lines->large ? view_x(view, share, view_angle(view)) : FMA(share, view->width, view->x0);
  block->x = x;
  block->begin = line_of_light(view, x, &block->length);
  block->sliver = SLIVER * min(block->length, sqrt(FMA(x, x, view->z * view->z)));
  real low = block->begin;
  real high = block->begin + block->length;
  for (int k = 0; k < 2; ++k) {
    low = max(low, FMA(lines->horizon[k][1], x, lines->horizon[k][0]));
    high = min(high, FMA(lines->horizon[k][3], x, lines->horizon[k][2]));
  }
  block->gaps.used = 1;
  block->gaps.refused = (whole)0;
  block->gaps.low[0] = low;
  block->gaps.high[0] = SELECT(low, high, here);
  narrow_block(block);
}

/* Cuts from VEC lines what one triangle blocks; returns whether that is something. */
bool cut_triangle(const float *part, Block *block) {
  const real x = block->x;
  real from = (real)-FAR_AWAY;
  real to = (real)FAR_AWAY;
  for (uint k = 0; k < SIDES; ++k) {
    from = max(from, FMA((real)part[VEC], x, (real)part[0]));
    to = min(to, FMA((real)part[3 * VEC], x, (real)part[2 * VEC]));
    part += HALF_LINE * VEC;
  }
  return cut_gaps(&block->gaps, from, to, block->sliver);
}

/* Cuts from `blocks` blocks what those of VEC triangles block that are in `wanted`; returns whether that is something. */
bool cut_triangles(const LightLines *lines, const triple corner[3], const uint wanted, const uint blocks,
                   Block block[BLOCKS_A_ITEM]) {
  real shadow[4];
  find_shadows(lines, corner, shadow);
  float parts[SIDES * HALF_LINE * VEC];
  uint found = wanted;
  bool has_parts = false;
  bool cuts = false;
  for (uint k = 0; k < blocks; ++k) {
    uint near = found & shadows_on(shadow, &block[k].open);
    if (near != 0 && !has_parts) {
      found &= ~lane_mask(blocked_parts(lines, corner, parts));
      near &= found;
      has_parts = true;
    }
    bool cut = false;
    while (near != 0) cut = cut_triangle(parts + take_lowest(&near), &block[k]) || cut;
    if (cut) narrow_block(&block[k]);
    cuts = cuts || cut;
  }
  return cuts;
}

/* Whether nothing is left open of any block. */
bool all_closed(const uint blocks, const Block block[BLOCKS_A_ITEM]) {
  for (uint k = 0; k < blocks; ++k)
    if (block[k].open.least_x <= block[k].open.largest_x) return false;
  return true;
}

/* Cuts from the lines of `blocks` blocks what the triangles of a point's list block. */
void cut_lines(const LightLines *lines, global const uint *restrict own, global const float *restrict triangles,
               const float3 origin, const uint blocks, Block block[BLOCKS_A_ITEM]) {
  const uint count = own[0];
  bool changed = true;
  for (uint first = 0; first < count; first += VEC) {
    if (changed && all_closed(blocks, block)) return;
    const bits at = min(LANE_NUMBER + first, (bits)(count - 1));
    const bits number = gather_bits(own + 1, at);
    const whole row = TO_WHOLE(number / CHILDREN * LEAF_FLOATS + number % CHILDREN);
    triple corner[3];
    for (uint c = 0; c < 3; ++c) {
      global const float *restrict rows = triangles + 3 * c * CHILDREN;
      corner[c].x = gather(rows, row) - origin.x;
      corner[c].y = gather(rows + CHILDREN, row) - origin.y;
      corner[c].z = gather(rows + 2 * CHILDREN, row) - origin.z;
    }
    changed = cut_triangles(lines, corner, lane_mask(LANE_NUMBER + first < (bits)count), blocks, block);
  }
}
