/* Slices of the hemisphere: what the scene's triangles block of all heights over one azimuth, without a ray.
 *
 * The half-plane through a point's origin o spanned by a tangent direction `across` and the normal `up` holds the
 * directions x across + h up. A triangle crosses the plane in a segment; where x > 0, h > 0 and within the radius, it
 * blocks an interval of rises t = h / (x + h), from 0 at the horizon to 1 at the zenith. Over both mappings of ao.cl the
 * integral of visibility along the height is what the union of these intervals leaves free of squared heights
 * w = h^2 / (x^2 + h^2): of 2 u V over heights u, where w = u^2, and of V over u, where w = 1 - u. Rises stand for squared
 * heights all the way, as they order directions alike and take one division. (Billen and Dutre 2016, Line Sampling for
 * Direct Illumination, do so on lights.)
 *
 * The union is kept as what is blocked from the horizon upwards (`low`), what is blocked from the zenith downwards
 * (`high`), and MOST_BLOCKED disjoint intervals between at most. Where these do not suffice the slice is given up,
 * and its sample is left to a ray.
 *
 * Signs. On which side of the plane a corner lies is asked once, by the same arithmetic wherever it occurs; zero
 * counts as one side. A triangle is crossed if two of its corners differ, and the two points come from the two edges
 * by one formula that does not depend on an edge's direction, so neighbours' intervals meet. Only the directions of
 * the two points matter, so they are not divided by their weights. Boxes are entered if they reach the plane but for
 * PLANE_ROUNDING, more than rounding makes of it, so no box hides a triangle that is crossed.
 *
 * Walk. Boxes of boxes of CHILDREN triangles, implicit: box k of a level holds numbers k * CHILDREN and on of the level
 * below. A box is entered if the plane crosses it and some of it is above `low`, below `high` and within the radius; the
 * nearest first, but for leaves.
 *
 * Memory layout: `boxes`: nodes of CHILDREN boxes, six rows of CHILDREN floats each: lower x, y, z, upper x, y, z;
 * node k of level l is number levels[l] + k. `triangles`: leaves of CHILDREN triangles, nine rows: x, y, z of corner 0,
 * then 1, then 2. Boxes and triangles that fill up a node are empty.
 *
 * Work-group contract: none; pure functions of private values and of the hierarchy, VEC boxes or triangles at a time.
 */

typedef struct {
  float3 normal;
  float limit; /* normal . origin */
} SlicePlane;

/* `across`, `up` and `beside` have the length `unit`, one over the largest coordinate, so that products of what is
 * measured along them stay within float's range. */
typedef struct {
  float3 origin, across, up;
  SlicePlane beside, above, below; /* the last two are those through `low` and `high` */
  float radius, unit;
  float low, high;
  uint leaves; /* that were met */
  uint count;
  float first[MOST_BLOCKED], last[MOST_BLOCKED];
} Slice;

/* As take_lowest, the bit whose `distance` is least. */
uint take_nearest(uint *found, const float *distance) {
  uint others = *found;
  uint nearest = take_lowest(&others);
  while (others != 0) {
    const uint other = take_lowest(&others);
    nearest = distance[other] < distance[nearest] ? other : nearest;
  }
  *found ^= 1u << nearest;
  return nearest;
}

/* Adds [first, last] to what is blocked; false if there is no room. */
bool block_rises(Slice *slice, float first, float last) {
  uint kept = 0;
  for (uint k = 0; k < slice->count; ++k) {
    const float own_first = slice->first[k];
    const float own_last = slice->last[k];
    if (own_first <= last && own_last >= first) {
      first = fmin(first, own_first);
      last = fmax(last, own_last);
    } else {
      slice->first[kept] = own_first;
      slice->last[kept++] = own_last;
    }
  }
  slice->count = kept;
  const bool at_low = first <= slice->low;
  const bool at_high = last >= slice->high;
  if (at_low) slice->low = fmax(slice->low, last);
  if (at_high) slice->high = fmin(slice->high, first);
  if (at_low || at_high) return true;
  if (kept == MOST_BLOCKED) return false;
  slice->first[kept] = first;
  slice->last[kept] = last;
  slice->count = kept + 1;
  return true;
}

bool all_blocked(const Slice *slice) { return slice->low >= slice->high; }

float squared_height(const float rise) {
  const float across = 1.0f - rise;
  return rise * rise / FMA(rise, rise, across * across);
}

