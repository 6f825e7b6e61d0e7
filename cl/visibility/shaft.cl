/* Shadow rays without a ray tracer: the few triangles that can stand between a point and a light.
 *
 * All shadow rays of a shading point start at one place and end on a light: they fill a pyramid, the shaft.
 * find_occluders looks once for the triangles that reach into a point's shafts, in boxes of boxes of triangles. Most points find none, and all their samples see the light; where there are MOST_OCCLUDERS at most,
 * samples are tested against these (Haines and Wallace 1991, shaft culling); other points have no list.
 *
 * Planes of a shaft, relative to the ray's origin: four through the origin and a side of the light, the
 * light's and the surface's own. A triangle all of whose corners lie outside one plane by more than
 * rounding is left out. A triangle that is kept although no ray can hit it costs time, but changes no
 * result.
 *
 * The test. With corners a, b, c relative to the origin and direction d, the signs of d.(b x c), d.(c x a) and
 * d.(a x b) say on which side of the three edges the ray passes. Of two triangles with a common edge one gets
 * the other's number with its sign turned, so no ray slips through between them. The ray meets the plane before
 * its end at d if a.(b x c) lies between 0 and the sum of the three.
 *
 * Memory layout: `levels`, `boxes` and `triangles` as hierarchy.py lays them out: boxes of boxes of CHILDREN triangles,
 * implicit: box k of a level holds numbers k * CHILDREN and on of the level below. A node is CHILDREN boxes, six rows of
 * CHILDREN floats: lower x, y, z, upper x, y, z; node k of level l is number levels[l] + k. A leaf is CHILDREN triangles, nine
 * rows: x, y, z of corner 0, then 1, then 2. What fills up a node or a leaf is empty.
 * `occluders`: lists one after another, each how many triangles (TOO_MANY: not known) and which; a point's
 * begins at its number in `starts`. The first two words are the lists of all points that have too many, and of all that
 * have none. `lengths`: how many; `counted`: how many at every counted_step-th point, be it too many; `cursor`: where the next list begins, in whatever order points are done.
 *
 * Work-group contract: one-dimensional, any size, no local memory, no barriers; find_occluders is one work-item a
 * point.
 */

#define SHAFT_PLANES 6
#define NODE_FLOATS (6 * CHILDREN)
#define LEAF_FLOATS (9 * CHILDREN)

/* Outside where normal . x > limit. */
typedef struct {
  float3 normal;
  float limit;
} Plane;

/* The shaft from `origin` to one light; `tolerance` is what rounding may move a corner by. */
void shaft_planes(const ShadingPoint *p, global const float *restrict light, const float tolerance,
                  Plane plane[SHAFT_PLANES]) {
  const float3 origin = ray_origin(p);
  const float3 edge1 = vload3(0, light + LIGHT_EDGE1);
  const float3 edge2 = vload3(0, light + LIGHT_EDGE2);
  const float3 normal = vload3(0, light + LIGHT_NORMAL);
  const float offset = light_offset(light, p->position);
  const float emitted = dot(normal, origin - vload3(0, light + LIGHT_CORNER));
  const float3 ends = emitted > 0.0f ? normal : -normal;
  float3 corner[4];
  corner[0] = vload3(0, light + LIGHT_CORNER) - origin + offset * ends;
  corner[1] = corner[0] + edge1;
#if HAS_SHAPES
  /* A triangle's third side has no plane; discs have those of the square about them. */
  corner[2] = light[LIGHT_SHAPE] == (float)SHAPE_TRIANGLE ? corner[1] : corner[1] + edge2;
  corner[3] = corner[0] + edge2;
  const float3 centre = corner[0] + corner[2] + corner[3];
#else
  corner[2] = corner[1] + edge2;
  corner[3] = corner[0] + edge2;
  const float3 centre = corner[0] + corner[2];
#endif
  for (int side = 0; side < 4; ++side) {
    const float3 across = cross(corner[side], corner[(side + 1) & 3]);
    const float length2 = dot(across, across);
    const float3 unit = length2 > 0.0f ? across * rsqrt(length2) : (float3)(0.0f);
    plane[side].normal = dot(unit, centre) > 0.0f ? -unit : unit;
    plane[side].limit = tolerance;
  }
  /* Rays end one offset before the light and start one off the surface: half of it is far from both. */
  plane[4].normal = -ends;
  plane[4].limit = dot(-ends, corner[0]) + 0.5f * offset;
  plane[5].normal = -p->geometric_normal;
  plane[5].limit = 0.5f * p->offset;
}

/* Which boxes of a node reach into the shaft: a bit each. All at once would take the registers of a GPU's other warps. */
uint boxes_in_shaft(const Plane plane[SHAFT_PLANES], const float3 origin, global const float *restrict node) {
  uint found = 0;
#pragma unroll 4
  for (uint block = 0; block < CHILDREN; block += VEC) {
    global const float *restrict boxes = node + block;
    whole inside = (whole)-1;
    for (int k = 0; k < SHAFT_PLANES; ++k) {
      const float3 n = plane[k].normal;
      const real x = LOAD(boxes + (n.x >= 0.0f ? 0u : 3u) * CHILDREN) - origin.x;
      const real y = LOAD(boxes + (n.y >= 0.0f ? 1u : 4u) * CHILDREN) - origin.y;
      const real z = LOAD(boxes + (n.z >= 0.0f ? 2u : 5u) * CHILDREN) - origin.z;
      const real least = FMA((real)n.x, x, FMA((real)n.y, y, n.z * z));
      inside = inside && (least <= plane[k].limit);
    }
    found |= lane_mask(inside) << block;
  }
  return found;
}

