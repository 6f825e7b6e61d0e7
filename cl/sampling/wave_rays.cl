/* Answers the rays of a wave on the device: what the host's tracer else writes into its planes.
 *
 * Joined after wave.cl and trace.cl. `numbers`: the scene's number of the triangle at each place of the hierarchy.
 *
 * Work-group contract: one-dimensional, any size, no local memory, no barriers. Any number of work-items: each takes a
 * ray, and then those that come a whole launch after it.
 */

float3 load_traced(global const float *restrict wave, const uint number, const uint plane, const uint ray) {
  return (float3)(PLANE(wave, number)[ray], PLANE(wave, number + 1)[ray], PLANE(wave, number + 2)[ray]);
}

/* The first hits of a wave's rays. */
kernel void find_hits(const float extent, global const uint *restrict levels, global const float *restrict boxes,
                      global const float *restrict triangles, global const uint *restrict numbers, const uint plane,
                      global float *restrict wave) {
  const Tree tree = {levels, boxes, triangles, extent};
  const uint count = rays_of(wave);
  for (uint ray = (uint)get_global_id(0); ray < count; ray += (uint)get_global_size(0)) {
    const Met met = first_met(&tree, load_traced(wave, WAVE_ORIGIN, plane, ray),
                              load_traced(wave, WAVE_DIRECTION, plane, ray));
    PLANE(wave, WAVE_TRIANGLE)[ray] = as_float(met.place < 0 ? -1 : (int)numbers[met.place]);
    PLANE(wave, WAVE_U)[ray] = met.u;
    PLANE(wave, WAVE_V)[ray] = met.v;
    PLANE(wave, WAVE_DISTANCE)[ray] = met.distance;
  }
}

/* Which shadow rays of a wave reach their lights. */
kernel void find_lit(const float extent, global const uint *restrict levels, global const float *restrict boxes,
                     global const float *restrict triangles, const uint plane, global float *restrict wave) {
  const Tree tree = {levels, boxes, triangles, extent};
  const uint count = shadow_rays_of(wave);
  for (uint ray = (uint)get_global_id(0); ray < count; ray += (uint)get_global_size(0)) {
    const bool blocked = is_blocked(&tree, load_traced(wave, WAVE_SHADOW_ORIGIN, plane, ray),
                                    load_traced(wave, WAVE_SHADOW_DIRECTION, plane, ray), 1.0f);
    ((global uchar *)PLANE(wave, WAVE_LIT))[ray] = blocked ? 0 : 1;
  }
}