/* The length of all squared heights that are free. */
float free_heights(const Slice *slice) {
  float left = squared_height(slice->high) - squared_height(slice->low);
  for (uint k = 0; k < slice->count; ++k) left -= squared_height(slice->last[k]) - squared_height(slice->first[k]);
  return fmax(left, 0.0f);
}

real along(const float3 normal, const real x, const real y, const real z) {
  return FMA((real)normal.x, x, FMA((real)normal.y, y, normal.z * z));
}

SlicePlane plane_through(const float3 origin, const float3 normal) {
  return (SlicePlane){normal, dot(normal, origin)};
}

/* The planes between which all free directions lie. */
void narrow_planes(Slice *slice) {
  const float3 above = (1.0f - slice->low) * slice->up - slice->low * slice->across;
  const float3 below = slice->high * slice->across - (1.0f - slice->high) * slice->up;
  slice->above = plane_through(slice->origin, above);
  slice->below = plane_through(slice->origin, below);
}

/* How far VEC boxes reach beyond a plane. */
real most_beyond(const SlicePlane *plane, global const float *restrict boxes) {
  const float3 n = plane->normal;
  const real x = LOAD(boxes + (n.x >= 0.0f ? 3u : 0u) * CHILDREN);
  const real y = LOAD(boxes + (n.y >= 0.0f ? 4u : 1u) * CHILDREN);
  const real z = LOAD(boxes + (n.z >= 0.0f ? 5u : 2u) * CHILDREN);
  return FMA((real)n.x, x, FMA((real)n.y, y, FMA((real)n.z, z, (real)-plane->limit)));
}

/* How far VEC boxes are away along one axis. */
real axis_distance(const float origin, global const float *restrict boxes) {
  return max((real)0.0f, max(LOAD(boxes) - origin, origin - LOAD(boxes + 3 * CHILDREN)));
}

/* How far VEC boxes are away, squared. */
real squared_distance(const float3 origin, global const float *restrict boxes) {
  const real x = axis_distance(origin.x, boxes);
  const real y = axis_distance(origin.y, boxes + CHILDREN);
  const real z = axis_distance(origin.z, boxes + 2 * CHILDREN);
  return FMA(x, x, FMA(y, y, z * z));
}

/* Which boxes of a node can block some of what is free: a bit each. Above the leaves, how far they are away: what is near
 * hides what is far, and there are few such nodes. */
uint boxes_in_slice(const Slice *slice, global const float *restrict node, const uint level, float *distances) {
  const SlicePlane reverse = {-slice->beside.normal, -slice->beside.limit};
  uint found = 0;
  for (uint block = 0; block < CHILDREN; block += VEC) {
    global const float *restrict boxes = node + block;
    const real across = min(most_beyond(&slice->beside, boxes), most_beyond(&reverse, boxes));
    const real within = min(most_beyond(&slice->above, boxes), most_beyond(&slice->below, boxes));
    whole enter = (min(across, within) >= -PLANE_ROUNDING);
    if (level > 0 || slice->radius < INFINITY) {
      const real distance = squared_distance(slice->origin, boxes);
      enter = enter && (distance <= slice->radius * slice->radius);
      STORE(distance, distances + block);
    }
    found |= lane_mask(enter) << block;
  }
  return found;
}

/* A corner of triangles in the slice: on which side of its plane, and where in it. */
typedef struct {
  real side, x, h;
} SliceCorner;

SliceCorner select_corner(const SliceCorner a, const SliceCorner b, const whole is_b) {
  return (SliceCorner){SELECT(a.side, b.side, is_b), SELECT(a.x, b.x, is_b), SELECT(a.h, b.h, is_b)};
}

/* Where the edge between corners on two sides crosses the plane, but for a positive factor, which `side` becomes. */
SliceCorner crossing(const SliceCorner a, const SliceCorner b) {
  /* The same from b to a: no product may be fused into the sum. */
#pragma OPENCL FP_CONTRACT OFF
  const real of_a = fabs(b.side);
  const real of_b = fabs(a.side);
  const real a_x = of_a * a.x;
  const real b_x = of_b * b.x;
  const real a_h = of_a * a.h;
  const real b_h = of_b * b.h;
  return (SliceCorner){of_a + of_b, a_x + b_x, a_h + b_h};
}