/* Corner `c` of VEC triangles of a leaf, from the origin. */
triple leaf_corner(global const float *restrict leaf, const uint c, const float3 origin) {
  global const float *restrict rows = leaf + 3 * c * CHILDREN;
  return (triple){LOAD(rows) - origin.x, LOAD(rows + CHILDREN) - origin.y, LOAD(rows + 2 * CHILDREN) - origin.z};
}

/* Which of VEC triangles reach to the inner side of all planes. */
uint triangles_inside(const Plane *plane, const uint planes, const triple corner[3]) {
  whole inside = (whole)-1;
  for (uint k = 0; k < planes; ++k) {
    const triple n = to_triple(plane[k].normal);
    const real first = dot_triple(n, corner[0]);
    const real second = dot_triple(n, corner[1]);
    const real third = dot_triple(n, corner[2]);
    inside = inside && (min(first, min(second, third)) <= plane[k].limit);
  }
  return lane_mask(inside);
}

/* Which triangles of a leaf reach into the shaft. */
uint triangles_in_shaft(const Plane plane[SHAFT_PLANES], const float3 origin, global const float *restrict leaf) {
  uint found = 0;
#pragma unroll 4
  for (uint block = 0; block < CHILDREN; block += VEC) {
    triple corner[3];
    for (uint c = 0; c < 3; ++c) corner[c] = leaf_corner(leaf + block, c, origin);
    found |= triangles_inside(plane, SHAFT_PLANES, corner) << block;
  }
  return found;
}

/* Which boxes reach into some shaft: of each light's only if their parent, number `bit` of its level, does. */
uint boxes_in_shafts(const Plane plane[LIGHT_COUNT][SHAFT_PLANES], const float3 origin,
                     global const float *restrict node, const uint parents[LIGHT_COUNT], const uint bit,
                     uint found[LIGHT_COUNT]) {
  uint any = 0;
  for (uint light = 0; light < LIGHT_COUNT; ++light) {
    found[light] = 0;
    if ((parents[light] >> bit & 1u) != 0) found[light] = boxes_in_shaft(plane[light], origin, node);
    any |= found[light];
  }
  return any;
}

/* The same of triangles. */
uint triangles_in_shafts(const Plane plane[LIGHT_COUNT][SHAFT_PLANES], const float3 origin,
                         global const float *restrict leaf, const uint parents[LIGHT_COUNT], const uint bit) {
  uint any = 0;
  for (uint light = 0; light < LIGHT_COUNT; ++light)
    if ((parents[light] >> bit & 1u) != 0) any |= triangles_in_shaft(plane[light], origin, leaf);
  return any;
}

/* A lane of a GPU has no memory of its own for a list: it counts first, then walks again and lists where there is room. */
#if VEC == 1
#define OWN_LIST global uint *
#else
#define OWN_LIST uint *
#endif

/* Counts the triangles that reach into some shaft, and lists the first `most` in `own`, if that is not null; returns
 * TOO_MANY if there are more and not `all_counted`. */
uint list_occluders(const Plane plane[LIGHT_COUNT][SHAFT_PLANES], const float3 origin, const uint most,
                    const bool all_counted, const uint triangle_count, global const uint *restrict levels, global const float *restrict boxes,
                    global const float *restrict triangles, OWN_LIST own) {
  uint in_shaft[BOX_LEVELS][LIGHT_COUNT], found[BOX_LEVELS], node[BOX_LEVELS];
  uint all[LIGHT_COUNT];
  for (uint light = 0; light < LIGHT_COUNT; ++light) all[light] = 1u;
  uint level = BOX_LEVELS - 1;
  uint count = 0;
  node[level] = 0;
  found[level] = boxes_in_shafts(plane, origin, boxes + levels[level] * (ulong)NODE_FLOATS, all, 0, in_shaft[level]);
  while (true) {
    while (found[level] == 0)
      if (++level == BOX_LEVELS) return count;
    const uint bit = take_lowest(&found[level]);
    const uint child = node[level] * CHILDREN + bit;
    if (level > 0) {
      node[--level] = child;
      found[level] = boxes_in_shafts(plane, origin, boxes + (levels[level] + child) * (ulong)NODE_FLOATS,
                                     in_shaft[level + 1], bit, in_shaft[level]);
      continue;
    }
    uint met = triangles_in_shafts(plane, origin, triangles + child * (ulong)LEAF_FLOATS, in_shaft[0], bit);
    while (met != 0) {
      const uint triangle = child * CHILDREN + take_lowest(&met);
      /* The last leaf is filled up. */
      if (triangle >= triangle_count) break;
      if (count >= most && !all_counted) return TOO_MANY;
      if (count < most && own != 0) own[count] = triangle;
      ++count;
    }
  }
}

