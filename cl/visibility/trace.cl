/* Rays through a scene's boxes of boxes of triangles: what a ray meets first, and whether it meets anything.
 *
 * A work-item follows one ray; its VEC lanes are boxes of a node, or triangles of a leaf, as hierarchy.py lays them out:
 * box k of a level holds numbers k * CHILDREN and on of the level below. So a way down is a number, a parent is found by
 * a division, and all that has to be kept of a walk is which boxes of the nodes above still wait: CHILDREN bits
 * a level, in one word or two. There is no stack in memory.
 *
 * The triangle test is that of Woop, Benthin and Wald 2013 (Watertight Ray/Triangle Intersection): space is sheared so
 * that the ray is an axis, and which sides of the edges it passes are signs of differences of two products. Without
 * contraction a difference that is not zero has the sign of the exact one, and one that is zero is computed
 * again, exactly but for its last rounding; zero itself counts as inside. So two triangles with a common edge always agree
 * on which side of it the ray passes, and no ray slips through between them.
 *
 * The boxes are widened by more than rounding moves a triangle by in sheared space, so that a triangle is never missed
 * for its box.
 *
 * Answers are the same for all VEC: of triangles at one distance the first of a leaf counts, and boxes are
 * entered nearest first, of equals the first.
 *
 * Memory layout: `levels`, `boxes` and `triangles` as in shaft.cl. `extent`: the scene's largest coordinate.
 *
 * Work-group contract: none; functions of private values, and of the hierarchy, which is read only.
 */

#define NODE_FLOATS (6 * CHILDREN)
#define LEAF_FLOATS (9 * CHILDREN)
#define ALL_CHILDREN ((1u << CHILDREN) - 1u)
/* What a word holds of a walk. */
#define WORD_BITS 64
#define LEVELS_A_WORD (WORD_BITS / CHILDREN)
/* What rounding may move a triangle by, of the largest coordinate from the ray's origin, and a distance by, of itself:
 * sixteen roundings, where some ten are made. */
#define TRACE_SLACK 0x1.0p-20f
/* Directions are taken for at least so much along each axis, or distances would be infinite over infinite. */
#define LEAST_SLOPE 1e-18f

typedef ulong word;

/* Boxes of boxes of triangles. */
typedef struct {
  global const uint *levels;
  global const float *boxes;
  global const float *triangles;
  float extent;
} Tree;

typedef struct {
  /* Of boxes: the origin, moved backwards and onwards by what rounding may do, and distances over coordinates. */
  float3 near_origin, far_origin, inverse;
  /* Rows of a node: the sides of a box where the ray enters, and where it leaves. */
  uint3 near_row, far_row;
  /* Of triangles: the axes in the order that has the direction's largest last, and what shears it onto that one. */
  uint x_axis, y_axis, z_axis;
  float x_origin, y_origin, z_origin;
  float x_shear, y_shear, z_shear;
} TracedRay;

/* What a ray meets: the triangle's place in the hierarchy or -1, and as `Hits` in trace.py. */
typedef struct {
  int place;
  float distance, u, v;
} Met;

/* Which boxes of the nodes above still wait, the nearest node's last. */
typedef struct {
  word last;
#if BOX_LEVELS > LEVELS_A_WORD + 1
  word first;
#endif
} Waiting;

void push_waiting(Waiting *above, const uint own) {
#if BOX_LEVELS > LEVELS_A_WORD + 1
  above->first = above->first << CHILDREN | above->last >> (WORD_BITS - CHILDREN);
#endif
  above->last = above->last << CHILDREN | own;
}

uint pop_waiting(Waiting *above) {
  const uint own = (uint)above->last & ALL_CHILDREN;
  above->last >>= CHILDREN;
#if BOX_LEVELS > LEVELS_A_WORD + 1
  above->last |= above->first << (WORD_BITS - CHILDREN);
  above->first >>= CHILDREN;
#endif
  return own;
}

/* The coordinate along an axis, by values: compilers may put a vector into memory to choose from it. */
float along_axis(const uint axis, const float x, const float y, const float z) {
  return axis == 0 ? x : axis == 1 ? y : z;
}

