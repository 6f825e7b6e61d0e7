/* Paths behind the first bounce, a wavefront at a time: kernels between rays that the host or other kernels trace.
 *
 *   begin_paths   (u, v) of a batch's samples to the first ray of each path
 *   shade_hits    what rays hit: emission, a shadow ray to a light, the next ray
 *   add_lit       adds what shadow rays found visible
 *   end_wave      counts a wave's rays, and leaves it empty
 *   finish_paths  direct light with its visibility, plus what the path brought: the samples' complete values
 *
 * A path is named by its sample's place in the batch (samples.cl), where `radiance` sums what it brings:
 * RADIANCE_FLOATS floats, the channels first. Live paths are compacted into waves (wave.cl). A path adds only to its
 * own sum, one bounce after another, and random numbers follow from its name: so results do not depend on which ray
 * of a wave it gets.
 *
 * Behind a guided path's second vertex there are BRANCHES paths, each for its share of the light: branch b of the
 * path at a place is named b * places + place, `places` being those of the batch. Most of a sample's noise comes from
 * there, and half of its cost lies before.
 *
 * Where the scene is of few triangles (CASTERS, shadow.cl and closest.cl), shade_hits finds itself what rays hit, and
 * answers its shadow rays, which it only counts: nobody else has anything to trace, and add_lit nothing to add.
 *
 * vertex.cl has what happens at a surface. `triangles`: its records.
 *
 * Work-group contract: one-dimensional, any size; where VEC is 1 begin_paths and shade_hits have barriers, and two words
 * of local memory (wave.cl). A work-item handles VEC paths. Of the kernels that read a wave there may be any number of
 * work-items: each goes on with the rays that come a whole launch after its own. Arrays are a whole number of vectors
 * long; what lies past the last ray is read and not used.
 */

/* What branches add to the numbers of points, of which there are fewer, for other random numbers. */
#define BRANCH_SEED 0x20000000u

#if !FOLLOWED
kernel void begin_paths(const uint first_point, const uint point_count, const uint total_points,
                        const uint sample_count, const uint stride, const uint max_depth,
                        global const uint *restrict order, global const float *restrict surface,
                        global const float *restrict lights, global const float *restrict u,
                        global const float *restrict v, global float *restrict radiance, global float *restrict hits,
                        const uint plane, global float *restrict wave) {
  const uint blocks = stride / VEC;
  const uint items = point_count * blocks;
  const bool is_item = get_global_id(0) < items;
  if (VEC > 1 && !is_item) return;
  GROUP_WORDS(words);
  const uint item = min((uint)get_global_id(0), items - 1);
  const ulong at = (ulong)item * VEC;
  const ShadingPoint p = load_shading_point(surface, total_points, order[first_point + item / blocks]);
  const Scatterer s = scatterer_of(&p);
  for (uint branch = 0; is_item && branch < SLOTS; ++branch) {
    const ulong own = at + branch * (ulong)point_count * stride;
    for (uint k = 0; k < RADIANCE_FLOATS; ++k) STORE((real)0.0f, radiance + own * RADIANCE_FLOATS + k * VEC);
  }

  Ray ray;
  ray.origin = to_triple(ray_origin(&p));
  ray.direction = sample_scattering(&s, LOAD(u + at), LOAD(v + at));
  const real density = scattering_density(&s, ray.direction);
  ray.throughput = bounce_throughput(&s, to_triple(p.geometric_normal), ray.direction, density);
  /* Matte surfaces have found the lights by their points alone, but for scenes with an environment (gi.cl). */
#if DIRECT && HAS_ENVIRONMENT
  ray.density = density;
#elif DIRECT
  ray.density = SELECT((real)0.0f, density, is_shiny(&s));
#else
  ray.density = (real)0.0f;
#endif
  ray.path = LANE_NUMBER + (uint)at;
  ray.strips = strips_at(lights, &p);
#if HAS_PANES
  ray.behind = ray.passed = (real)0.0f;
#endif
#if HAS_GLASS
  if (p.eta != 0.0f) enter_glass(&s, &p, LOAD(u + at), LOAD(v + at), &ray);
#endif
  whole alive = (largest_of(ray.throughput) > 0.0f) && (LANE_NUMBER + (item % blocks) * VEC < sample_count) &&
                (whole)(is_item ? -1 : 0);
  /* Without surfaces whose emission paths alone find, one of depth 2 can only bring light if its ray may find a light. */
  const uint last_of_use = HAS_HIDDEN_EMISSION ? 1u : 2u;
  if (max_depth <= last_of_use) alive = alive && (ray.density > 0.0f);
#if SHARED
  /* Without colour: what others make of the path is of other colours. */
  const real begun = mean_of(ray.throughput);
  ray.throughput = (triple){begun, begun, begun};
  if (is_item) {
    STORE((real)0.0f, hits + SHARED_OFFSET * (ulong)point_count * stride + at);
    STORE(begun, hits + SHARED_BEGUN * (ulong)point_count * stride + at);
  }
#else
  (void)hits;
#endif
  const Sink to = {plane, wave, words};
  give_rays(&ray, alive, 0, &to);
}

