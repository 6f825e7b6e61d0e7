/* Paths behind the first bounce, a wavefront at a time: kernels between the rays that the host traces.
 *
 *   begin_paths   (u, v) of a batch's samples to the first ray of each path
 *   shade_hits    what rays hit: emission, a shadow ray to a light, the next ray
 *   add_lit       adds what shadow rays found visible
 *   finish_paths  direct light with its visibility, plus what the path brought: the samples' complete values
 *
 * A path is named by its sample's place in the batch (samples.cl), where `radiance` sums what it brings, a plane of
 * `capacity` floats a channel. Live paths are compacted: a `wave` holds what a bounce's rays, and the shadow rays from
 * where they start, are made of, and what they found: HEADER words, then planes of 32-bit words, ray i at i of each:
 *   0 origin (3), 3 direction (3) of the rays that go on, 6 origin (3), 9 direction (3) of shadow rays, as the host
 *   reads them; 12 triangle hit (int, -1: none), 13 and 14 barycentric u and v, 15 distance in multiples of the
 *   direction, 16 whether the shadow ray reached its light (bytes), as the host writes them; 17 throughput (3),
 *   20 density of the direction (0: light that this ray hits was sampled otherwise), 21 path; 22 throughput (3) and
 *   25 path of shadow rays.
 * Words 0 and COUNT_STEP of the header count the rays and the shadow rays, on cache lines of their own. Planes are as
 * long as a bounce needs, so that what the host maps is short. Which ray a path gets may differ between runs; a path
 * adds only to its own sum, one bounce after another, and random numbers follow from its name: so results do not.
 *
 * `triangles`: records of TRIANGLE_FLOATS floats: 0 unit normal, 3 distance of its plane from the world's origin,
 * 4 offset of ray origins (negative where the corners have normals), 5 light (-1: none), 6 albedo, then with
 * HAS_SPECULAR reflectance (3) and roughness, with HAS_EMISSION emission (3), with HAS_NORMALS the corners'
 * normals (9). Both sides are alike.
 *
 * Work-group contract: one-dimensional, any size, no local memory, no barriers; a work-item handles VEC
 * paths. Arrays are a whole number of vectors long; what lies past `count` is read and not used.
 */

#if VEC == 1
#define AS_REAL(x) as_float(x)
#define AS_WHOLE(x) as_int(x)
#define AS_BITS(x) as_uint(x)
#else
#define AS_REAL(x) JOIN(as_float, VEC)(x)
#define AS_WHOLE(x) JOIN(as_int, VEC)(x)
#define AS_BITS(x) JOIN(as_uint, VEC)(x)
#endif
#define AT_REFLECTANCE 9
#define AT_EMISSION (9 + 4 * HAS_SPECULAR)
#define AT_NORMALS (AT_EMISSION + 3 * HAS_EMISSION)

/* Rays that go on and shadow rays: their first planes, and how many planes `append_ray` writes. */
#define NEXT_RAY 0
#define NEXT_STATE 17
#define SHADOW_RAY 6
#define SHADOW_STATE 22
#define HIT 12
#define LIT 16
#define PLANE(wave, number) ((wave) + HEADER + (number) * (ulong)plane)

typedef struct {
  triple origin, direction, throughput;
  bits path;
  real density;
} Ray;

