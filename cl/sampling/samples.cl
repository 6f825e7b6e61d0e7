/* Draw samples of an integrand: coordinates, unshadowed values, and the rays that decide visibility.
 *
 * Joined after the integrand's own file, which defines evaluate_integrand. A batch holds `point_count`
 * shading points, order[first_point] and on, with `stride` samples each (a multiple of VEC); sample s of point p is element
 * p * stride + s of `u`, `v`, `slot`, and of each channel's plane of `value`. Samples past
 * `sample_count` are padding with value zero.
 *
 * Rays are compacted: a sample whose unshadowed value is zero gets none (slot NO_RAY). The others take
 * consecutive slots from `ray_count`; which slot a sample gets may differ between runs, but each sample
 * finds its own ray's answer through `slot`, so results do not.
 *
 * With SHAFTS (shaft.cl joined before) points whose occluders are known need no rays: their samples' slots say NO_RAY
 * or SEEN. The second word of `ray_count` counts them.
 *
 * With LINES (along.cl joined before) samples, which are then the sampler's points (x, y) in `u` and `v`,
 * are moved along lines to where they see the light, and their values hold the lines' visible length: an
 * integrand of (x, y), whose integral is the same. They count as answered, too. The third word of `ray_count` counts
 * samples that no line was found for, which are tested, or traced where the occluders are not known.
 *
 * With SLICES (slices.cl joined before) a sample is a whole slice of the hemisphere at its v, and its value the exact
 * integral over u of the integrand with visibility: an integrand that does not depend on u. A slice that is refused
 * is sampled at its u by a ray; the third word of `ray_count` counts these.
 *
 * With WARPED (warp.cl or warp_triangles.cl joined before) each point's samples follow its record in `density`,
 * and `weight` takes one over the density at each sample, by which its value counts.
 *
 * Random numbers of shading point k are those of point first_id + k of the image, which these may be a part of.
 *
 * Work-group contract: one-dimensional, any size, no local memory, no barriers; one work-item handles
 * BLOCKS_A_ITEM blocks of VEC consecutive samples of one point, whose own arithmetic (the point, its
 * scramble, its occluders) they share. Blocks of a point are dealt to its work-items in turn, so that
 * neighbours write to neighbouring memory.
 */

/* VEC samples of a point from number `first` on, as they are kept; `own` is the point's number in the image. */
void draw_block(const uint own, const uint first, const uint stream, const uint seed_low, const uint seed_high,
#if WARPED
                global const uint *record, global float *restrict weight,
#endif
                global float *restrict u, global float *restrict v, real *own_u, real *own_v) {
#if SLICES
  sample_azimuths(own, LANE_NUMBER + first, stream, seed_low, seed_high, own_u, own_v);
#else
  sample_square(own, LANE_NUMBER + first, stream, seed_low, seed_high, own_u, own_v);
#endif
#if WARPED
  STORE(warp_square(record, own_u, own_v), weight);
#endif
  STORE(*own_u, u);
  STORE(*own_v, v);
}

kernel void draw_samples(const uint first_point, const uint point_count, const uint total_points,
                         const uint first_id, const uint first_sample, const uint sample_count, const uint stride,
                         const uint stream, const uint seed_low, const uint seed_high,
                         global const uint *restrict order, global const float *restrict surface,
                         global const float *restrict integrand_data,
#if WARPED
                         global const uint *restrict density, global float *restrict weight,
#endif
#if SHAFTS
                         global const uint *restrict starts, global const uint *restrict occluders,
                         global const float *restrict triangles,
#endif
#if LINES
                         const float tolerance, global const uint *restrict levels, global const float *restrict boxes,
#endif
#if SLICES
                         const float unit, global const uint *restrict levels, global const float *restrict boxes,
                         global const float *restrict triangles,
#endif
                         global float *restrict u, global float *restrict v, global float *restrict value,
                         global uint *restrict slot, global float *restrict origins,
                         global float *restrict directions, global float *restrict distances,
                         volatile global uint *restrict ray_count) {
  const uint blocks = stride / VEC;
  const uint items_a_point = (blocks + BLOCKS_A_ITEM - 1) / BLOCKS_A_ITEM;
  const uint item = (uint)get_global_id(0);
  if (item >= point_count * items_a_point) return;
  const uint local_point = item / items_a_point;
  const uint first_block = item % items_a_point;
  const uint point = order[first_point + local_point];
  const ulong plane = (ulong)point_count * stride;
  const ShadingPoint p = load_shading_point(surface, total_points, point);

#if WARPED
  global const uint *record = density + (ulong)RECORD_NUMBER(point, local_point) * DENSITY_WORDS;
#define DRAW_BLOCK draw_block(point + first_id, block * VEC + first_sample, stream, seed_low, seed_high, record, \
                              weight + at, u + at, v + at, &own_u, &own_v)
