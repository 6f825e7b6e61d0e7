/* What happens where a path reaches a surface: what the surface is, what a light gives that it reached instead, and the
 * path's next ray.
 *
 * `triangles`: records of triangles.py. With HAS_SPECULAR they have reflectance and roughness, with HAS_EMISSION
 * emission, with HAS_NORMALS the corners' normals, with HAS_TEXTURES and HAS_COLOURS what is interpolated for
 * textures.cl and between the corners' colours. Both sides are alike.
 *
 * Joined after lights.cl, textures.cl, guide.cl and wave.cl.
 *
 * Work-group contract: none; pure functions of private values, VEC paths at a time.
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

real mean_of(const triple t) { return (t.x + t.y + t.z) * (1.0f / 3.0f); }

whole is_shiny(const Scatterer *s) {
#if HAS_SPECULAR
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

triple scaled(const triple t, const real factor) { return (triple){t.x * factor, t.y * factor, t.z * factor}; }

/* From a surface that a path has reached to its next ray, by a point (u, v) of the square and a third number for
 * roulette; returns which lanes go on. */
whole next_ray(const Scatterer *s, const triple geometric_normal, const whole cell, const uint bounce,
               global const uint *restrict guide, global const float *restrict guide_known, const real square_u,
               const real square_v, const real chance, const whole reached, Ray *ray, triple *brought) {
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
  ray->throughput =
      product(ray->throughput, bounce_throughput(s, geometric_normal, ray->direction, ray->density));
  whole alive = reached && (largest_of(ray->throughput) > 0.0f);
  if (bounce >= ROULETTE_BOUNCE) {
#if GUIDED
    /* How far what is ended may be from what stands for it, in what paths usually bring. */
    const whole known = cell * KNOWN_FLOATS;
    const real need = gather(guide_known, known + KNOWN_NEED) * mean_of(ray->throughput);
    const real survival = clamp(ROULETTE_SCALE * need, (real)LEAST_SURVIVE, (real)MOST_SURVIVE);
#else
    const real survival = min(ROULETTE_SCALE * largest_of(ray->throughput), (real)MOST_SURVIVE);
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

/* What all branches of the paths at `places` brought to a place. */
float branch_sum(global const float *restrict first, const uint places) {
  float sum = first[0];
  for (uint branch = 1; branch < BRANCHES; ++branch) sum += first[branch * (ulong)places * RADIANCE_FLOATS];
  return sum;
}