/* Appends the rays of lanes that are alive to those that `count_at` counts; shadow rays leave their density out. */
void append_rays(const Ray *ray, const whole alive, const int is_shadow, const uint plane, global float *restrict wave) {
  float number[11][VEC];
  int is_alive[VEC];
  uint source[VEC + 1];
  STORE(alive, is_alive);
  uint count = 0;
  /* Without branches: whether a lane is alive cannot be foreseen. */
#pragma unroll
  for (uint lane = 0; lane < VEC; ++lane) {
    source[count] = lane;
    count += is_alive[lane] != 0 ? 1u : 0u;
  }
  if (count == 0) return;
  volatile global uint *ray_count = (volatile global uint *)wave + (is_shadow ? COUNT_STEP : 0);
  const uint at = atomic_add(ray_count, count);
  global float *restrict to = PLANE(wave, is_shadow ? SHADOW_RAY : NEXT_RAY) + at;
  global float *restrict state = PLANE(wave, is_shadow ? SHADOW_STATE : NEXT_STATE) + at;
  const real numbers[11] = {ray->origin.x,     ray->origin.y,     ray->origin.z,     ray->direction.x,
                            ray->direction.y,  ray->direction.z,  ray->throughput.x, ray->throughput.y,
                            ray->throughput.z, ray->density,      AS_REAL(ray->path)};
  if (count == VEC) {
#pragma unroll
    for (uint row = 0; row < 6; ++row) STORE(numbers[row], to + row * (ulong)plane);
#pragma unroll
    for (uint row = 0; row < 3; ++row) STORE(numbers[6 + row], state + row * (ulong)plane);
    if (!is_shadow) STORE(numbers[9], state + 3 * (ulong)plane);
    STORE(numbers[10], state + (is_shadow ? 3 : 4) * (ulong)plane);
    return;
  }
#pragma unroll
  for (uint row = 0; row < 11; ++row) STORE(numbers[row], number[row]);
  for (uint i = 0; i < count; ++i) {
    const uint lane = source[i];
#pragma unroll
    for (uint row = 0; row < 6; ++row) to[row * (ulong)plane + i] = number[row][lane];
#pragma unroll
    for (uint row = 0; row < 3; ++row) state[row * (ulong)plane + i] = number[6 + row][lane];
    if (!is_shadow) state[3 * (ulong)plane + i] = number[9][lane];
    state[(is_shadow ? 3 : 4) * (ulong)plane + i] = number[10][lane];
  }
}

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
                        const uint sample_count, const uint stride, const uint capacity, const uint max_depth,
                        global const uint *restrict order, global const float *restrict surface,
                        global const float *restrict u, global const float *restrict v,
                        global float *restrict radiance, const uint plane, global float *restrict wave) {
  const uint blocks = stride / VEC;
  const uint item = (uint)get_global_id(0);
  if (item >= point_count * blocks) return;
  const ulong at = (ulong)item * VEC;
  const ShadingPoint p = load_shading_point(surface, total_points, order[first_point + item / blocks]);
  const Scatterer s = scatterer_of(&p);
  for (uint channel = 0; channel < 3; ++channel) STORE((real)0.0f, radiance + channel * (ulong)capacity + at);

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
  whole alive = (largest_of(ray.throughput) > 0.0f) && (LANE_NUMBER + (item % blocks) * VEC < sample_count);
  /* Of use at depth 2 is only what could have found a light. */
  const uint last_of_use = HAS_EMISSION ? 1u : 2u;
  if (max_depth <= last_of_use) alive = alive && (ray.density > 0.0f);
  append_rays(&ray, alive, 0, plane, wave);
}

triple gather_triple(global const float *restrict record, const whole at) {
  return (triple){gather(record, at), gather(record, at + 1), gather(record, at + 2)};
}

triple sum_of(const triple a, const triple b, const real factor) {
  return (triple){FMA(factor, b.x, a.x), FMA(factor, b.y, a.y), FMA(factor, b.z, a.z)};
}

triple turned(const triple t, const whole turn) {
  return (triple){SELECT(t.x, -t.x, turn), SELECT(t.y, -t.y, turn), SELECT(t.z, -t.z, turn)};
}

triple load_planes(global const float *restrict wave, const uint number, const uint plane, const uint first) {
  return (triple){LOAD(PLANE(wave, number) + first), LOAD(PLANE(wave, number + 1) + first),
                  LOAD(PLANE(wave, number + 2) + first)};
}