/* Which ends can be outside of the disc about the origin. */
whole reaches_beyond(const float radius, const SliceCorner a) { return fabs(a.x) + fabs(a.h) > radius * a.side; }

SliceCorner divided(const SliceCorner a) {
  const real inverse = 1.0f / a.side;
  return (SliceCorner){(real)1.0f, a.x * inverse, a.h * inverse};
}

/* Moves ends of segments that are outside of the disc about the origin onto it, and leaves others as they are; returns
 * for which something is inside. */
whole clip_to_disc(const float radius, SliceCorner *a, SliceCorner *b) {
  const SliceCorner from = divided(*a);
  const SliceCorner to = divided(*b);
  const real x = to.x - from.x;
  const real h = to.h - from.h;
  const real length2 = x * x + h * h;
  const real inverse = 1.0f / length2;
  const real off = from.x * to.h - to.x * from.h;
  const real root2 = length2 * (radius * radius) - off * off;
  const real root = sqrt(max((real)0.0f, root2));
  const real middle = -(from.x * x + from.h * h);
  const real enters = (middle - root) * inverse;
  const real leaves = (middle + root) * inverse;
  const SliceCorner start = {(real)1.0f, FMA(enters, x, from.x), FMA(enters, h, from.h)};
  const SliceCorner end = {(real)1.0f, FMA(leaves, x, from.x), FMA(leaves, h, from.h)};
  *a = select_corner(*a, start, enters > 0.0f);
  *b = select_corner(*b, end, leaves < 1.0f);
  return (root2 > 0.0f) && (enters < 1.0f) && (leaves > 0.0f);
}

/* Of ends in the quadrant. */
real rise_of(const SliceCorner a) { return a.h / (a.x + a.h); }

/* The rises that segments block; which block any. Seen from the origin, a segment is an arc of less than half a turn,
 * counterclockwise from `first` to `last`: it begins below the quadrant or in it, and ends in it or behind. */
whole rises_of(const SliceCorner a, const SliceCorner b, real *lower, real *upper) {
  const whole clockwise = (a.x * b.h < a.h * b.x);
  const SliceCorner first = select_corner(a, b, clockwise);
  const SliceCorner last = select_corner(b, a, clockwise);
  const real from = SELECT(rise_of(first), (real)0.0f, first.h < 0.0f);
  const real to = SELECT(rise_of(last), (real)1.0f, last.x < 0.0f);
  *lower = min(from, to);
  *upper = max(from, to);
  return (max(a.h, b.h) >= 0.0f) && (max(a.x, b.x) >= 0.0f) && (max(first.x, -first.h) > 0.0f);
}

/* Blocks what a leaf's triangles block; false if there is no room. */
bool meet_triangles(Slice *slice, global const float *restrict leaf) {
  for (uint block = 0; block < CHILDREN; block += VEC) {
    real x[3], y[3], z[3];
    SliceCorner corner[3];
    whole positive[3];
#pragma unroll
    for (uint c = 0; c < 3; ++c) {
      x[c] = LOAD(leaf + (3 * c) * CHILDREN + block) - slice->origin.x;
      y[c] = LOAD(leaf + (3 * c + 1) * CHILDREN + block) - slice->origin.y;
      z[c] = LOAD(leaf + (3 * c + 2) * CHILDREN + block) - slice->origin.z;
      corner[c].side = along(slice->beside.normal, x[c], y[c], z[c]);
      positive[c] = (corner[c].side >= 0.0f);
    }
    whole meets = (positive[0] != positive[1]) || (positive[0] != positive[2]);
    if (!ANY(meets)) continue;
#pragma unroll
    for (uint c = 0; c < 3; ++c) {
      corner[c].x = along(slice->across, x[c], y[c], z[c]);
      corner[c].h = along(slice->up, x[c], y[c], z[c]);
    }
    /* The corner that is alone on its side, and the two others. */
    const whole second = (positive[0] == positive[2]);
    const whole third = (positive[0] == positive[1]);
    const SliceCorner alone = select_corner(select_corner(corner[0], corner[1], second), corner[2], third);
    SliceCorner a = crossing(alone, select_corner(corner[1], corner[0], second || third));
    SliceCorner b = crossing(alone, select_corner(corner[2], corner[1], third));
    if (slice->radius < INFINITY) {
      const float radius = slice->radius * slice->unit;
      const whole far = reaches_beyond(radius, a) || reaches_beyond(radius, b);
      if (ANY(meets && far)) {
        SliceCorner clipped_a = a;
        SliceCorner clipped_b = b;
        const whole is_near = clip_to_disc(radius, &clipped_a, &clipped_b);
        meets = meets && (is_near || !far);
        a = select_corner(a, clipped_a, far);
        b = select_corner(b, clipped_b, far);
      }
    }
    real lower, upper;
    const whole blocks = rises_of(a, b, &lower, &upper);
    meets = meets && blocks;
    lower = max(lower, (real)slice->low);
    upper = min(upper, (real)slice->high);
    uint found = lane_mask(meets && (lower < upper));
    float first[VEC], last[VEC];
    STORE(lower, first);
    STORE(upper, last);
    const float low = slice->low;
    const float high = slice->high;
    while (found != 0) {
      const uint lane = take_lowest(&found);
      if (!block_rises(slice, first[lane], last[lane])) return false;
    }
    if (slice->low != low || slice->high != high) narrow_planes(slice);
  }
  return true;
}

