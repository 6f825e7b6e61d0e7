/* Shadow rays without a ray tracer: the few triangles that can stand between a point and a light.
 *
 * All shadow rays of a shading point start at one place and end on a light: they fill a pyramid, the shaft.
 * find_occluders looks once for the triangles that reach into a point's shafts, in boxes of boxes of boxes of BRANCH
 * triangles. Most points find none, and all their samples see the light; where there are MOST_OCCLUDERS at most,
 * samples are tested against these (Haines and Wallace 1991, shaft culling); other points leave their rays to the host.
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
 * Memory layout: `boxes`: planes of box_stride floats: lower x, y, z, upper x, y, z; the boxes of triangles, then
 * those of these boxes, then those of these (first_1, first_2). Box k of a level holds number k * BRANCH and on
 * of the level below. `corners`: planes of corner_stride floats, x, y, z of each triangle's corner 0, then 1,
 * then 2. `occluders`: lists one after another, each how many triangles (TOO_MANY: not known) and which; a point's
 * begins at its number in `starts`. The first two words are the lists of all points that have too many, and of all that
 * have none. `lengths`: how many; `cursor`: where the next list begins, in whatever order points are done.
 *
 * Work-group contract: one-dimensional, any size, no local memory, no barriers; find_occluders is one work-item a
 * point.
 */

#define SHAFT_PLANES 6

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
  corner[2] = corner[1] + edge2;
  corner[3] = corner[0] + edge2;
  const float3 centre = corner[0] + corner[2];
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

real row_at(global const float *restrict rows, const uint row, const uint stride, const uint at) {
  return LOAD(rows + row * (ulong)stride + at);
}

/* Which of the boxes first .. min(first + BRANCH, end) reach into the shaft: a bit each. */
uint boxes_in_shaft(const Plane *plane, const float3 origin, global const float *restrict boxes, const uint stride,
                    const uint first, const uint end) {
  uint found = 0;
  for (uint block = 0; block < BRANCH && first + block < end; block += VEC) {
    const uint at = first + block;
    const real low_x = row_at(boxes, 0, stride, at) - origin.x;
    const real low_y = row_at(boxes, 1, stride, at) - origin.y;
    const real low_z = row_at(boxes, 2, stride, at) - origin.z;
    const real high_x = row_at(boxes, 3, stride, at) - origin.x;
    const real high_y = row_at(boxes, 4, stride, at) - origin.y;
    const real high_z = row_at(boxes, 5, stride, at) - origin.z;
    whole inside = LANE_NUMBER + at < (bits)end;
    for (int k = 0; k < SHAFT_PLANES; ++k) {
      const float3 n = plane[k].normal;
      const real least = min(n.x * low_x, n.x * high_x) + min(n.y * low_y, n.y * high_y) +
                         min(n.z * low_z, n.z * high_z);
      inside = inside && (least <= plane[k].limit);
    }
    int is_inside[VEC];
    STORE(inside, is_inside);
    for (uint lane = 0; lane < VEC; ++lane) found |= (is_inside[lane] != 0 ? 1u : 0u) << (block + lane);
  }
  return found;
}

/* The same of triangles. */
uint triangles_in_shaft(const Plane *plane, const float3 origin, global const float *restrict corners,
                        const uint stride, const uint first, const uint end) {
  uint found = 0;
  for (uint block = 0; block < BRANCH && first + block < end; block += VEC) {
    const uint at = first + block;
    real x[9];
    for (uint k = 0; k < 3; ++k) {
      x[3 * k] = row_at(corners, 3 * k, stride, at) - origin.x;
      x[3 * k + 1] = row_at(corners, 3 * k + 1, stride, at) - origin.y;
      x[3 * k + 2] = row_at(corners, 3 * k + 2, stride, at) - origin.z;
    }
    whole inside = LANE_NUMBER + at < (bits)end;
    for (int k = 0; k < SHAFT_PLANES; ++k) {
      const float3 n = plane[k].normal;
      const real first_corner = n.x * x[0] + n.y * x[1] + n.z * x[2];
      const real second = n.x * x[3] + n.y * x[4] + n.z * x[5];
      const real third = n.x * x[6] + n.y * x[7] + n.z * x[8];
      inside = inside && (min(first_corner, min(second, third)) <= plane[k].limit);
    }
    int is_inside[VEC];
    STORE(inside, is_inside);
    for (uint lane = 0; lane < VEC; ++lane) found |= (is_inside[lane] != 0 ? 1u : 0u) << (block + lane);
  }
  return found;
}

/* Which boxes reach into some shaft: of each light's only if their parent, number `bit` of its level, does. */
uint boxes_in_shafts(const Plane plane[LIGHT_COUNT][SHAFT_PLANES], const float3 origin, global const float *restrict boxes,
                     const uint stride, const uint first, const uint end, const uint parents[LIGHT_COUNT],
                     const uint bit, uint found[LIGHT_COUNT]) {
  uint any = 0;
  for (uint light = 0; light < LIGHT_COUNT; ++light) {
    found[light] = 0;
    if ((parents[light] >> bit & 1u) != 0)
      found[light] = boxes_in_shaft(plane[light], origin, boxes, stride, first, end);
    any |= found[light];
  }
  return any;
}

