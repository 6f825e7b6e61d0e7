/* Direct light: F(p) = integral over all area lights of f_r L_e G V dA, and over the environment of f_r L V cos dw.
 *
 * (u, v) is a point on a light, see lights.cl, whose records are the integrand_data, or a direction, see environment.cl. Where the surface has a lobe, a strip
 * of the square is directions of the lobe, see lobe.cl.
 *
 * Work-group contract: none; pure functions of private values.
 */

void evaluate_integrand(const ShadingPoint *p, global const float *restrict integrand_data, const real u,
                        const real v, real value[CHANNELS], real direction[3], real *distance) {
  const Scatterer s = scatterer_of(p);
#if HAS_SPECULAR
  const LightSample light = sample_lights_and_lobe(integrand_data, p, &s, u, v);
#else
  const LightSample light =
      sample_emitters(integrand_data, strips_at(integrand_data, p), to_triple(p->position), to_triple(ray_origin(p)), u, v);
#endif
  const real cosine = dot_triple(s.normal, light.towards);
  const whole lit =
      light.lit && (cosine > 0.0f) && (dot_triple(to_triple(p->geometric_normal), light.towards) > 0.0f);
  real f_r[3];
  scattering(&s, light.towards, f_r);
  for (int channel = 0; channel < CHANNELS; ++channel)
    value[channel] = SELECT((real)0.0f, f_r[channel] * cosine * light.radiance[channel], lit);
  /* The direction is not normalised: it ends on the light, at distance 1. */
  direction[0] = light.segment.x;
  direction[1] = light.segment.y;
  direction[2] = light.segment.z;
  *distance = (real)1.0f;
}