#endif

/* Adds to the sums of lanes that are `here`. */
void add_radiance(const triple brought, const bits path, const whole here, global float *restrict radiance) {
  float added[3][VEC];
  int is_here[VEC];
  uint name[VEC];
  STORE(brought.x, added[0]);
  STORE(brought.y, added[1]);
  STORE(brought.z, added[2]);
  STORE(here, is_here);
  STORE(path, name);
  for (uint lane = 0; lane < VEC; ++lane)
    if (is_here[lane] != 0) {
      global float *sum = radiance + name[lane] * (ulong)RADIANCE_FLOATS;
      for (uint channel = 0; channel < 3; ++channel) sum[channel] += added[channel][lane];
    }
}

/* What all paths of a batch have in common. */
#define PATHS_PARAMETERS                                                                                              \
  const uint max_depth, const uint first_point, const uint first_id, const uint first_sample, const uint stride,      \
      const float inverse_stride, const uint stream, const uint seed_low, const uint seed_high, const uint places,    \
      global const uint *restrict order, global const float *restrict triangles, global const uint *restrict textures, \
      global const half *restrict texels, global const float *restrict lights, global const float *restrict casters,  \
      global const float *restrict guide_frame, global const uint *restrict guide,                                    \
      global const float *restrict guide_known, global uint *restrict guide_place, global float *restrict hits,       \
      global float *restrict radiance
#define PATHS_ARGUMENTS                                                                                               \
  max_depth, first_point, first_id, first_sample, stride, inverse_stride, stream, seed_low, seed_high, places, order, \
      triangles, textures, texels, lights, casters, guide_frame, guide, guide_known, guide_place, hits, radiance