kernel void find_occluders(const uint point_count, const uint total_points, const float tolerance,
                           const uint triangle_count, const uint most, const uint capacity, const uint counted_step,
                           global const float *restrict surface, global const float *restrict lights,
                           global const uint *restrict levels, global const float *restrict boxes,
                           global const float *restrict triangles, global uint *restrict occluders,
                           global uint *restrict starts, global uint *restrict lengths,
                           global uint *restrict counted, volatile global uint *restrict cursor) {
  const uint point = (uint)get_global_id(0);
  if (point >= point_count) return;
  const ShadingPoint p = load_shading_point(surface, total_points, point);
  Plane plane[LIGHT_COUNT][SHAFT_PLANES];
  for (uint light = 0; light < LIGHT_COUNT; ++light)
    shaft_planes(&p, lights + light * LIGHT_FLOATS, tolerance, plane[light]);
#if VEC == 1
  OWN_LIST own = 0;
#else
  uint own[MOST_OCCLUDERS];
#endif
  const bool all_counted = point % counted_step == 0;
  uint count =
      list_occluders(plane, ray_origin(&p), most, all_counted, triangle_count, levels, boxes, triangles, own);
  if (all_counted) counted[point / counted_step] = count;
  if (count > most) count = TOO_MANY;
  lengths[point] = count;
  if (point == 0) {
    occluders[0] = TOO_MANY;
    occluders[1] = 0u;
  }
  starts[point] = count == TOO_MANY ? 0u : 1u;
  if (count == TOO_MANY || count == 0) return;
  const uint start = atomic_add(cursor, count + 1);
  /* What does not fit the host sees from the lengths, and asks for shorter lists. */
  if (start >= capacity || count >= capacity - start) return;
  starts[point] = start;
  occluders[start] = count;
#if VEC == 1
  list_occluders(plane, ray_origin(&p), most, false, triangle_count, levels, boxes, triangles, occluders + start + 1);
#else
  for (uint k = 0; k < count; ++k) occluders[start + 1 + k] = own[k];
#endif
}

/* a x b, exactly the negative of b x a: no product may be fused into the difference. */
float3 exact_cross(const float3 a, const float3 b) {
#pragma OPENCL FP_CONTRACT OFF
  const float3 first = a.yzx * b.zxy;
  const float3 second = a.zxy * b.yzx;
  return first - second;
}

/* A triangle as a point sees it: directions d with edge[k] . d >= 0 for all k pass it on one side, and reach its plane
 * where their sum exceeds `volume`. */
typedef struct {
  float3 edge[3];
  float volume;
} Occluder;

Occluder occluder_of(const uint triangle, global const float *restrict triangles, const float3 origin) {
  global const float *restrict rows = triangles + triangle / CHILDREN * (ulong)LEAF_FLOATS + triangle % CHILDREN;
  float3 corner[3];
  for (uint c = 0; c < 3; ++c) {
    corner[c] = (float3)(rows[0], rows[CHILDREN], rows[2 * CHILDREN]) - origin;
    rows += 3 * CHILDREN;
  }
  Occluder found;
  found.edge[0] = exact_cross(corner[1], corner[2]);
  found.edge[1] = exact_cross(corner[2], corner[0]);
  found.edge[2] = exact_cross(corner[0], corner[1]);
  found.volume = dot(corner[0], found.edge[0]);
  return found;
}

/* Whether rays from the point are blocked on their way to its position + direction. */
whole is_blocked(const Occluder *occluder, const real direction[3]) {
  real side[3];
  for (uint e = 0; e < 3; ++e) {
    const float3 edge = occluder->edge[e];
    side[e] = FMA((real)edge.x, direction[0], FMA((real)edge.y, direction[1], edge.z * direction[2]));
  }
  const real sum = side[0] + side[1] + side[2];
  const real low = min(side[0], min(side[1], side[2]));
  const real high = max(side[0], max(side[1], side[2]));
  const float volume = occluder->volume;
  const whole from_front = (low >= 0.0f) && (volume > 0.0f) && (sum > volume);
  const whole from_back = (high <= 0.0f) && (volume < 0.0f) && (sum < volume);
  return from_front || from_back;
}

/* Takes from `open` the rays that one of the point's occluders blocks, BLOCKS_A_ITEM blocks of VEC rays: a triangle's
 * own arithmetic is done once for all of them. */
void close_blocked(global const uint *restrict own, global const float *restrict triangles, const float3 origin,
                   const real direction[BLOCKS_A_ITEM][3], whole open[BLOCKS_A_ITEM]) {
  const uint count = own[0];
  whole any_open = (whole)-1;
  for (uint k = 1; k <= count && ANY(any_open); ++k) {
    const Occluder occluder = occluder_of(own[k], triangles, origin);
    any_open = (whole)0;
#pragma unroll
    for (uint block = 0; block < BLOCKS_A_ITEM; ++block) {
      open[block] = open[block] && !is_blocked(&occluder, direction[block]);
      any_open = any_open || open[block];
    }
  }
}
