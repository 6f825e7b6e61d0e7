/* Ambient occlusion: F(p) = integral over the hemisphere of V(p, w | radius) cos / pi.
 *
 * HEMISPHERE_HEIGHT maps (u, v) to the slides' local hemispherical coordinates, height u and azimuth
 * 2 pi v (density 1 / 2 pi), so the integrand in primary sample space is 2 u V. HEMISPHERE_COSINE maps
 * by Malley's method to a density of cos / pi, and the integrand is V itself.
 *
 * integrand_data: one float, the radius (infinity: unbounded).
 *
 * Work-group contract: none; pure functions of private values.
 */

void evaluate_integrand(const ShadingPoint *p, global const float *restrict integrand_data, const real u,
                        const real v, real value[CHANNELS], real direction[3], real *distance) {
#if HEMISPHERE == HEMISPHERE_HEIGHT
  const real height = u;
  const real radius = sqrt(max((real)0.0f, FMA(-u, u, (real)1.0f)));
  const real unshadowed = 2.0f * u;
#else
  const real height = sqrt(1.0f - u);
  const real radius = sqrt(u);
  const real unshadowed = (real)1.0f;
#endif
  real cosine;
  const real sine = sincos(2.0f * M_PI_F * v, &cosine);
  const real x = radius * cosine;
  const real y = radius * sine;
  float3 tangent, bitangent;
  tangent_frame(p->normal, &tangent, &bitangent);
  direction[0] = x * tangent.x + y * bitangent.x + height * p->normal.x;
  direction[1] = x * tangent.y + y * bitangent.y + height * p->normal.y;
  direction[2] = x * tangent.z + y * bitangent.z + height * p->normal.z;
  *distance = (real)integrand_data[0];
  /* Below the triangle itself nothing can be seen, whatever the shading normal says. */
  const real above = direction[0] * p->geometric_normal.x + direction[1] * p->geometric_normal.y +
                     direction[2] * p->geometric_normal.z;
  value[0] = SELECT((real)0.0f, unshadowed, above > 0.0f);
}