/* Where rays hit. The position along the ray is moved onto the triangle's plane, for the offset to suffice. */
void load_hit(global const float *restrict triangles, const whole at, const triple along, const real b1, const real b2,
              const triple outgoing, triple *position, triple *geometric_normal, Scatterer *s) {
  const triple own = gather_triple(triangles, at);
  const real above = dot_triple(own, along) - gather(triangles, at + 3);
  *position = sum_of(along, own, -above);
  *geometric_normal = turned(own, dot_triple(own, outgoing) < 0.0f);
  s->normal = *geometric_normal;
  s->outgoing = outgoing;
  s->albedo = gather_triple(triangles, at + 6);
#if HAS_SPECULAR
  s->reflectance = gather_triple(triangles, at + AT_REFLECTANCE);
  s->roughness = gather(triangles, at + AT_REFLECTANCE + 3);
#endif
#if HAS_NORMALS
  const whole smooth = gather(triangles, at + 4) < 0.0f;
  if (ANY(smooth)) {
    const triple corner0 = gather_triple(triangles, at + AT_NORMALS);
    const triple corner1 = gather_triple(triangles, at + AT_NORMALS + 3);
    const triple corner2 = gather_triple(triangles, at + AT_NORMALS + 6);
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
#else
  (void)b1;
  (void)b2;
#endif
}

void add_radiance(const triple throughput, const real amount[3], const bits path, const whole here,
                  const ulong capacity, global float *restrict radiance) {
  float added[3][VEC];
  int is_here[VEC];
  uint name[VEC];
  STORE(throughput.x * amount[0], added[0]);
  STORE(throughput.y * amount[1], added[1]);
  STORE(throughput.z * amount[2], added[2]);
  STORE(here, is_here);
  STORE(path, name);
  for (uint lane = 0; lane < VEC; ++lane)
    if (is_here[lane] != 0)
      for (uint channel = 0; channel < 3; ++channel)
        radiance[channel * capacity + name[lane]] += added[channel][lane];
}

/* Rays of `bounce` (the first is 1) and their hits. */
kernel void shade_hits(const uint count, const uint capacity, const uint max_depth, const uint bounce,
                       const uint first_point, const uint first_sample, const uint stride, const float inverse_stride,
                       const uint stream, const uint seed_low, const uint seed_high, global const uint *restrict order,
                       global const float *restrict triangles, global const float *restrict lights,
                       global const float *restrict guide_frame, global const uint *restrict guide,
                       global const float *restrict guide_mean, global uint *restrict guide_place,
                       const uint plane, global const float *restrict wave, global float *restrict radiance,
                       const uint next_plane, global float *restrict next_wave) {
  const uint first = (uint)get_global_id(0) * VEC;
  if (first >= count) return;
  const whole here = LANE_NUMBER + first < (bits)count;
  const whole triangle = SELECT((whole)(-1), AS_WHOLE(LOAD(PLANE(wave, HIT) + first)), here);
  const whole at = max(triangle, (whole)0) * TRIANGLE_FLOATS;
  const triple origin = load_planes(wave, NEXT_RAY, plane, first);
  const triple direction = load_planes(wave, NEXT_RAY + 3, plane, first);
  const triple outgoing = {-direction.x, -direction.y, -direction.z};
  const real distance = LOAD(PLANE(wave, HIT + 3) + first);
  Ray ray;
  ray.throughput = load_planes(wave, NEXT_STATE, plane, first);
  /* What a lane past the last ray finds there may be of a larger batch. */
  ray.path = SELECT((bits)0, AS_BITS(LOAD(PLANE(wave, NEXT_STATE + 4) + first)), here);
  const whole light = TO_WHOLE(gather(triangles, at + 5));
  const whole met = triangle >= 0;

  /* A light ends the path. What it adds is weighted by how else it could have been found. */
  const whole on_light = met && (light >= 0);
  if (ANY(on_light)) {
    const real density = LOAD(PLANE(wave, NEXT_STATE + 3) + first);
    const whole record = max(light, (whole)0) * LIGHT_FLOATS;
    const triple normal = gather_triple(lights, record + 9);
    const real emitted = dot_triple(normal, outgoing);
    const real facing = SELECT(emitted, fabs(emitted), gather(lights, record + 17) > 0.0f);
    const real shared = gather(lights, record + 19);
    const real other = distance * distance * shared / max(facing, (real)1e-20f);
    const real weight = shared * density / (density + other);
    real amount[3];
    for (int channel = 0; channel < 3; ++channel) amount[channel] = weight * gather(lights, record + 12 + channel);
    add_radiance(ray.throughput, amount, ray.path, on_light && (facing > 0.0f) && (density > 0.0f), capacity, radiance);
  }
  const whole on_surface = met && (light < 0);
  triple position, geometric_normal;
  Scatterer s;
  load_hit(triangles, at, sum_of(origin, direction, distance), LOAD(PLANE(wave, HIT + 1) + first),
           LOAD(PLANE(wave, HIT + 2) + first), outgoing, &position, &geometric_normal, &s);
#if HAS_EMISSION
  const triple emission = gather_triple(triangles, at + AT_EMISSION);
  const real glow[3] = {emission.x, emission.y, emission.z};
  add_radiance(ray.throughput, glow, ray.path, on_surface && (largest_of(emission) > 0.0f), capacity, radiance);
#endif
  /* This bounce's surfaces are lit at depth bounce + 2, and rays that leave them find light of that depth. */
  if (bounce + 2 > max_depth) return;
  whole both_ways = on_surface;
  /* For the last of them a ray that finds light is worth while only if there is a lobe. */
  const uint reach = HAS_EMISSION ? bounce + 2 : bounce + 3;
  if (reach > max_depth) both_ways = both_ways && is_shiny(&s);
  ray.origin = sum_of(position, geometric_normal, fabs(gather(triangles, at + 4)));
  /* The path's sample: of which point, and which of its samples. */
  /* Vectors of integers are divided one by one; places are below 2^22, so this quotient is exact. */
  const bits slot = TO_BITS((TO_REAL(ray.path) + 0.5f) * inverse_stride);
  const bits index = ray.path - slot * stride + first_sample;
  const bits point = gather_bits(order, slot + first_point);
  real coordinates[5];
  sample_nested(point, index, stream, bounce, seed_low, seed_high, coordinates);

  const LightSample found = sample_lights(lights, position, ray.origin, coordinates[0], coordinates[1]);
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
  append_rays(&shadow, lit && (largest_of(shadow.throughput) > 0.0f), 1, next_plane, next_wave);

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
    /* What a cell is known to receive is counted in any case, and roulette decides on the difference alone:
     * c + (R - c) / survival or c, whose expectation is R whatever c. */
    const whole known = cell * GUIDE_CHANNELS;
    const real kept = 1.0f - SELECT((real)0.0f, scale_up, survives);
    const real expected[3] = {kept * gather(guide_mean, known), kept * gather(guide_mean, known + 1),
                              kept * gather(guide_mean, known + 2)};
    add_radiance(ray.throughput, expected, ray.path, alive && matte, capacity, radiance);
#endif
    alive = survives;
    ray.throughput.x *= scale_up;
    ray.throughput.y *= scale_up;
    ray.throughput.z *= scale_up;
  }
  /* After roulette, which goes by how bright the surface is, and not by how likely the direction was. Light that the
   * ray finds is weighted as if it had not been guided: weights have to sum to one, no more. */
  ray.throughput.x *= inverse_guide;
  ray.throughput.y *= inverse_guide;
  ray.throughput.z *= inverse_guide;
  append_rays(&ray, alive && (largest_of(ray.throughput) > 0.0f), 0, next_plane, next_wave);
}

