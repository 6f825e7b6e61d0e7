/* The surface's scattering: Lambert below a GGX specular lobe, VEC incident directions at a time.
 *
 *   f_r = albedo / pi * (1 - F(cos_i)) * (1 - F(cos_o)) + D * G2 * F(h . o) / (4 cos_i cos_o)
 *
 * F is Schlick's approximation from the reflectance at normal incidence, D and the height-correlated
 * G2 are GGX with alpha = roughness^2 (Walter et al. 2007; Heitz 2014, eq. 99). The diffuse factor is
 * symmetric, so the sum is reciprocal, and it takes from Lambert what the lobe reflects, so no
 * direction reflects more than it receives. No reflectance means no lobe: plain Lambert.
 *
 * With HAS_GLASS some surfaces are dielectrics, whose `eta` is not 0: the index of refraction behind the surface over
 * that on the viewer's side, or its negative for thin panes, whose both sides are one surface. Of these only what they
 * reflect is here, by Fresnel's equations and Walter's separable masking; dielectric.cl has the rest.
 *
 * Every lane has a surface of its own (Scatterer), which may be one shading point's for all of them.
 *
 * Work-group contract: none; pure functions of private values.
 */

typedef struct {
  triple normal;   /* shading normal, unit, on the viewer's side */
  triple outgoing; /* unit, towards the viewer */
  triple albedo;
  triple reflectance; /* at normal incidence */
  real roughness;
#if HAS_GLASS
  real eta;
#endif
} Scatterer;

Scatterer scatterer_of(const ShadingPoint *p) {
  return (Scatterer){to_triple(p->normal), to_triple(p->outgoing), to_triple(p->albedo),
                     to_triple(p->reflectance), (real)p->roughness
#if HAS_GLASS
                     , (real)p->eta
#endif
  };
}

real schlick_weight(const real cosine) {
  const real m = clamp(1.0f - cosine, (real)0.0f, (real)1.0f);
  const real m2 = m * m;
  return m2 * m2 * m;
}

/* D for a half vector that is `inverse` times `sum`. */
real microfacet_density(const Scatterer *s, const triple sum, const real inverse) {
  const real cosine_h = clamp(dot_triple(s->normal, sum) * inverse, (real)0.0f, (real)1.0f);
  const real alpha = s->roughness * s->roughness;
  const real alpha2 = alpha * alpha;
  /* 1 + cos^2 (alpha^2 - 1) as alpha^2 cos^2 + sin^2, the sine from a cross product: nothing cancels,
   * however narrow the lobe. */
  const real sine_x = s->normal.y * sum.z - s->normal.z * sum.y;
  const real sine_y = s->normal.z * sum.x - s->normal.x * sum.z;
  const real sine_z = s->normal.x * sum.y - s->normal.y * sum.x;
  const real slope = alpha2 * cosine_h * cosine_h +
                     (sine_x * sine_x + sine_y * sine_y + sine_z * sine_z) * inverse * inverse;
  return alpha2 / (M_PI_F * slope * slope);
}

/* cos_a sqrt(alpha^2 + (1 - alpha^2) cos_b^2): masking of b, times cos_a. */
real masking(const Scatterer *s, const real cosine_a, const real cosine_b) {
  const real alpha = s->roughness * s->roughness;
  const real alpha2 = alpha * alpha;
  return cosine_a * sqrt(alpha2 + (1.0f - alpha2) * cosine_b * cosine_b);
}

#if HAS_GLASS
whole is_glass(const Scatterer *s) { return s->eta != 0.0f; }

/* What a dielectric reflects at this cosine on the viewer's side, unpolarised: an interface, or a pane by all
 * reflections between its sides, R + T^2 R (1 + R^2 + ...) = 2 R / (1 + R). */
real glass_reflectance(const Scatterer *s, const real cosine) {
  const real eta = fabs(s->eta);
  const real c = clamp(cosine, (real)0.0f, (real)1.0f);
  const real sine2 = (1.0f - c * c) / (eta * eta);
  const real inner = sqrt(max((real)0.0f, 1.0f - sine2));
  const real across = (c - eta * inner) / (c + eta * inner);
  const real along = (eta * c - inner) / (eta * c + inner);
  const real one = SELECT(0.5f * (across * across + along * along), (real)1.0f, sine2 >= 1.0f);
  return SELECT(one, 2.0f * one / (1.0f + one), s->eta < 0.0f);
}

/* Smith's masking of one direction: 1 / (1 + lambda). */
real masked_once(const Scatterer *s, const real cosine) {
  return 2.0f * cosine / (cosine + masking(s, (real)1.0f, cosine));
}
#endif

/* One channel of f_r. */
real scattered(const real albedo, const real f0, const real lobe, const real weight_h, const real weight_i,
               const real weight_o) {
  const real has_lobe = SELECT((real)0.0f, (real)1.0f, f0 > 0.0f);
  const real below_i = 1.0f - has_lobe * (f0 + (1.0f - f0) * weight_i);
  const real below_o = 1.0f - has_lobe * (f0 + (1.0f - f0) * weight_o);
  return albedo * M_1_PI_F * below_i * below_o + has_lobe * (f0 + (1.0f - f0) * weight_h) * lobe;
}

/* f_r for VEC unit directions. With HAS_SPECULAR it is zero below the shading normal; without, callers
 * multiply by a cosine that is. */
void scattering(const Scatterer *s, const triple incident, real f_r[3]) {
#if HAS_SPECULAR
  const real cosine_i = dot_triple(s->normal, incident);
  const real cosine_o = max(dot_triple(s->normal, s->outgoing), (real)1e-6f);
  const real guarded_i = max(cosine_i, (real)1e-6f);
  const triple sum = {incident.x + s->outgoing.x, incident.y + s->outgoing.y, incident.z + s->outgoing.z};
  const real inverse = rsqrt(max(dot_triple(sum, sum), (real)1e-20f));
  /* G2 / (4 cos_i cos_o) = 1 / (2 lambda). */
  const real lambda = masking(s, guarded_i, cosine_o) + masking(s, cosine_o, guarded_i);
  const real lobe = microfacet_density(s, sum, inverse) * 0.5f / lambda;
  const real weight_h = schlick_weight(dot_triple(s->outgoing, sum) * inverse);
  const real weight_i = schlick_weight(guarded_i);
  const real weight_o = schlick_weight(cosine_o);
  f_r[0] = scattered(s->albedo.x, s->reflectance.x, lobe, weight_h, weight_i, weight_o);
  f_r[1] = scattered(s->albedo.y, s->reflectance.y, lobe, weight_h, weight_i, weight_o);
  f_r[2] = scattered(s->albedo.z, s->reflectance.z, lobe, weight_h, weight_i, weight_o);
#if HAS_GLASS
  const real reflected = glass_reflectance(s, dot_triple(s->outgoing, sum) * inverse) *
                         microfacet_density(s, sum, inverse) * masked_once(s, cosine_o) * masked_once(s, guarded_i) /
                         (4.0f * cosine_o * guarded_i);
  for (int channel = 0; channel < 3; ++channel) f_r[channel] = SELECT(f_r[channel], reflected, is_glass(s));
#endif
  for (int channel = 0; channel < 3; ++channel)
    f_r[channel] = SELECT((real)0.0f, f_r[channel], cosine_i > 0.0f);
#else
  /* Lambert looks the same from everywhere. */
  (void)incident;
  f_r[0] = s->albedo.x * M_1_PI_F;
  f_r[1] = s->albedo.y * M_1_PI_F;
  f_r[2] = s->albedo.z * M_1_PI_F;
#endif
}
