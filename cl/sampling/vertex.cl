/* What happens where a path reaches a surface: what the surface is, what a light gives that it reached instead, and the
 * path's next ray.
 *
 * `triangles`: records of triangles.py. With HAS_SPECULAR they have reflectance and roughness, with HAS_EMISSION
 * emission, with HAS_NORMALS the corners' normals, with HAS_TEXTURES and HAS_COLOURS what is interpolated for
 * textures.cl and between the corners' colours. Both sides are alike.
 *
 * Joined after environment.cl, textures.cl, guide.cl and wave.cl.
 *
 * Work-group contract: none; pure functions of private values, VEC paths at a time.
 */

/* VEC rays of a wave. Lanes past the last ray may hold what earlier, larger batches left there, whose planes may have
 * had another size: any bits at all, of which no place of a table is to be made. */
Ray load_ray(global const float *restrict wave, const uint plane, const uint first, const whole here,
             global const float *restrict lights) {
  Ray ray;
  const triple zero = {(real)0.0f, (real)0.0f, (real)0.0f};
  ray.origin = select_triple(zero, load_planes(wave, WAVE_ORIGIN, plane, first), here);
  ray.direction = select_triple(zero, load_planes(wave, WAVE_DIRECTION, plane, first), here);
  ray.throughput = load_planes(wave, WAVE_THROUGHPUT, plane, first);
  ray.path = SELECT((bits)0, AS_BITS(LOAD(PLANE(wave, WAVE_PATH) + first)), here);
  ray.density = LOAD(PLANE(wave, WAVE_DENSITY) + first);
#if HAS_ROWS
  (void)lights;
  ray.strips = SELECT((whole)FIRST_ROW, AS_WHOLE(LOAD(PLANE(wave, WAVE_STRIPS) + first)), here);
#else
  ray.strips = all_strips(lights);
#endif
#if HAS_PANES
  ray.behind = LOAD(PLANE(wave, WAVE_BEHIND) + first);
  ray.passed = SELECT((real)0.0f, LOAD(PLANE(wave, WAVE_PASSED) + first), here);
#endif
  return ray;
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

real mean_of(const triple t) { return (t.x + t.y + t.z) * (1.0f / 3.0f); }

whole is_shiny(const Scatterer *s) {
#if HAS_GLASS
  return is_glass(s) || (s->reflectance.x + s->reflectance.y + s->reflectance.z > 0.0f);
#elif HAS_SPECULAR
  return s->reflectance.x + s->reflectance.y + s->reflectance.z > 0.0f;
#else
  (void)s;
  return (whole)0;
#endif
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
#if HAS_GLASS
  /* As relative_index. */
  const real ior = gather(triangles, at + TRIANGLE_IOR);
  s->eta = SELECT(ior, 1.0f / max(ior, (real)1e-3f), (ior > 0.0f) && (dot_triple(own, outgoing) < 0.0f));
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

/* a + b where `here`. */
triple sum_where(const triple a, const triple b, const whole here) {
  return (triple){SELECT(a.x, a.x + b.x, here), SELECT(a.y, a.y + b.y, here), SELECT(a.z, a.z + b.z, here)};
}

/* How much counts what a ray finds on the light of a record, by how else that could have been found: nothing from behind,
 * and where the ray's `density` is 0. */
real light_weight(global const float *restrict lights, const whole strips, const whole record, const triple origin,
                  const triple direction, const real distance, const real density) {
  const real emitted = -dot_triple(light_triple(lights, record, LIGHT_NORMAL), direction);
  const real facing = SELECT(emitted, fabs(emitted), light_number(lights, record, LIGHT_TWO_SIDED) > 0.0f);
  const triple segment = {distance * direction.x, distance * direction.y, distance * direction.z};
  const real other = lights_share(lights, strips) *
                     light_density(lights, strips, record, origin, segment, max(facing, (real)1e-20f));
  const real share = density / (density + other);
#if HAS_BALLS
  const triple centre = light_triple(lights, record, LIGHT_CORNER);
  const triple begin = {centre.x - origin.x, centre.y - origin.y, centre.z - origin.z};
  const real radius = light_number(lights, record, LIGHT_LENGTH);
  const whole ball = light_number(lights, record, LIGHT_SHAPE) == (float)SHAPE_BALL;
  const whole shines = SELECT(facing > 0.0f, dot_triple(begin, begin) > radius * radius, ball);
#else
  const whole shines = facing > 0.0f;
#endif
  return SELECT((real)0.0f, share, shines && (density > 0.0f));
}

/* What a ray that hits a light finds there, so weighted. */
triple light_met(global const float *restrict lights, const whole strips, const whole light, const triple origin,
                 const triple direction, const real distance, const real density) {
  const whole record = max(light, (whole)0) * LIGHT_FLOATS;
  real weight = light_weight(lights, strips, record, origin, direction, distance, density);
#if HAS_BALLS
  const triple centre = light_triple(lights, record, LIGHT_CORNER);
  const triple begin = {centre.x - origin.x, centre.y - origin.y, centre.z - origin.z};
  weight *= SELECT((real)1.0f, beam_share(lights, record, begin),
                   light_number(lights, record, LIGHT_SHAPE) == (float)SHAPE_BALL);
#endif
  const triple amount = light_triple(lights, record, LIGHT_RADIANCE);
  return (triple){weight * amount.x, weight * amount.y, weight * amount.z};
}

triple scaled(const triple t, const real factor) { return (triple){t.x * factor, t.y * factor, t.z * factor}; }

/* From a surface that a path has reached to its next ray, by a point (u, v) of the square and a third number for
 * roulette; returns which lanes go on. */
whole next_ray(const Scatterer *s, const triple geometric_normal, const whole cell, const uint bounce,
               global const uint *restrict guide, global const float *restrict guide_known, const real square_u,
               const real square_v, real chance, const whole reached, Ray *ray, triple *brought) {
  real u = square_u;
  real v = square_v;
#if GUIDED
  const whole matte = !is_shiny(s);
  const real guided = guide_square(guide, cell, &u, &v);
  const real inverse_guide = SELECT((real)1.0f, guided, matte);
  u = SELECT(square_u, u, matte);
  v = SELECT(square_v, v, matte);
#else
  (void)cell;
  (void)guide;
  (void)guide_known;
  (void)brought;
#endif
  ray->direction = sample_scattering(s, u, v);
  ray->density = scattering_density(s, ray->direction);
  triple worth = bounce_throughput(s, geometric_normal, ray->direction, ray->density);
#if HAS_GLASS
  const whole glass = is_glass(s);
  real inside = (real)1.0f;
  if (ANY(glass)) {
    real choice = chance;
    const GlassRay own = sample_glass(s, geometric_normal, square_u, square_v, &choice, 0);
    ray->direction = select_triple(ray->direction, own.direction, glass);
    worth = select_triple(worth, own.throughput, glass);
    ray->density = SELECT(ray->density, own.density, glass);
    chance = SELECT(chance, choice, glass);
    /* Where paths go on in the denser medium their throughput is that much smaller, and what they bring is not. */
    const real eta = SELECT((real)1.0f, s->eta, s->eta > 0.0f);
    inside = SELECT((real)1.0f, max(eta * eta, 1.0f / (eta * eta)), own.passes != (eta < 1.0f));
  }
#endif
  ray->throughput = product(ray->throughput, worth);
  whole alive = reached && (largest_of(ray->throughput) > 0.0f);
  if (bounce >= ROULETTE_BOUNCE) {
#if GUIDED
    /* How far what is ended may be from what stands for it, in what paths usually bring. */
    const whole known = cell * KNOWN_FLOATS;
    const real need = gather(guide_known, known + KNOWN_NEED) * mean_of(ray->throughput);
    real survival = clamp(ROULETTE_SCALE * need, (real)LEAST_SURVIVE, (real)MOST_SURVIVE);
#else
    real survival = min(ROULETTE_SCALE * largest_of(ray->throughput), (real)MOST_SURVIVE);
#endif
#if HAS_GLASS
    const real of_glass = min(GLASS_ROULETTE_SCALE * inside * largest_of(ray->throughput), (real)MOST_SURVIVE);
    survival = SELECT(survival, of_glass, glass);
#endif
    const whole survives = alive && (chance < survival);
    const real scale_up = 1.0f / max(survival, (real)1e-20f);
#if GUIDED
    /* With R the radiance of the rest of the path and c the cell's mean: c is added in any case, and
     * roulette decides on the difference alone. The sum is c + (R - c) / survival or c, with expectation
     * R for every c. */
    const real kept = 1.0f - SELECT((real)0.0f, scale_up, survives);
    const triple expected = scaled(gather_triple(guide_known, known + KNOWN_MEAN), kept);
    *brought = sum_where(*brought, product(ray->throughput, expected), alive && matte);
#endif
    alive = survives;
    ray->throughput = scaled(ray->throughput, scale_up);
  }
#if GUIDED
  /* After roulette, which depends on the surface's throughput and not on the density of the direction.
   * The MIS weight of light that the ray finds is that of an unguided ray: weights need only sum to
   * one. */
  ray->throughput = scaled(ray->throughput, inverse_guide);
#endif
  return alive && (largest_of(ray->throughput) > 0.0f);
}

/* x moved on by a part of the unit interval, from whose end it goes on at its beginning. */
real moved_on(const real x, const float part) {
  const real moved = x + part;
  return min(moved - SELECT((real)0.0f, (real)1.0f, moved >= 1.0f), (real)BELOW_ONE);
}

#if HAS_GLASS
/* Where rays begin that leave a surface, `offset` off it, on the side of their direction. */
triple leaving_from(const triple position, const triple normal, const real offset, const triple direction) {
  return sum_of(position, normal, SELECT(-offset, offset, dot_triple(normal, direction) > 0.0f));
}

/* A path's first ray from a point of glass. Without DIRECT the light that it reflects is estimated apart. */
void enter_glass(const Scatterer *s, const ShadingPoint *p, const real u, const real v, Ray *ray) {
  const triple normal = to_triple(p->geometric_normal);
  real none = (real)0.0f;
  const GlassRay own = sample_glass(s, normal, u, v, &none, 1);
  ray->direction = own.direction;
  ray->throughput = own.throughput;
  ray->density = SELECT(DIRECT ? own.density : (real)0.0f, own.density, own.passes);
  ray->origin = leaving_from(to_triple(p->position), normal, (real)p->offset, own.direction);
#if HAS_PANES
  ray->passed = SELECT((real)0.0f, (real)1.0f, own.passes && (s->eta < 0.0f));
#endif
}
#endif

#if HAS_PANES
/* A ray that goes through a pane stays what it was `before`: of the same surface, whose sampling of lights has seen
 * through the pane too. Returns which lanes go on: what a pane reflects only while it `is_lit`. */
whole past_panes(const Scatterer *s, const Ray *before, const whole is_lit, const triple normal, Ray *next) {
  const whole passes = (s->eta < 0.0f) && (dot_triple(normal, next->direction) < 0.0f);
  next->density = SELECT(next->density, before->density, passes);
  next->strips = SELECT(next->strips, before->strips, passes);
  next->behind = SELECT((real)0.0f, before->behind, passes);
  next->passed = before->passed + SELECT((real)0.0f, (real)1.0f, passes);
  return passes || is_lit;
}
#endif
/* What all branches of the paths at `places` brought to a place. */
float branch_sum(global const float *restrict first, const uint places) {
  float sum = first[0];
  for (uint branch = 1; branch < BRANCHES; ++branch) sum += first[branch * (ulong)places * RADIANCE_FLOATS];
  return sum;
}