#else
#define DRAW_BLOCK \
  draw_block(point + first_id, block * VEC + first_sample, stream, seed_low, seed_high, u + at, v + at, &own_u, &own_v)
#endif
#if LINES
  float sample_u[BLOCKS_A_ITEM * VEC], sample_v[BLOCKS_A_ITEM * VEC];
  uint own_blocks = 0;
  UNROLL_FOR_LANES
  for (uint k = 0; k < BLOCKS_A_ITEM; ++k) {
    const uint block = first_block + k * items_a_point;
    if (block >= blocks) continue;
    const ulong at = (ulong)local_point * stride + block * VEC;
    real own_u, own_v;
    DRAW_BLOCK;
    STORE(own_u, sample_u + k * VEC);
    STORE(own_v, sample_v + k * VEC);
    ++own_blocks;
  }
#endif
#if SHAFTS
  global const uint *restrict own_occluders = occluders + starts[point];
#endif
#if LINES
  float share[BLOCKS_A_ITEM * VEC];
  int refused[BLOCKS_A_ITEM * VEC];
  UNROLL_FOR_LANES
  for (uint k = 0; k < BLOCKS_A_ITEM * VEC; ++k) {
    share[k] = 1.0f;
    refused[k] = 0;
  }
  const bool moves = own_occluders[0] > 0;
  if (moves)
    take_visible(&p, integrand_data, own_occluders, levels, boxes, triangles, tolerance, own_blocks, sample_u, sample_v,
                 share, refused);
#endif

  real direction[BLOCKS_A_ITEM][3];
  real distance[BLOCKS_A_ITEM];
  whole live[BLOCKS_A_ITEM];
  uint count = 0;
  UNROLL_FOR_LANES
  for (uint k = 0; k < BLOCKS_A_ITEM; ++k) {
    const uint block = first_block + k * items_a_point;
    live[k] = (whole)0;
    distance[k] = direction[k][0] = direction[k][1] = direction[k][2] = (real)0.0f;
    if (block >= blocks) continue;
    const ulong at = (ulong)local_point * stride + block * VEC;
    const bits index = LANE_NUMBER + block * VEC;
    real own_u, own_v;
#if LINES
    own_u = LOAD(sample_u + k * VEC);
    own_v = LOAD(sample_v + k * VEC);
#else
    DRAW_BLOCK;
#endif
    real sample_value[CHANNELS];
#if SLICES
    const whole is_sample = (index < sample_count);
    const whole refused = slice_integrals(&p, integrand_data[0], unit, levels, boxes, triangles, is_sample,
                                          own_v, sample_value);
    if (ANY(refused)) {
      real at_u[CHANNELS];
      evaluate_integrand(&p, integrand_data, own_u, own_v, at_u, direction[k],
                         &distance[k]);
      sample_value[0] = SELECT(sample_value[0], at_u[0], refused);
      atomic_add(ray_count + 2, popcount(lane_mask(refused)));
    }
#else
    evaluate_integrand(&p, integrand_data, own_u, own_v, sample_value, direction[k], &distance[k]);
#endif
    for (uint channel = 0; channel < CHANNELS; ++channel) {
#if LINES
      sample_value[channel] *= LOAD(share + k * VEC);
#endif
      sample_value[channel] = SELECT((real)0.0f, sample_value[channel], index < sample_count);
      live[k] = live[k] || (fabs(sample_value[channel]) > 0.0f);
      STORE(sample_value[channel], value + channel * plane + at);
    }
    STORE(SELECT((bits)NO_RAY, (bits)SEEN, live[k]), slot + at);
    count += popcount(lane_mask(live[k]));
#if SLICES
    live[k] = live[k] && refused;
#endif
  }

  const float3 origin = ray_origin(&p);
