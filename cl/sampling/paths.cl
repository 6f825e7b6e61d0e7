/* Paths behind the first bounce, a wavefront at a time: kernels between the rays that the host traces.
 *
 *   begin_paths   (u, v) of a batch's samples to the first ray of each path
 *   shade_hits    what rays hit: emission, a shadow ray to a light, the next ray
 *   add_lit       adds what shadow rays found visible
 *   finish_paths  direct light with its visibility, plus what the path brought: the samples' complete values
 *
 * A path is named by its sample's place in the batch (samples.cl), where `radiance` sums what it brings:
 * RADIANCE_FLOATS floats, the channels first. Live paths are compacted into waves (wave.cl). A path adds only to its
 * own sum, one bounce after another, and random numbers follow from its name: so results do not depend on which ray
 * of a wave it gets.
 *
 * Where the scene is of few triangles (CASTERS, shadow.cl), shade_hits answers its shadow rays itself and only counts
 * them; there is then nothing for add_lit.
 *
 * `triangles`: records of triangles.py. With HAS_SPECULAR they have reflectance and roughness, with HAS_EMISSION
 * emission, with HAS_NORMALS the corners' normals, with HAS_TEXTURES and HAS_COLOURS what is interpolated for
 * textures.cl and between the corners' colours. Both sides are alike.
 *
 * Work-group contract: one-dimensional, any size, no local memory, no barriers; a work-item handles VEC
 * paths. Arrays are a whole number of vectors long; what lies past `count` is read and not used.
 */

/* Throughput of one more bounce: f_r cos / density, zero below the surface. */
triple bounce_throughput(const Scatterer *s, const triple geometric_normal, const triple towards,
                         const real density) {
  real f_r[3];
  scattering(s, towards, f_r);
  const real cosine = dot_triple(s->normal, towards);
  const whole above = (cosine > 0.0f) && (dot_triple(geometric_normal, towards) > 0.0f) && (density > 0.0f);
  const real scale = SELECT((real)0.0f, cosine / density, above);
  return (triple){SELECT((real)0.0f, f_r[0] * scale, above), SELECT((real)0.0f, f_r[1] * scale, above),
                  SELECT((real)0.0f, f_r[2] * scale, above)};
}

real largest_of(const triple t) { return max(t.x, max(t.y, t.z)); }

whole is_shiny(const Scatterer *s) {
#if HAS_SPECULAR
  return s->reflectance.x + s->reflectance.y + s->reflectance.z > 0.0f;
#else
  (void)s;
  return (whole)0;
#endif
}

kernel void begin_paths(const uint first_point, const uint point_count, const uint total_points,
                        const uint sample_count, const uint stride, const uint max_depth,
                        global const uint *restrict order, global const float *restrict surface,
                        global const float *restrict lights, global const float *restrict u,
                        global const float *restrict v, global float *restrict radiance, const uint plane,
                        global float *restrict wave) {
  const uint blocks = stride / VEC;
  const uint item = (uint)get_global_id(0);
  if (item >= point_count * blocks) return;
  const ulong at = (ulong)item * VEC;
  const ShadingPoint p = load_shading_point(surface, total_points, order[first_point + item / blocks]);
  const Scatterer s = scatterer_of(&p);
  for (uint k = 0; k < RADIANCE_FLOATS; ++k) STORE((real)0.0f, radiance + at * RADIANCE_FLOATS + k * VEC);

  Ray ray;
  ray.origin = to_triple(ray_origin(&p));
  ray.direction = sample_scattering(&s, LOAD(u + at), LOAD(v + at));
  const real density = scattering_density(&s, ray.direction);
  ray.throughput = bounce_throughput(&s, to_triple(p.geometric_normal), ray.direction, density);
  /* Matte surfaces have found the lights by their points alone. */
#if DIRECT
  ray.density = SELECT((real)0.0f, density, is_shiny(&s));
#else
  ray.density = (real)0.0f;
#endif
  ray.path = LANE_NUMBER + (uint)at;
  ray.strips = strips_at(lights, &p);
  whole alive = (largest_of(ray.throughput) > 0.0f) && (LANE_NUMBER + (item % blocks) * VEC < sample_count);
  /* Without emissive surfaces a path of depth 2 can only bring light if its ray may find a light. */
  const uint last_of_use = HAS_EMISSION ? 1u : 2u;
  if (max_depth <= last_of_use) alive = alive && (ray.density > 0.0f);
  append_rays(&ray, alive, 0, plane, wave);
}

