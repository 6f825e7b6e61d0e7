/* Light of a sky without sun on Lambert surfaces, for sky.py:
 *
 *     F(p) = albedo times the integral over the hemisphere of L(w) V(p, w) cos / pi dw
 *
 * The radiance L(w) goes from `below`, straight down, to `above`, straight up, in proportion to the height of w.
 *
 * integrand_data: nine floats, the unit vector that points up, `below` and `above`, both linear RGB.
 *
 * Work-group contract: none; pure functions of private values.
 */

void evaluate_integrand(const ShadingPoint *p, global const float *restrict integrand_data, const real u,
                        const real v, real value[CHANNELS], real direction[3], real *distance) {
  /* Malley's method: points of the square become directions w of density cos / pi about the normal. */
  const real height = sqrt(1.0f - u);
  const real radius = sqrt(u);
  real cosine;
  const real sine = sincos(2.0f * M_PI_F * v, &cosine);
  const real x = radius * cosine;
  const real y = radius * sine;
  float3 tangent, bitangent;
  tangent_frame(p->normal, &tangent, &bitangent);
  const triple w = {x * tangent.x + y * bitangent.x + height * p->normal.x,
                    x * tangent.y + y * bitangent.y + height * p->normal.y,
                    x * tangent.z + y * bitangent.z + height * p->normal.z};

  const float3 up = vload3(0, integrand_data);
  const real part = 0.5f + 0.5f * dot_triple(w, to_triple(up));
  const float albedo[3] = {p->albedo.x, p->albedo.y, p->albedo.z};
  /* Below the triangle itself nothing can be seen, whatever the interpolated normal says. */
  const whole is_open = dot_triple(w, to_triple(p->geometric_normal)) > 0.0f;
  for (uint channel = 0; channel < CHANNELS; ++channel) {
    const float below = integrand_data[3 + channel];
    const float above = integrand_data[6 + channel];
    value[channel] = SELECT((real)0.0f, albedo[channel] * (below + (above - below) * part), is_open);
  }

  /* The ray that decides V: to wherever the sky is. */
  direction[0] = w.x;
  direction[1] = w.y;
  direction[2] = w.z;
  *distance = (real)INFINITY;
}