#if SHAFTS
  if (own_occluders[0] != TOO_MANY) {
#if LINES
    /* What was moved to where it sees the light needs no test. */
    const uint untested = moves ? test_refused(own_occluders, triangles, origin, direction, refused, live) : 0;
    if (untested > 0) atomic_add(ray_count + 2, untested);
    if (!moves)
#endif
      close_blocked(own_occluders, triangles, origin, direction, live);
    UNROLL_FOR_LANES
    for (uint k = 0; k < BLOCKS_A_ITEM; ++k) {
      const uint block = first_block + k * items_a_point;
      if (block < blocks)
        STORE(SELECT((bits)NO_RAY, (bits)SEEN, live[k]), slot + (ulong)local_point * stride + block * VEC);
    }
    if (count > 0) atomic_add(ray_count + 1, count);
    return;
  }
#endif
#if SLICES || LINES
  uint rays = 0;
  UNROLL_FOR_LANES
  for (uint k = 0; k < BLOCKS_A_ITEM; ++k) {
#if LINES
    live[k] = live[k] && LOAD(refused + k * VEC);
#endif
    rays += popcount(lane_mask(live[k]));
  }
#if LINES
  if (rays > 0) atomic_add(ray_count + 2, rays);
#endif
  if (count > rays) atomic_add(ray_count + 1, count - rays);
  if (rays == 0) return;
#else
  const uint rays = count;
#endif
  uint next = rays > 0 ? atomic_add(ray_count, rays) : 0u;
  UNROLL_FOR_LANES
  for (uint k = 0; k < BLOCKS_A_ITEM; ++k) {
    const uint block = first_block + k * items_a_point;
    if (block >= blocks) continue;
    float ray[4][VEC];
    int is_live[VEC];
    STORE(direction[k][0], ray[0]);
    STORE(direction[k][1], ray[1]);
    STORE(direction[k][2], ray[2]);
    STORE(distance[k], ray[3]);
    STORE(live[k], is_live);
    for (uint lane = 0; lane < VEC; ++lane) {
      if (is_live[lane] == 0) continue;
      const uint own = next++;
      vstore3(origin, own, origins);
      vstore3((float3)(ray[0][lane], ray[1][lane], ray[2][lane]), own, directions);
      distances[own] = ray[3][lane];
      slot[(ulong)local_point * stride + block * VEC + lane] = own;
    }
  }
}

/* Mean of the unshadowed integrand over MEAN_SAMPLES points of the square, a plane of `point_count` floats
 * a channel. One work-item a shading point. */
kernel void unshadowed_means(const uint point_count, const uint total_points, const uint first_id, const uint stream,
                             const uint seed_low, const uint seed_high,
                             global const float *restrict surface,
                             global const float *restrict integrand_data, global float *restrict means) {
  const uint point = (uint)get_global_id(0);
  if (point >= point_count) return;
  const ShadingPoint p = load_shading_point(surface, total_points, point);
  real sum[CHANNELS];
  for (uint channel = 0; channel < CHANNELS; ++channel) sum[channel] = (real)0.0f;
  for (uint first = 0; first < MEAN_SAMPLES; first += VEC) {
    real sample_u, sample_v, distance;
    real value[CHANNELS];
    real direction[3];
    sample_square(point + first_id, LANE_NUMBER + first, stream, seed_low, seed_high, &sample_u, &sample_v);
    evaluate_integrand(&p, integrand_data, sample_u, sample_v, value, direction, &distance);
    for (uint channel = 0; channel < CHANNELS; ++channel) sum[channel] += value[channel];
  }
  for (uint channel = 0; channel < CHANNELS; ++channel)
    means[channel * (ulong)point_count + point] = sum_lanes(sum[channel]) / (float)MEAN_SAMPLES;
}