triple sum_of(const triple a, const triple b, const real factor) {
  return (triple){FMA(factor, b.x, a.x), FMA(factor, b.y, a.y), FMA(factor, b.z, a.z)};
}

triple turned(const triple t, const whole turn) {
  return (triple){SELECT(t.x, -t.x, turn), SELECT(t.y, -t.y, turn), SELECT(t.z, -t.z, turn)};
}

/* Where rays hit. The position along the ray is moved onto the triangle's plane, for the offset to suffice. */
void load_hit(global const float *restrict triangles, global const uint *restrict textures,
              global const half *restrict texels, const whole at, const triple along, const real b1, const real b2,
              const triple outgoing, triple *position, triple *geometric_normal, Scatterer *s) {
  const triple own = gather_triple(triangles, at + TRIANGLE_NORMAL);
  const real above = dot_triple(own, along) - gather(triangles, at + TRIANGLE_DISTANCE);
  *position = sum_of(along, own, -above);
  *geometric_normal = turned(own, dot_triple(own, outgoing) < 0.0f);
  s->normal = *geometric_normal;
  s->outgoing = outgoing;
  s->albedo = gather_triple(triangles, at + TRIANGLE_ALBEDO);
#if HAS_SPECULAR
  s->reflectance = gather_triple(triangles, at + TRIANGLE_REFLECTANCE);
  s->roughness = gather(triangles, at + TRIANGLE_ROUGHNESS);
#endif
#if HAS_NORMALS
  const whole smooth = gather(triangles, at + TRIANGLE_OFFSET) < 0.0f;
  if (ANY(smooth)) {
    const triple corner0 = gather_triple(triangles, at + TRIANGLE_NORMAL_0);
    const triple corner1 = gather_triple(triangles, at + TRIANGLE_NORMAL_1);
    const triple corner2 = gather_triple(triangles, at + TRIANGLE_NORMAL_2);
    const triple zero = {(real)0.0f, (real)0.0f, (real)0.0f};
    triple normal = sum_of(sum_of(sum_of(zero, corner0, 1.0f - b1 - b2), corner1, b1), corner2, b2);
    normal = turned(normal, dot_triple(normal, *geometric_normal) < 0.0f);
    const real length2 = dot_triple(normal, normal);
    const real inverse = rsqrt(max(length2, (real)1e-30f));
    const whole usable = smooth && (length2 > 0.0f) && (dot_triple(normal, outgoing) > 0.0f);
    s->normal.x = SELECT(s->normal.x, normal.x * inverse, usable);
    s->normal.y = SELECT(s->normal.y, normal.y * inverse, usable);
    s->normal.z = SELECT(s->normal.z, normal.z * inverse, usable);
  }
#endif
  vary_surface(triangles, textures, texels, at, b1, b2, s);
}

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

/* a + b where `here`. */
triple sum_where(const triple a, const triple b, const whole here) {
  return (triple){SELECT(a.x, a.x + b.x, here), SELECT(a.y, a.y + b.y, here), SELECT(a.z, a.z + b.z, here)};
}

/* What a ray that hits a light finds there, weighted by how else that could have been found: 0 from behind, and where
 * the ray's `density` is. */