/* Rays of `bounce` (the first is 1) and their hits; the rays that follow go `to` where they are kept. */
void shade(const Ray *from, const Hit *found_hit, const whole here, const uint bounce, PATHS_PARAMETERS,
#if !FOLLOWED
           const
#endif
           Sink *to) {
  const Hit hit = *found_hit;
  const triple origin = from->origin;
  const triple direction = from->direction;
  const triple outgoing = {-direction.x, -direction.y, -direction.z};
#if !CASTERS
  (void)casters;
#endif
  const whole at = max(hit.triangle, (whole)0) * TRIANGLE_FLOATS;
  Ray ray;
  ray.throughput = from->throughput;
  ray.path = from->path;
  const whole light = TO_WHOLE(gather(triangles, at + TRIANGLE_LIGHT));
  const whole met = hit.triangle >= 0;
  triple brought = {(real)0.0f, (real)0.0f, (real)0.0f};

#if HAS_PANES
  const real behind = from->behind;
  const real passed = from->passed;
#endif
  /* A light ends the path. */
  const whole on_light = met && (light >= 0);
  if (ANY(on_light)) {
#if HAS_PANES
    const triple found = light_met(lights, from->strips, light, sum_of(origin, direction, -behind), direction,
                                   hit.distance + behind, from->density);
#else
    const triple found = light_met(lights, from->strips, light, origin, direction, hit.distance, from->density);
#endif
    brought = sum_where(brought, product(ray.throughput, found), on_light);
  }
#if HAS_ENVIRONMENT
  /* So does leaving the scene. */
  const whole outside = here && !met;
  if (ANY(outside)) {
    const triple found = sky_met(lights, from->strips, direction, from->density);
    brought = sum_where(brought, product(ray.throughput, found), outside);
  }
#endif
  whole on_surface = met && (light < 0);
  triple position, geometric_normal;
  Scatterer s;
  load_hit(triangles, textures, texels, at, sum_of(origin, direction, hit.distance), hit.u, hit.v, outgoing, &position,
           &geometric_normal, &s);
#if HAS_EMISSION
  triple emitted = emission_at(triangles, textures, texels, at, hit.u, hit.v);
#if HAS_SAMPLED_EMISSION
  /* A surface that is sampled as a light, too: -2 less its number. */
  const whole sampled = on_surface && (light < -1);
  if (ANY(sampled)) {
    const whole record = LIGHT_FLOATS * max(-2 - light, (whole)0);
    const real weight = light_weight(lights, from->strips, record, origin, direction, hit.distance, from->density);
    emitted = scaled(emitted, SELECT((real)1.0f, weight, sampled));
  }
#endif
  brought = sum_where(brought, product(ray.throughput, emitted), on_surface);
#endif
  /* As surface_offset. */
  const real coordinate = max(fabs(position.x), max(fabs(position.y), fabs(position.z)));
  const real offset = FMA((real)RELATIVE_OFFSET, coordinate, fabs(gather(triangles, at + TRIANGLE_OFFSET)));
#if SHARED
  if (bounce == 1)
    keep_hit(position, geometric_normal, &s, offset,
             on_surface && looks_alike(triangles, at, geometric_normal, &s), ray.path, places, hits);
#else
  (void)hits;
#endif
  /* This bounce's surfaces are lit at depth bounce + 2, and rays that leave them find light of that depth. */
#if HAS_PANES
  /* Panes that a path went through are no part of its depth. */
  const whole depth = TO_WHOLE((real)bounce - passed) + 2;
  const whole is_lit = depth <= (int)max_depth;
  on_surface = on_surface && (is_lit || (s.eta < 0.0f));
  /* Not where the work-items of a group give their rays together. */
  if (VEC > 1 && !ANY(on_surface)) {
#else
  if (bounce + 2 > max_depth) {
#endif
    add_radiance(brought, ray.path, largest_of(brought) > 0.0f, radiance);
    return;
  }
  whole both_ways = on_surface;
  /* A last ray can only find a light that is sampled, and is traced only if the surface has a lobe: other surfaces
   * find these lights by their points alone. */
#if HAS_PANES
  both_ways = both_ways && ((depth + (HAS_HIDDEN_EMISSION ? 0 : 1) <= (int)max_depth) || is_shiny(&s));
#else
  const uint reach = HAS_HIDDEN_EMISSION ? bounce + 2 : bounce + 3;
  if (reach > max_depth) both_ways = both_ways && is_shiny(&s);
#endif
  ray.origin = sum_of(position, geometric_normal, offset);
  /* The path's sample: of which point, and which of its samples.
   * Vectors of integers are divided one by one; places are below 2^22, so this quotient is exact. */
  bits place = ray.path;
  bits branch_seed = (bits)0u;
  for (uint branch = 1; branch < BRANCHES; ++branch) {
    const whole later = place >= (bits)places;
    place -= SELECT((bits)0u, (bits)places, later);
    branch_seed += SELECT((bits)0u, (bits)BRANCH_SEED, later);
  }
  const bits slot = TO_BITS((TO_REAL(place) + 0.5f) * inverse_stride);
  const bits index = place - slot * stride + first_sample;
  const bits point = gather_bits(order, slot + first_point);
  real coordinates[5];
  sample_nested(point + first_id + branch_seed, index, stream, bounce, seed_low, seed_high, coordinates);

  ray.strips = strips_of(lights, position, geometric_normal);
  const LightSample found =
      sample_emitters(lights, ray.strips, position, ray.origin, coordinates[0], coordinates[1]);
  const real cosine = dot_triple(s.normal, found.towards);
  const whole lit =
      on_surface && found.lit && (cosine > 0.0f) && (dot_triple(geometric_normal, found.towards) > 0.0f);
  real f_r[3];
  scattering(&s, found.towards, f_r);
  const real weight = found.density / (found.density + scattering_density(&s, found.towards));
#if HAS_GLASS
  const real of_glass = glass_light_weight(&s, found.towards, found.density, 0);
  const real scale = cosine * SELECT(SELECT((real)1.0f, weight, both_ways), of_glass, is_glass(&s));
#else
  const real scale = cosine * SELECT((real)1.0f, weight, both_ways);
#endif
  Ray shadow;
  shadow.origin = ray.origin;
  shadow.direction = found.segment;
  shadow.throughput = (triple){ray.throughput.x * f_r[0] * found.radiance[0] * scale,
                               ray.throughput.y * f_r[1] * found.radiance[1] * scale,
                               ray.throughput.z * f_r[2] * found.radiance[2] * scale};
  shadow.density = (real)0.0f;
  shadow.path = ray.path;
#if SHARED && HAS_SPECULAR
  /* Light that comes straight to the first hit has a slot of its own. */
  if (bounce == 1) {
    shadow.path += BRANCHES * places;
    keep_matte(&s, found.towards, BRANCHES, on_surface, ray.path, places, hits);
  }
#endif
  shadow.strips = ray.strips;
  const whole is_cast = lit && (largest_of(shadow.throughput) > 0.0f);
#if CASTERS
  count_shadow_rays(is_cast, to);
  const whole reached = reaches_light(casters, shadow.origin, shadow.direction, is_cast);
#if SHARED && HAS_SPECULAR
  if (bounce == 1)
    add_radiance(shadow.throughput, shadow.path, reached, radiance);
  else
#endif
    brought = sum_where(brought, shadow.throughput, reached);
#else
  give_rays(&shadow, is_cast, 1, to);
#endif

#if GUIDED || RECORDED
  const whole cell = guide_cell(guide_frame, position, s.normal);
#else
  const whole cell = (whole)0;
  (void)guide_frame;
#endif
#if RECORDED
  /* Where the first hit's next ray goes; nowhere for shiny surfaces, whose square is another. */
  if (bounce == 1) {
    const whole bin = cell * (DENSITY_BINS * DENSITY_BINS) + guide_bin(coordinates[2], coordinates[3]);
    uint places_there[VEC];
    uint names[VEC];
    int is_there[VEC];
    STORE(SELECT(TO_BITS(bin), (bits)NO_RAY, is_shiny(&s)), places_there);
    STORE(ray.path, names);
    STORE(on_surface, is_there);
    for (uint lane = 0; lane < VEC; ++lane)
      if (is_there[lane] != 0) guide_place[names[lane]] = places_there[lane];
  }
#else
  (void)guide_place;
#endif
#if HAS_PANES
  Ray before = *from;
  before.behind = behind + hit.distance;
  before.passed = passed;
#endif
  const uint branches = bounce == 1 ? BRANCHES : 1;
  const float share = 1.0f / (float)branches;
  for (uint branch = 0; branch < branches; ++branch) {
    /* Together they are spread better than by chance. */
    const real u = moved_on(coordinates[2], (float)branch * share);
    const real v = moved_on(coordinates[3], (float)branch * share);
    Ray next = ray;
    next.path += branch * places;
    next.throughput = scaled(ray.throughput, (real)share);
#if HAS_PANES
    const whole alive = next_ray(&s, geometric_normal, cell, bounce, guide, guide_known, u, v, coordinates[4],
                                 on_surface && both_ways, &next, &brought) &&
                        past_panes(&s, &before, is_lit, geometric_normal, &next);
#else
    const whole alive = next_ray(&s, geometric_normal, cell, bounce, guide, guide_known, u, v, coordinates[4],
                                 on_surface && both_ways, &next, &brought);
#endif
#if HAS_GLASS
    next.origin = leaving_from(position, geometric_normal, offset, next.direction);
#endif
#if SHARED && HAS_SPECULAR
    if (bounce == 1) keep_matte(&s, next.direction, branch, on_surface, ray.path, places, hits);
#endif
    give_rays(&next, alive, 0, to);
  }
  /* What roulette is expected to find may be negative. */
  add_radiance(brought, ray.path, here, radiance);
}

#if !FOLLOWED
kernel void shade_hits(const uint bounce, PATHS_PARAMETERS, const uint plane, global const float *restrict wave,
                       const uint next_plane, global float *restrict next_wave) {
  GROUP_WORDS(words);
  const Sink to = {next_plane, next_wave, words};
  const uint count = rays_of(wave);
  const uint step = (uint)get_global_size(0) * VEC;
  /* Where VEC is 1 a group goes on while one of its work-items has a ray. */
  const uint ahead = VEC == 1 ? (uint)get_local_id(0) : 0u;
  for (uint own = (uint)get_global_id(0) * VEC; own - ahead < count; own += step) {
    const whole here = LANE_NUMBER + own < (bits)count;
    const uint first = VEC == 1 ? min(own, count - 1) : own;
    const Ray ray = load_ray(wave, plane, first, here, lights);
#if CASTERS
    const Hit hit = closest_hit(casters, ray.origin, ray.direction, here);
#else
    const whole triangle = SELECT((whole)(-1), AS_WHOLE(LOAD(PLANE(wave, WAVE_TRIANGLE) + first)), here);
    /* Where nothing is hit these planes hold any bits. */
    const Hit hit = {triangle, SELECT((real)0.0f, LOAD(PLANE(wave, WAVE_DISTANCE) + first), triangle >= 0),
                     SELECT((real)0.0f, LOAD(PLANE(wave, WAVE_U) + first), triangle >= 0),
                     SELECT((real)0.0f, LOAD(PLANE(wave, WAVE_V) + first), triangle >= 0)};
#endif
    shade(&ray, &hit, here, bounce, PATHS_ARGUMENTS, &to);
  }
}

kernel void add_lit(const uint plane, global const float *restrict wave, global float *restrict radiance) {
  const uint count = shadow_rays_of(wave);
  for (uint ray = (uint)get_global_id(0); ray < count; ray += (uint)get_global_size(0)) {
    if (((global const uchar *)PLANE(wave, WAVE_LIT))[ray] == 0) continue;
    global float *sum = radiance + as_uint(PLANE(wave, WAVE_SHADOW_PATH)[ray]) * (ulong)RADIANCE_FLOATS;
    for (uint channel = 0; channel < 3; ++channel) sum[channel] += PLANE(wave, WAVE_SHADOW_THROUGHPUT + channel)[ray];
  }
}

/* One work-item; `rays` counts those of both kinds. */
kernel void end_wave(global float *restrict wave, global ulong *restrict rays) {
  if (get_global_id(0) != 0) return;
  global uint *header = (global uint *)wave;
  rays[0] += (ulong)header[0] + header[COUNT_STEP];
  header[0] = header[COUNT_STEP] = 0;
}

/* `most` caps what a path brings, by its largest channel. */
kernel void finish_paths(const uint count, const float most, global const uint *restrict slot,
                         global const uchar *restrict visible, global const float *restrict radiance,
                         global float *restrict value) {
  const uint at = (uint)get_global_id(0) * VEC;
  if (at >= count) return;
  const real seen = load_visibility(slot, visible, at);
  float sum[3][VEC];
#pragma unroll
  for (uint lane = 0; lane < VEC; ++lane)
    for (uint channel = 0; channel < 3; ++channel)
      sum[channel][lane] = branch_sum(radiance + (at + lane) * (ulong)RADIANCE_FLOATS + channel, count);
  const triple brought = {LOAD(sum[0]), LOAD(sum[1]), LOAD(sum[2])};
  const real largest = largest_of(brought);
  const real scale = SELECT((real)1.0f, (real)most / largest, largest > most);
  STORE(FMA(LOAD(value + at), seen, brought.x * scale), value + at);
  STORE(FMA(LOAD(value + count + at), seen, brought.y * scale), value + count + at);
  STORE(FMA(LOAD(value + 2 * (ulong)count + at), seen, brought.z * scale), value + 2 * (ulong)count + at);
}
#endif