TracedRay traced_ray(const Tree *tree, const float3 origin, const float3 direction) {
  TracedRay ray;
  const float3 size = fabs(direction);
  const float3 way = (float3)(direction.x < 0.0f ? -1.0f : 1.0f, direction.y < 0.0f ? -1.0f : 1.0f,
                              direction.z < 0.0f ? -1.0f : 1.0f);
  ray.inverse = way / fmax(size, (float3)(LEAST_SLOPE));
  const float3 margin = TRACE_SLACK * (tree->extent + fmax(fabs(origin.x), fmax(fabs(origin.y), fabs(origin.z)))) * way;
  ray.near_origin = origin + margin;
  ray.far_origin = origin - margin;
  const uint3 turned = (uint3)(way.x < 0.0f ? 3u : 0u, way.y < 0.0f ? 3u : 0u, way.z < 0.0f ? 3u : 0u);
  ray.near_row = ((uint3)(0u, 1u, 2u) + turned) * CHILDREN;
  ray.far_row = ((uint3)(3u, 4u, 5u) - turned) * CHILDREN;
  ray.z_axis = size.x > size.y ? (size.x > size.z ? 0u : 2u) : (size.y > size.z ? 1u : 2u);
  ray.x_axis = ray.z_axis == 2u ? 0u : ray.z_axis + 1u;
  ray.y_axis = ray.x_axis == 2u ? 0u : ray.x_axis + 1u;
  ray.x_origin = along_axis(ray.x_axis, origin.x, origin.y, origin.z);
  ray.y_origin = along_axis(ray.y_axis, origin.x, origin.y, origin.z);
  ray.z_origin = along_axis(ray.z_axis, origin.x, origin.y, origin.z);
  ray.z_shear = 1.0f / along_axis(ray.z_axis, direction.x, direction.y, direction.z);
  ray.x_shear = -along_axis(ray.x_axis, direction.x, direction.y, direction.z) * ray.z_shear;
  ray.y_shear = -along_axis(ray.y_axis, direction.x, direction.y, direction.z) * ray.z_shear;
  return ray;
}

/* Which of VEC boxes a ray enters before `farthest`, and where. */
whole boxes_met(const TracedRay *ray, global const float *restrict box, const float farthest, real *entry) {
  const real near_x = (LOAD(box + ray->near_row.x) - ray->near_origin.x) * ray->inverse.x;
  const real near_y = (LOAD(box + ray->near_row.y) - ray->near_origin.y) * ray->inverse.y;
  const real near_z = (LOAD(box + ray->near_row.z) - ray->near_origin.z) * ray->inverse.z;
  const real far_x = (LOAD(box + ray->far_row.x) - ray->far_origin.x) * ray->inverse.x;
  const real far_y = (LOAD(box + ray->far_row.y) - ray->far_origin.y) * ray->inverse.y;
  const real far_z = (LOAD(box + ray->far_row.z) - ray->far_origin.z) * ray->inverse.z;
  *entry = max(max(near_x, near_y), max(near_z, (real)0.0f));
  const real leaves = min(far_x, min(far_y, far_z)) * (1.0f + TRACE_SLACK);
  return *entry <= min(leaves, (real)farthest);
}

/* a b - c d with the sign of the exact difference. */
real signed_difference(const real a, const real b, const real c, const real d) {
#pragma OPENCL FP_CONTRACT OFF
  const real first = a * b;
  const real second = c * d;
  const real rounded = first - second;
  const whole is_lost = rounded == 0.0f;
  if (!ANY(is_lost)) return rounded;
  return SELECT(rounded, fma(a, b, -first) - fma(c, d, -second), is_lost);
}

/* Which of VEC triangles a ray meets before `farthest`, and as `Met`. */
whole triangles_met(const TracedRay *ray, global const float *restrict leaf, const float farthest, real *distance,
                    real *u, real *v) {
#pragma OPENCL FP_CONTRACT OFF
  real x[3], y[3], z[3];
#pragma unroll
  for (uint c = 0; c < 3; ++c) {
    global const float *restrict rows = leaf + 3 * c * CHILDREN;
    z[c] = LOAD(rows + ray->z_axis * CHILDREN) - ray->z_origin;
    x[c] = FMA((real)ray->x_shear, z[c], LOAD(rows + ray->x_axis * CHILDREN) - ray->x_origin);
    y[c] = FMA((real)ray->y_shear, z[c], LOAD(rows + ray->y_axis * CHILDREN) - ray->y_origin);
  }
  const real side_0 = signed_difference(x[2], y[1], y[2], x[1]);
  const real side_1 = signed_difference(x[0], y[2], y[0], x[2]);
  const real side_2 = signed_difference(x[1], y[0], y[1], x[0]);
  const real low = min(side_0, min(side_1, side_2));
  const real high = max(side_0, max(side_1, side_2));
  const real volume = side_0 + side_1 + side_2;
  /* A triangle that is seen edge-on has no volume. */
  const whole inside = ((low >= 0.0f) || (high <= 0.0f)) && (volume != 0.0f);
  if (!ANY(inside)) return (whole)0;
  const real inverse = 1.0f / SELECT((real)1.0f, volume, inside);
  *distance = FMA(side_0, z[0], FMA(side_1, z[1], side_2 * z[2])) * ray->z_shear * inverse;
  *u = side_1 * inverse;
  *v = side_2 * inverse;
  return inside && (*distance > 0.0f) && (*distance < farthest);
}

/* Takes out of `waiting` those boxes of a node that are not entered before `farthest`, and the nearest, which it
 * returns; CHILDREN if there is none. */