triple light_met(global const float *restrict lights, const whole strips, const whole light, const triple origin,
                 const triple direction, const real distance, const real density) {
  const whole record = max(light, (whole)0) * LIGHT_FLOATS;
  const real emitted = -dot_triple(light_triple(lights, record, LIGHT_NORMAL), direction);
  const real facing = SELECT(emitted, fabs(emitted), light_number(lights, record, LIGHT_TWO_SIDED) > 0.0f);
  const triple segment = {distance * direction.x, distance * direction.y, distance * direction.z};
  const real other = light_density(lights, strips, record, origin, segment, max(facing, (real)1e-20f));
  const real share = density / (density + other);
  const real weight = SELECT((real)0.0f, share, (facing > 0.0f) && (density > 0.0f));
  const triple amount = light_triple(lights, record, LIGHT_RADIANCE);
  return (triple){weight * amount.x, weight * amount.y, weight * amount.z};
}

/* Rays of `bounce` (the first is 1) and their hits. */
kernel void shade_hits(const uint count, const uint max_depth, const uint bounce,
                       const uint first_point, const uint first_sample, const uint stride, const float inverse_stride,
                       const uint stream, const uint seed_low, const uint seed_high, global const uint *restrict order,
                       global const float *restrict triangles, global const uint *restrict textures,
                       global const half *restrict texels, global const float *restrict lights,
                       global const float *restrict casters, global const float *restrict guide_frame,
                       global const uint *restrict guide, global const float *restrict guide_mean,
                       global uint *restrict guide_place, const uint plane, global const float *restrict wave,
                       global float *restrict radiance, const uint next_plane, global float *restrict next_wave) {
  const uint first = (uint)get_global_id(0) * VEC;
  if (first >= count) return;
  const whole here = LANE_NUMBER + first < (bits)count;
  const whole triangle = SELECT((whole)(-1), AS_WHOLE(LOAD(PLANE(wave, WAVE_TRIANGLE) + first)), here);
  const whole at = max(triangle, (whole)0) * TRIANGLE_FLOATS;
  const triple origin = load_planes(wave, WAVE_ORIGIN, plane, first);
  const triple direction = load_planes(wave, WAVE_DIRECTION, plane, first);
  const triple outgoing = {-direction.x, -direction.y, -direction.z};
  const real distance = LOAD(PLANE(wave, WAVE_DISTANCE) + first);
  Ray ray;
  ray.throughput = load_planes(wave, WAVE_THROUGHPUT, plane, first);
  /* Lanes past the last ray may read a path number of an earlier, larger batch. */
  ray.path = SELECT((bits)0, AS_BITS(LOAD(PLANE(wave, WAVE_PATH) + first)), here);
  const whole light = TO_WHOLE(gather(triangles, at + TRIANGLE_LIGHT));
  const whole met = triangle >= 0;
  triple brought = {(real)0.0f, (real)0.0f, (real)0.0f};

  /* A light ends the path. */
  const whole on_light = met && (light >= 0);
  if (ANY(on_light)) {
    const real density = LOAD(PLANE(wave, WAVE_DENSITY) + first);
#if LIGHT_COUNT > 1
    /* Lanes past the last ray hold anything. */
    const whole left = SELECT((whole)FIRST_ROW, AS_WHOLE(LOAD(PLANE(wave, WAVE_STRIPS) + first)), on_light);
#else
    const whole left = all_strips(lights);
#endif
    const triple found = light_met(lights, left, light, origin, direction, distance, density);
    brought = sum_where(brought, product(ray.throughput, found), on_light);
  }
  const whole on_surface = met && (light < 0);
  triple position, geometric_normal;
  Scatterer s;
  load_hit(triangles, textures, texels, at, sum_of(origin, direction, distance), LOAD(PLANE(wave, WAVE_U) + first),
           LOAD(PLANE(wave, WAVE_V) + first), outgoing, &position, &geometric_normal, &s);
#if HAS_EMISSION
  const triple emitted = emission_at(triangles, textures, texels, at, LOAD(PLANE(wave, WAVE_U) + first),
                                     LOAD(PLANE(wave, WAVE_V) + first));
  brought = sum_where(brought, product(ray.throughput, emitted), on_surface);
#endif
  /* This bounce's surfaces are lit at depth bounce + 2, and rays that leave them find light of that depth. */
  if (bounce + 2 > max_depth) {
    add_radiance(brought, ray.path, largest_of(brought) > 0.0f, radiance);
    return;
  }
  whole both_ways = on_surface;
  /* A last ray can only find an area light, and is traced only if the surface has a lobe: other surfaces
   * find these lights by their points alone. */
  const uint reach = HAS_EMISSION ? bounce + 2 : bounce + 3;
  if (reach > max_depth) both_ways = both_ways && is_shiny(&s);
  /* As surface_offset. */
  const real coordinate = max(fabs(position.x), max(fabs(position.y), fabs(position.z)));
  const real offset = FMA((real)RELATIVE_OFFSET, coordinate, fabs(gather(triangles, at + TRIANGLE_OFFSET)));
  ray.origin = sum_of(position, geometric_normal, offset);
  /* The path's sample: of which point, and which of its samples. */
  /* Vectors of integers are divided one by one; places are below 2^22, so this quotient is exact. */
  const bits slot = TO_BITS((TO_REAL(ray.path) + 0.5f) * inverse_stride);
  const bits index = ray.path - slot * stride + first_sample;
  const bits point = gather_bits(order, slot + first_point);
  real coordinates[5];
  sample_nested(point, index, stream, bounce, seed_low, seed_high, coordinates);

  ray.strips = strips_of(lights, position, geometric_normal);
  const LightSample found =
      sample_lights(lights, ray.strips, position, ray.origin, coordinates[0], coordinates[1]);
  const real cosine = dot_triple(s.normal, found.towards);
  const whole lit =
      on_surface && found.lit && (cosine > 0.0f) && (dot_triple(geometric_normal, found.towards) > 0.0f);
  real f_r[3];
  scattering(&s, found.towards, f_r);
  const real weight = found.density / (found.density + scattering_density(&s, found.towards));
  const real scale = cosine * SELECT((real)1.0f, weight, both_ways);
  Ray shadow;
  shadow.origin = ray.origin;
  shadow.direction = found.segment;
  shadow.throughput = (triple){ray.throughput.x * f_r[0] * found.radiance[0] * scale,
                               ray.throughput.y * f_r[1] * found.radiance[1] * scale,
                               ray.throughput.z * f_r[2] * found.radiance[2] * scale};
  shadow.density = (real)0.0f;
  shadow.path = ray.path;
  shadow.strips = ray.strips;
  const whole is_cast = lit && (largest_of(shadow.throughput) > 0.0f);
#if CASTERS
  count_shadow_rays(is_cast, next_wave);
  brought = sum_where(brought, shadow.throughput, reaches_light(casters, shadow.origin, shadow.direction, is_cast));
#else
  (void)casters;
  append_rays(&shadow, is_cast, 1, next_plane, next_wave);
#endif

  real inverse_guide = (real)1.0f;
#if GUIDED
  const whole matte = !is_shiny(&s);
  real guided_u = coordinates[2];
  real guided_v = coordinates[3];
  const whole cell = guide_cell(guide_frame, position, s.normal);
  inverse_guide = guide_square(guide, cell, &guided_u, &guided_v);
  inverse_guide = SELECT((real)1.0f, inverse_guide, matte);
  coordinates[2] = SELECT(coordinates[2], guided_u, matte);
  coordinates[3] = SELECT(coordinates[3], guided_v, matte);
#else
  (void)guide;
  (void)guide_mean;
#endif
#if RECORDED
  /* Where the first hit's next ray goes; nowhere for shiny surfaces, whose square is another. */
  if (bounce == 1) {
    const whole place =
        guide_cell(guide_frame, position, s.normal) * (DENSITY_BINS * DENSITY_BINS) + guide_bin(coordinates[2], coordinates[3]);
    uint places[VEC];
    uint names[VEC];
    int is_there[VEC];
    STORE(SELECT(TO_BITS(place), (bits)NO_RAY, is_shiny(&s)), places);
    STORE(ray.path, names);
    STORE(on_surface, is_there);
    for (uint lane = 0; lane < VEC; ++lane)
      if (is_there[lane] != 0) guide_place[names[lane]] = places[lane];
  }
#else
  (void)guide_place;
#endif
#if !GUIDED && !RECORDED
  (void)guide_frame;
#endif
  ray.direction = sample_scattering(&s, coordinates[2], coordinates[3]);
  ray.density = scattering_density(&s, ray.direction);
  const triple factor = bounce_throughput(&s, geometric_normal, ray.direction, ray.density);
  ray.throughput.x *= factor.x;
  ray.throughput.y *= factor.y;
  ray.throughput.z *= factor.z;
  whole alive = on_surface && both_ways;
  alive = alive && (largest_of(ray.throughput) > 0.0f);
  if (bounce >= ROULETTE_BOUNCE) {
    const real survival = min(ROULETTE_SCALE * largest_of(ray.throughput), (real)MOST_SURVIVE);
    const whole survives =
        alive && (coordinates[4] < survival);
    const real scale_up = 1.0f / max(survival, (real)1e-20f);
#if GUIDED
    /* With R the radiance of the rest of the path and c the cell's mean: c is added in any case, and
     * roulette decides on the difference alone. The sum is c + (R - c) / survival or c, with expectation
     * R for every c. */
    const whole known = cell * GUIDE_CHANNELS;
    const real kept = 1.0f - SELECT((real)0.0f, scale_up, survives);
    const triple expected = sum_of((triple){(real)0.0f, (real)0.0f, (real)0.0f}, gather_triple(guide_mean, known), kept);
    brought = sum_where(brought, product(ray.throughput, expected), alive && matte);
#endif
    alive = survives;
    ray.throughput.x *= scale_up;
    ray.throughput.y *= scale_up;
    ray.throughput.z *= scale_up;
  }
  /* After roulette, which depends on the surface's throughput and not on the density of the direction.
   * The MIS weight of light that the ray finds is that of an unguided ray: weights need only sum to
   * one. */
  ray.throughput.x *= inverse_guide;
  ray.throughput.y *= inverse_guide;
  ray.throughput.z *= inverse_guide;
  append_rays(&ray, alive && (largest_of(ray.throughput) > 0.0f), 0, next_plane, next_wave);
  /* What roulette is expected to find may be negative. */
  add_radiance(brought, ray.path, here, radiance);
}

kernel void add_lit(const uint count, const uint plane, global const float *restrict wave,
                    global float *restrict radiance) {
  const uint ray = (uint)get_global_id(0);
  if (ray >= count || ((global const uchar *)PLANE(wave, WAVE_LIT))[ray] == 0) return;
  global float *sum = radiance + as_uint(PLANE(wave, WAVE_SHADOW_PATH)[ray]) * (ulong)RADIANCE_FLOATS;
  for (uint channel = 0; channel < 3; ++channel) sum[channel] += PLANE(wave, WAVE_SHADOW_THROUGHPUT + channel)[ray];
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
      sum[channel][lane] = radiance[(at + lane) * (ulong)RADIANCE_FLOATS + channel];
  const triple brought = {LOAD(sum[0]), LOAD(sum[1]), LOAD(sum[2])};
  const real largest = largest_of(brought);
  const real scale = SELECT((real)1.0f, (real)most / largest, largest > most);
  STORE(FMA(LOAD(value + at), seen, brought.x * scale), value + at);
  STORE(FMA(LOAD(value + count + at), seen, brought.y * scale), value + count + at);
  STORE(FMA(LOAD(value + 2 * (ulong)count + at), seen, brought.z * scale), value + 2 * (ulong)count + at);
}