/* The same of triangles. */
uint triangles_in_shafts(const Plane plane[LIGHT_COUNT][SHAFT_PLANES], const float3 origin,
                         global const float *restrict corners, const uint stride, const uint first, const uint end,
                         const uint parents[LIGHT_COUNT], const uint bit) {
  uint any = 0;
  for (uint light = 0; light < LIGHT_COUNT; ++light)
    if ((parents[light] >> bit & 1u) != 0)
      any |= triangles_in_shaft(plane[light], origin, corners, stride, first, end);
  return any;
}

/* Adds those of `found`, numbered from `first`, to the list; returns its length, TOO_MANY if they do not fit. */
uint list_occluders(const uint found, const uint first, const uint most, const uint before, uint own[MOST_OCCLUDERS]) {
  uint count = before;
  for (uint bit = 0; found >> bit != 0; ++bit) {
    if ((found >> bit & 1u) == 0) continue;
    if (count == most) return TOO_MANY;
    own[count++] = first + bit;
  }
  return count;
}

kernel void find_occluders(const uint point_count, const uint total_points, const float tolerance,
                           const uint triangle_count, const uint corner_stride, const uint box_stride,
                           const uint count_0, const uint first_1, const uint count_1, const uint first_2,
                           const uint count_2, const uint most, const uint capacity,
                           global const float *restrict surface, global const float *restrict lights,
                           global const float *restrict boxes, global const float *restrict corners,
                           global uint *restrict occluders, global uint *restrict starts,
                           global uint *restrict lengths, volatile global uint *restrict cursor) {
  const uint point = (uint)get_global_id(0);
  if (point >= point_count) return;
  const ShadingPoint p = load_shading_point(surface, total_points, point);
  const float3 origin = ray_origin(&p);
  Plane plane[LIGHT_COUNT][SHAFT_PLANES];
  uint all[LIGHT_COUNT];
  for (uint light = 0; light < LIGHT_COUNT; ++light) {
    shaft_planes(&p, lights + light * LIGHT_FLOATS, tolerance, plane[light]);
    all[light] = 1u;
  }
  uint own[MOST_OCCLUDERS];
  uint in_top[LIGHT_COUNT], in_middle[LIGHT_COUNT], in_bottom[LIGHT_COUNT];
  uint count = 0;
  for (uint top = 0; top < count_2 && count != TOO_MANY; top += BRANCH) {
    const uint tops = boxes_in_shafts(plane, origin, boxes + first_2, box_stride, top, count_2, all, 0, in_top);
    for (uint i = 0; tops >> i != 0 && count != TOO_MANY; ++i) {
      if ((tops >> i & 1u) == 0) continue;
      const uint middle = (top + i) * BRANCH;
      const uint middles =
          boxes_in_shafts(plane, origin, boxes + first_1, box_stride, middle, count_1, in_top, i, in_middle);
      for (uint j = 0; middles >> j != 0 && count != TOO_MANY; ++j) {
        if ((middles >> j & 1u) == 0) continue;
        const uint bottom = (middle + j) * BRANCH;
        const uint bottoms =
            boxes_in_shafts(plane, origin, boxes, box_stride, bottom, count_0, in_middle, j, in_bottom);
        for (uint k = 0; bottoms >> k != 0 && count != TOO_MANY; ++k) {
          if ((bottoms >> k & 1u) == 0) continue;
          const uint first = (bottom + k) * BRANCH;
          const uint found =
              triangles_in_shafts(plane, origin, corners, corner_stride, first, triangle_count, in_bottom, k);
          count = list_occluders(found, first, most, count, own);
        }
      }
    }
  }
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
  for (uint k = 0; k < count; ++k) occluders[start + 1 + k] = own[k];
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

Occluder occluder_of(const uint triangle, global const float *restrict corners, const uint stride,
                     const float3 origin) {
  float3 corner[3];
  for (uint c = 0; c < 3; ++c) {
    const ulong at = 3 * c * (ulong)stride + triangle;
    corner[c] = (float3)(corners[at], corners[at + stride], corners[at + 2 * (ulong)stride]) - origin;
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
void close_blocked(global const uint *restrict own, global const float *restrict corners, const uint stride,
                   const float3 origin, const real direction[BLOCKS_A_ITEM][3], whole open[BLOCKS_A_ITEM]) {
  const uint count = own[0];
  whole any_open = (whole)-1;
  for (uint k = 1; k <= count && ANY(any_open); ++k) {
    const Occluder occluder = occluder_of(own[k], corners, stride, origin);
    any_open = (whole)0;
#pragma unroll
    for (uint block = 0; block < BLOCKS_A_ITEM; ++block) {
      open[block] = open[block] && !is_blocked(&occluder, direction[block]);
      any_open = any_open || open[block];
    }
  }
}