uint take_nearest(const TracedRay *ray, global const float *restrict node, const float farthest, uint *waiting) {
  uint found = 0;
  uint nearest = CHILDREN;
  float least = MAXFLOAT;
  for (uint block = 0; block < CHILDREN; block += VEC) {
    const uint own = (*waiting >> block) & (ALL_CHILDREN >> (CHILDREN - VEC));
    if (own == 0) continue;
    real entry;
    const whole met = boxes_met(ray, node + block, farthest, &entry);
    const uint here = lane_mask(met) & own;
    if (here == 0) continue;
    found |= here << block;
    const whole wanted = TO_WHOLE(((bits)here >> LANE_NUMBER) & 1u) != 0;
    const float own_least = min_lanes(SELECT((real)MAXFLOAT, entry, wanted));
    if (nearest == CHILDREN || own_least < least) {
      uint equals = lane_mask(wanted && (entry <= own_least));
      nearest = block + take_lowest(&equals);
      least = own_least;
    }
  }
  *waiting = found & ~(1u << nearest);
  return nearest;
}

/* Which boxes of a node a ray enters before `farthest`. */
uint take_met(const TracedRay *ray, global const float *restrict node, const float farthest) {
  uint found = 0;
  for (uint block = 0; block < CHILDREN; block += VEC) {
    real entry;
    found |= lane_mask(boxes_met(ray, node + block, farthest, &entry)) << block;
  }
  return found;
}

/* Keeps what of a leaf, number `leaf`, is nearer than what is met already. */
void meet_leaf(const TracedRay *ray, global const float *restrict triangles, const uint leaf, Met *met) {
  for (uint block = 0; block < CHILDREN; block += VEC) {
    real distance, u, v;
    const whole nearer =
        triangles_met(ray, triangles + leaf * (ulong)LEAF_FLOATS + block, met->distance, &distance, &u, &v);
    if (!ANY(nearer)) continue;
    const float least = min_lanes(SELECT((real)MAXFLOAT, distance, nearer));
    uint equals = lane_mask(nearer && (distance <= least));
    const uint lane = take_lowest(&equals);
    const whole is_it = LANE_NUMBER == (bits)lane;
    met->place = (int)(leaf * CHILDREN + block + lane);
    met->distance = least;
    met->u = sum_lanes(SELECT((real)0.0f, u, is_it));
    met->v = sum_lanes(SELECT((real)0.0f, v, is_it));
  }
}

/* Whether a ray meets a triangle of a leaf before `farthest`. */
bool leaf_blocks(const TracedRay *ray, global const float *restrict leaf, const float farthest) {
  for (uint block = 0; block < CHILDREN; block += VEC) {
    real distance, u, v;
    if (ANY(triangles_met(ray, leaf + block, farthest, &distance, &u, &v))) return true;
  }
  return false;
}

/* What a ray meets first. Boxes that wait are looked at again whenever the walk comes back to their node: by then, many lie
 * behind what was met. */
Met first_met(const Tree *tree, const float3 origin, const float3 direction) {
  const TracedRay ray = traced_ray(tree, origin, direction);
  Met met = {-1, MAXFLOAT, 0.0f, 0.0f};
  Waiting above = {0};
  uint level = BOX_LEVELS - 1;
  uint node = 0;
  uint waiting = ALL_CHILDREN;
  while (true) {
    global const float *restrict boxes = tree->boxes + (tree->levels[level] + node) * (ulong)NODE_FLOATS;
    const uint own = take_nearest(&ray, boxes, met.distance, &waiting);
    if (own == CHILDREN) {
      if (++level == BOX_LEVELS) return met;
      waiting = pop_waiting(&above);
      node /= CHILDREN;
      continue;
    }
    const uint child = node * CHILDREN + own;
    if (level == 0) {
      meet_leaf(&ray, tree->triangles, child, &met);
      continue;
    }
    push_waiting(&above, waiting);
    waiting = ALL_CHILDREN;
    node = child;
    --level;
  }
}

/* Whether a ray meets anything before `farthest`, in multiples of its direction. */
bool is_blocked(const Tree *tree, const float3 origin, const float3 direction, const float farthest) {
  const TracedRay ray = traced_ray(tree, origin, direction);
  Waiting above = {0};
  uint level = BOX_LEVELS - 1;
  uint node = 0;
  uint waiting = take_met(&ray, tree->boxes + tree->levels[level] * (ulong)NODE_FLOATS, farthest);
  while (true) {
    while (waiting == 0) {
      if (++level == BOX_LEVELS) return false;
      waiting = pop_waiting(&above);
      node /= CHILDREN;
    }
    const uint child = node * CHILDREN + take_lowest(&waiting);
    if (level == 0) {
      if (leaf_blocks(&ray, tree->triangles + child * (ulong)LEAF_FLOATS, farthest)) return true;
      continue;
    }
    push_waiting(&above, waiting);
    node = child;
    --level;
    waiting = take_met(&ray, tree->boxes + (tree->levels[level] + node) * (ulong)NODE_FLOATS, farthest);
  }
}