/* Blocks what all triangles block; false if there is no room. */
bool walk_slice(Slice *slice, global const uint *restrict levels, global const float *restrict boxes,
                global const float *restrict triangles) {
  uint found[SLICE_LEVELS], node[SLICE_LEVELS];
  float distances[SLICE_LEVELS][CHILDREN];
  uint level = SLICE_LEVELS - 1;
  node[level] = 0;
  found[level] = boxes_in_slice(slice, boxes + levels[level] * (ulong)(6 * CHILDREN), level, distances[level]);
  while (true) {
    while (found[level] == 0) {
      if (++level == SLICE_LEVELS) return true;
    }
    if (level > 0) {
      const uint child = node[level] * CHILDREN + take_nearest(&found[level], distances[level]);
      node[--level] = child;
      global const float *restrict own = boxes + (levels[level] + child) * (ulong)(6 * CHILDREN);
      found[level] = boxes_in_slice(slice, own, level, distances[level]);
    } else {
      const uint child = node[0] * CHILDREN + take_lowest(&found[0]);
      ++slice->leaves;
      if (!meet_triangles(slice, triangles + child * (ulong)(9 * CHILDREN))) return false;
      if (all_blocked(slice)) return true;
    }
  }
}

/* The slice at an azimuth of 2 pi `turn`, of which nothing is blocked but what lies below the point's own triangle,
 * whatever the shading normal says. */
Slice slice_at(const ShadingPoint *p, const float radius, const float unit, const float turn) {
  float3 tangent, bitangent;
  tangent_frame(p->normal, &tangent, &bitangent);
  float cosine;
  const float sine = sincos(2.0f * M_PI_F * turn, &cosine);
  Slice slice;
  slice.origin = ray_origin(p);
  slice.across = unit * (cosine * tangent + sine * bitangent);
  slice.beside = plane_through(slice.origin, unit * (cosine * bitangent - sine * tangent));
  slice.up = unit * p->normal;
  slice.radius = radius;
  slice.unit = unit;
  const float fall = fmax(0.0f, -dot(slice.across, p->geometric_normal));
  const float rise = dot(slice.up, p->geometric_normal);
  slice.low = 1.0f / (1.0f + rise / fall);
  slice.high = 1.0f;
  slice.leaves = slice.count = 0;
  narrow_planes(&slice);
  return slice;
}

/* Of the slices `wanted`, at azimuths 2 pi `turns`: the integral of visibility over height. Returns which had no
 * room for what is blocked; their integrals are not known. */
whole slice_integrals(const ShadingPoint *p, const float radius, const float unit,
                      global const uint *restrict levels, global const float *restrict boxes,
                      global const float *restrict triangles, const whole wanted,
                      const real turns, real *integral) {
  float turn[VEC], left[VEC];
  int refused[VEC], is_wanted[VEC];
  STORE(turns, turn);
  STORE(wanted, is_wanted);
  for (uint lane = 0; lane < VEC; ++lane) {
    left[lane] = 0.0f;
    refused[lane] = 0;
    if (is_wanted[lane] == 0) continue;
    Slice slice = slice_at(p, radius, unit, turn[lane]);
    if (!walk_slice(&slice, levels, boxes, triangles)) refused[lane] = -1;
    left[lane] = free_heights(&slice);
  }
  *integral = LOAD(left);
  return LOAD(refused);
}
