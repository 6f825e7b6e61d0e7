/* The rest of paths that few are left of: a work-item goes with VEC of them from surface to surface to their ends.
 *
 * The host need not know how many rays a bounce has, nor after how many bounces none is left: it enqueues some waves, and
 * follow_paths after them. What a path brings is the same as by waves, bit for bit: at each bounce what its ray found is
 * added first, and then what its shadow ray did.
 *
 * Joined after paths.cl and trace.cl, with FOLLOWED. `levels`, `boxes`, `corners` and `numbers`: the scene's hierarchy, and
 * the scene's number of the triangle at each place of it. With CASTERS rays are tested against all triangles instead.
 *
 * Work-group contract: one-dimensional, any size; where VEC is 1 a barrier at the end, and two words of local memory. Any
 * number of work-items: each goes on with the paths that come a whole launch after its own.
 */

#if !CASTERS
/* What rays that are `alive` hit first. */
Hit traced_hit(const Tree *tree, global const uint *restrict numbers, const Ray *ray, const whole alive) {
  float from[3][VEC], along[3][VEC], distance[VEC], u[VEC], v[VEC];
  int is_alive[VEC], triangle[VEC];
  STORE(ray->origin.x, from[0]);
  STORE(ray->origin.y, from[1]);
  STORE(ray->origin.z, from[2]);
  STORE(ray->direction.x, along[0]);
  STORE(ray->direction.y, along[1]);
  STORE(ray->direction.z, along[2]);
  STORE(alive, is_alive);
  for (uint lane = 0; lane < VEC; ++lane) {
    Met met = {-1, MAXFLOAT, 0.0f, 0.0f};
    if (is_alive[lane] != 0)
      met = first_met(tree, (float3)(from[0][lane], from[1][lane], from[2][lane]),
                      (float3)(along[0][lane], along[1][lane], along[2][lane]));
    triangle[lane] = met.place < 0 ? -1 : (int)numbers[met.place];
    distance[lane] = met.distance;
    u[lane] = met.u;
    v[lane] = met.v;
  }
  return (Hit){LOAD(triangle), LOAD(distance), LOAD(u), LOAD(v)};
}

/* Those of the shadow rays that are `cast` which reach their lights. */
whole traced_lit(const Tree *tree, const Ray *ray, const whole cast) {
  float from[3][VEC], along[3][VEC];
  int is_lit[VEC];
  STORE(ray->origin.x, from[0]);
  STORE(ray->origin.y, from[1]);
  STORE(ray->origin.z, from[2]);
  STORE(ray->direction.x, along[0]);
  STORE(ray->direction.y, along[1]);
  STORE(ray->direction.z, along[2]);
  STORE(cast, is_lit);
  for (uint lane = 0; lane < VEC; ++lane)
    if (is_lit[lane] != 0 && is_blocked(tree, (float3)(from[0][lane], from[1][lane], from[2][lane]),
                                        (float3)(along[0][lane], along[1][lane], along[2][lane]), 1.0f))
      is_lit[lane] = 0;
  return LOAD(is_lit);
}
#endif

/* Rays of a wave at `bounce`, whose shadow rays are answered; rays and shadow rays that follow are counted among these. */
kernel void follow_paths(const uint bounce, PATHS_PARAMETERS, const float extent, global const uint *restrict levels,
                         global const float *restrict boxes, global const float *restrict corners,
                         global const uint *restrict numbers, const uint plane, global float *restrict wave) {
  GROUP_WORDS(words);
#if CASTERS
  (void)extent, (void)levels, (void)boxes, (void)corners, (void)numbers;
#else
  const Tree tree = {levels, boxes, corners, extent};
#endif
  const uint count = rays_of(wave);
  const uint step = (uint)get_global_size(0) * VEC;
  uint more = 0;
  for (uint first = (uint)get_global_id(0) * VEC; first < count; first += step) {
    whole alive = LANE_NUMBER + first < (bits)count;
    Ray ray = load_ray(wave, plane, first, alive, lights);
    for (uint own = bounce; ANY(alive); ++own) {
#if CASTERS
      const Hit hit = closest_hit(casters, ray.origin, ray.direction, alive);
#else
      const Hit hit = traced_hit(&tree, numbers, &ray, alive);
#endif
      Sink to;
      to.alive[0] = to.alive[1] = (whole)0;
      shade(&ray, &hit, alive, own, PATHS_ARGUMENTS, &to);
#if !CASTERS
      if (ANY(to.alive[1]))
        add_radiance(to.ray[1].throughput, to.ray[1].path, traced_lit(&tree, &to.ray[1], to.alive[1]), radiance);
#endif
      more += (uint)popcount(lane_mask(to.alive[0])) + (uint)popcount(lane_mask(to.alive[1]));
      alive = to.alive[0];
      ray = to.ray[0];
    }
  }
  count_rays(more, 1, wave, words);
}
