/* The surface's scattering: Lambert below a GGX specular lobe, VEC incident directions at a time.
 *
 *   f_r = albedo / pi * (1 - F(cos_i)) * (1 - F(cos_o)) + D * G2 * F(h . o) / (4 cos_i cos_o)
 *
 * F is Schlick's approximation from the reflectance at normal incidence, D and the height-correlated
 * G2 are GGX with alpha = roughness^2 (Walter et al. 2007; Heitz 2014, eq. 99). The diffuse factor is
 * symmetric, so the sum is reciprocal, and it takes from Lambert what the lobe reflects, so no
 * direction reflects more than it receives. No reflectance means no lobe: plain Lambert.
 *
 * Work-group contract: none; pure functions of private values.
 */

real schlick_weight(const real cosine) {
  const real m = clamp(1.0f - cosine, (real)0.0f, (real)1.0f);
  const real m2 = m * m;
  return m2 * m2 * m;
}

/* f_r for VEC unit directions (x, y, z); zero below the shading normal. */
void scattering(const ShadingPoint *p, const real x, const real y, const real z, real f_r[3]) {
  const float albedo[3] = {p->albedo.x, p->albedo.y, p->albedo.z};
#if HAS_SPECULAR
  const float reflectance[3] = {p->reflectance.x, p->reflectance.y, p->reflectance.z};
  const real cosine_i = p->normal.x * x + p->normal.y * y + p->normal.z * z;
  const float cosine_o = fmax(dot(p->normal, p->outgoing), 1e-6f);
  const real guarded_i = max(cosine_i, (real)1e-6f);
  const real sum_x = x + p->outgoing.x;
  const real sum_y = y + p->outgoing.y;
  const real sum_z = z + p->outgoing.z;
  const real inverse = rsqrt(max(sum_x * sum_x + sum_y * sum_y + sum_z * sum_z, (real)1e-20f));
  const real cosine_h =
      clamp((p->normal.x * sum_x + p->normal.y * sum_y + p->normal.z * sum_z) * inverse, (real)0.0f, (real)1.0f);
  const real half_o =
      (p->outgoing.x * sum_x + p->outgoing.y * sum_y + p->outgoing.z * sum_z) * inverse;
  const float alpha = p->roughness * p->roughness;
  const float alpha2 = alpha * alpha;
  /* 1 + cos^2 (alpha^2 - 1) as alpha^2 cos^2 + sin^2, the sine from a cross product: nothing cancels,
   * however narrow the lobe. */
  const real sine_x = p->normal.y * sum_z - p->normal.z * sum_y;
  const real sine_y = p->normal.z * sum_x - p->normal.x * sum_z;
  const real sine_z = p->normal.x * sum_y - p->normal.y * sum_x;
  const real slope = alpha2 * cosine_h * cosine_h +
                     (sine_x * sine_x + sine_y * sine_y + sine_z * sine_z) * inverse * inverse;
  const real distribution = alpha2 / (M_PI_F * slope * slope);
  const real lambda = guarded_i * sqrt(alpha2 + (1.0f - alpha2) * cosine_o * cosine_o) +
                      cosine_o * sqrt(alpha2 + (1.0f - alpha2) * guarded_i * guarded_i);
  /* G2 / (4 cos_i cos_o) = 1 / (2 lambda). */
  const real lobe = distribution * 0.5f / lambda;
  const real weight_h = schlick_weight(half_o);
  const real weight_i = schlick_weight(guarded_i);
  const float weight_o = pown(1.0f - fmin(cosine_o, 1.0f), 5);
  for (int channel = 0; channel < 3; ++channel) {
    const float f0 = reflectance[channel];
    const float has_lobe = f0 > 0.0f ? 1.0f : 0.0f;
    const real below_i = 1.0f - has_lobe * (f0 + (1.0f - f0) * weight_i);
    const float below_o = 1.0f - has_lobe * (f0 + (1.0f - f0) * weight_o);
    const real value = albedo[channel] * M_1_PI_F * below_i * below_o +
                       has_lobe * (f0 + (1.0f - f0) * weight_h) * lobe;
    f_r[channel] = SELECT((real)0.0f, value, cosine_i > 0.0f);
  }
#else
  /* Lambert looks the same from everywhere. */
  (void)x;
  (void)y;
  (void)z;
  for (int channel = 0; channel < 3; ++channel) f_r[channel] = (real)(albedo[channel] * M_1_PI_F);
#endif
}
