/* Global illumination, the part that one ray decides: direct light, as in direct.cl.
 *
 * (u, v) is at once a point on a light (lights.cl, whose records are the integrand_data) and, in paths.cl, the
 * direction of the first bounce: the sum of two integrals over one square is one integral. Where the surface
 * has a lobe, and in scenes with an environment, light is found in both ways, each weighted by the balance heuristic
 * (Veach 1997); elsewhere by its points alone. Rays that find lights remember which strips the point had. Without DIRECT nothing is left here.
 *
 * Work-group contract: none; pure functions of private values.
 */

void evaluate_integrand(const ShadingPoint *p, global const float *restrict integrand_data, const real u,
                        const real v, real value[CHANNELS], real direction[3], real *distance) {
  *distance = (real)1.0f;
#if DIRECT
  const Scatterer s = scatterer_of(p);
  const LightSample light =
      sample_emitters(integrand_data, strips_at(integrand_data, p), to_triple(p->position), to_triple(ray_origin(p)), u, v);
  const real cosine = dot_triple(s.normal, light.towards);
  const whole lit =
      light.lit && (cosine > 0.0f) && (dot_triple(to_triple(p->geometric_normal), light.towards) > 0.0f);
  real f_r[3];
  scattering(&s, light.towards, f_r);
  real scale = cosine;
#if HAS_SPECULAR || HAS_ENVIRONMENT
#if HAS_ENVIRONMENT
  const whole both_ways = (whole)(-1);
#else
  const whole both_ways = s.reflectance.x + s.reflectance.y + s.reflectance.z > 0.0f;
#endif
  const real weight = light.density / (light.density + scattering_density(&s, light.towards));
  scale *= SELECT((real)1.0f, weight, both_ways);
#endif
#if HAS_GLASS
  scale = SELECT(scale, cosine * glass_light_weight(&s, light.towards, light.density, 1), is_glass(&s));
#endif
  for (int channel = 0; channel < CHANNELS; ++channel)
    value[channel] = SELECT((real)0.0f, f_r[channel] * scale * light.radiance[channel], lit);
  direction[0] = light.segment.x;
  direction[1] = light.segment.y;
  direction[2] = light.segment.z;
#else
  (void)p;
  (void)integrand_data;
  (void)u;
  (void)v;
  for (int channel = 0; channel < CHANNELS; ++channel) value[channel] = (real)0.0f;
  for (int axis = 0; axis < 3; ++axis) direction[axis] = (real)0.0f;
#endif
}
