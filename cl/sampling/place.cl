/* What is kept of the place where a path that points share first hits a surface.
 *
 * Memory layout: `hits` has a plane of `places` floats a number of SHARED in share.py, and three more a slot of a path's
 * sums: which part of what is in it the place's albedo scattered, rather than its lobe.
 *
 * Joined after vertex.cl.
 *
 * Work-group contract: none; each writes what is kept of VEC paths.
 */

/* Sums of what a path brings: one a branch, and one of light that comes straight to a first hit with a lobe. */
#define SLOTS (BRANCHES + (SHARED && HAS_SPECULAR ? 1 : 0))

#if SHARED
#define HIT_PLANE(number) (hits + (number) * (ulong)places)
#if HAS_SPECULAR
#define KEPT (SHARED_REFLECTANCE + 3)
/* The matte part of what is in a slot of the path's sums, a number a channel. */
#define MATTE_PLANE(slot, channel) HIT_PLANE(SHARED_FLOATS + 3 * (slot) + (channel))
#else
#define KEPT SHARED_REFLECTANCE
#endif

/* Whether surfaces are the same from everywhere, but for a lobe. Not where a normal is the triangle's own because the
 * interpolated one, or a bent one, faces away from where it was seen. */
whole looks_alike(global const float *restrict triangles, const whole at, const triple geometric_normal,
                  const Scatterer *s) {
  whole alike = (whole)(-1);
#if HAS_SPECULAR && HAS_EMISSION
  /* What it emits has no slot of its own. */
  alike = !is_shiny(s);
#endif
#if HAS_NORMALS
  const whole own = (s->normal.x == geometric_normal.x) && (s->normal.y == geometric_normal.y) &&
                    (s->normal.z == geometric_normal.z);
  alike = alike && !(own && (gather(triangles, at + TRIANGLE_OFFSET) < 0.0f));
#endif
#if HAS_NORMAL_MAPS
  alike = alike && (gather(triangles, at + TRIANGLE_NORMAL_TEXTURE) < 0.0f);
#endif
  (void)triangles, (void)at, (void)geometric_normal, (void)s;
  return alike;
}

/* The first hits of VEC paths. Shared are those `here`. */
void keep_hit(const triple position, const triple geometric_normal, const Scatterer *s, const real offset,
              const whole here, const bits path, const uint places, global float *restrict hits) {
  const real numbers[KEPT] = {offset, position.x, position.y, position.z, geometric_normal.x, geometric_normal.y,
                              geometric_normal.z, s->normal.x, s->normal.y, s->normal.z
#if HAS_SPECULAR
                              , s->reflectance.x, s->reflectance.y, s->reflectance.z
#endif
  };
  float number[KEPT][VEC];
  uint name[VEC];
  int is_here[VEC];
#pragma unroll
  for (uint row = 0; row < KEPT; ++row) STORE(numbers[row], number[row]);
  STORE(path, name);
  STORE(here, is_here);
  for (uint lane = 0; lane < VEC; ++lane)
    if (is_here[lane] != 0)
#pragma unroll
      for (uint row = 0; row < KEPT; ++row) HIT_PLANE(row)[name[lane]] = number[row][lane];
}

#if HAS_SPECULAR
/* What the surface takes from its albedo on a light's way in or out, a channel. */
real left_by_lobe(const real f0, const real weight) {
  return 1.0f - SELECT((real)0.0f, f0 + (1.0f - f0) * weight, f0 > 0.0f);
}

/* Of light that comes to a first hit along `towards` and goes into a slot of the path's sums: what its albedo scatters,
 * but for what is lost on the way out, over all that it scatters. */
void keep_matte(const Scatterer *s, const triple towards, const uint slot, const whole here, const bits path,
                const uint places, global float *restrict hits) {
  real f_r[3];
  scattering(s, towards, f_r);
  const real weight = schlick_weight(dot_triple(s->normal, towards));
  const real matte[3] = {s->albedo.x * left_by_lobe(s->reflectance.x, weight),
                         s->albedo.y * left_by_lobe(s->reflectance.y, weight),
                         s->albedo.z * left_by_lobe(s->reflectance.z, weight)};
  uint name[VEC];
  int is_here[VEC];
  STORE(path, name);
  STORE(here, is_here);
#pragma unroll
  for (uint channel = 0; channel < 3; ++channel) {
    float part[VEC];
    STORE(SELECT((real)0.0f, matte[channel] * M_1_PI_F / f_r[channel], f_r[channel] > 0.0f), part);
    for (uint lane = 0; lane < VEC; ++lane)
      if (is_here[lane] != 0) MATTE_PLANE(slot, channel)[name[lane]] = part[lane];
  }
}
#endif
#endif