kernel void add_lit(const uint count, const uint capacity, const uint plane, global const float *restrict wave,
                    global float *restrict radiance) {
  const uint ray = (uint)get_global_id(0);
  if (ray >= count || ((global const uchar *)PLANE(wave, LIT))[ray] == 0) return;
  const uint path = as_uint(PLANE(wave, SHADOW_STATE + 3)[ray]);
  for (uint channel = 0; channel < 3; ++channel)
    radiance[channel * (ulong)capacity + path] += PLANE(wave, SHADOW_STATE + channel)[ray];
}

/* `most` caps what a path brings, by its largest channel. */
kernel void finish_paths(const uint count, const uint capacity, const float most, global const uint *restrict slot,
                         global const uchar *restrict visible, global const float *restrict radiance,
                         global float *restrict value) {
  const uint at = (uint)get_global_id(0) * VEC;
  if (at >= count) return;
  const real seen = load_visibility(slot, visible, at);
  const triple brought = {LOAD(radiance + at), LOAD(radiance + capacity + at), LOAD(radiance + 2 * (ulong)capacity + at)};
  const real largest = largest_of(brought);
  const real scale = SELECT((real)1.0f, (real)most / largest, largest > most);
  STORE(FMA(LOAD(value + at), seen, brought.x * scale), value + at);
  STORE(FMA(LOAD(value + count + at), seen, brought.y * scale), value + count + at);
  STORE(FMA(LOAD(value + 2 * (ulong)count + at), seen, brought.z * scale), value + 2 * (ulong)count + at);
}
