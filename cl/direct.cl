/* Direct light: F(p) = integral over all area lights of f_r L_e G V dA.
 *
 * (u, v) is a point on a light. Several lights share the one unit square: light k owns the strip
 * first_k <= u < first_k + width_k, as wide as its share of the emitted power, and u is stretched over
 * the strip. So the integral stays two-dimensional and one network serves all lights.
 *
 * integrand_data: LIGHT_COUNT records of LIGHT_FLOATS floats:
 *   0 corner, 3 edge1, 6 edge2, 9 unit normal of the emitting side, 12 radiance * area / width,
 *   15 first, 16 width, 17 two-sided (0 or 1), 18 offset of ray ends off the light's plane.
 *
 * Work-group contract: none; pure functions of private values.
 */

void evaluate_integrand(const ShadingPoint *p, global const float *restrict integrand_data, const real u,
                        const real v, real value[CHANNELS], real direction[3], real *distance) {
  const float3 origin = ray_origin(p);
  for (int channel = 0; channel < CHANNELS; ++channel) value[channel] = (real)0.0f;
  for (int axis = 0; axis < 3; ++axis) direction[axis] = (real)0.0f;
  /* The direction is not normalised: it ends on the light, at distance 1. */
  *distance = (real)1.0f;
  for (int light = 0; light < LIGHT_COUNT; ++light) {
    global const float *restrict record = integrand_data + light * LIGHT_FLOATS;
    const float3 corner = vload3(0, record);
    const float3 edge1 = vload3(1, record);
    const float3 edge2 = vload3(2, record);
    const float3 normal = vload3(3, record);
    const float first = record[15];
    const float width = record[16];
    const real along = (u - first) / width;
#if LIGHT_COUNT == 1
    const whole here = (whole)(u >= 0.0f);
#else
    /* The last strip ends at 1 whatever the rounding of the widths. */
    whole here = u >= first;
    if (light + 1 < LIGHT_COUNT) here = here && (u < record[LIGHT_FLOATS + 15]);
    if (!ANY(here)) continue;
#endif
    /* From the point on the surface: what the integrand is made of. */
    const real to_x = corner.x + along * edge1.x + v * edge2.x - p->position.x;
    const real to_y = corner.y + along * edge1.y + v * edge2.y - p->position.y;
    const real to_z = corner.z + along * edge1.z + v * edge2.z - p->position.z;
    const real squared = max(to_x * to_x + to_y * to_y + to_z * to_z, (real)1e-30f);
    const real inverse = rsqrt(squared);
    const real x = to_x * inverse;
    const real y = to_y * inverse;
    const real z = to_z * inverse;
    const real cosine = p->normal.x * x + p->normal.y * y + p->normal.z * z;
    const real above =
        p->geometric_normal.x * x + p->geometric_normal.y * y + p->geometric_normal.z * z;
    const real emitted = -(normal.x * x + normal.y * y + normal.z * z);
    const real facing = record[17] > 0.0f ? fabs(emitted) : emitted;
    const whole lit = here && (cosine > 0.0f) && (above > 0.0f) && (facing > 0.0f);
    const real geometry = cosine * facing / squared;
    real f_r[3];
    scattering(p, x, y, z, f_r);
    for (int channel = 0; channel < CHANNELS; ++channel)
      value[channel] = SELECT(value[channel], f_r[channel] * geometry * record[12 + channel], lit);
    /* From the moved origin to a point off the light's plane, on the side the ray comes from. */
    const real side = SELECT((real)(-record[18]), (real)record[18], emitted > 0.0f);
    const float3 start = corner - origin;
    direction[0] = SELECT(direction[0], start.x + along * edge1.x + v * edge2.x + side * normal.x, lit);
    direction[1] = SELECT(direction[1], start.y + along * edge1.y + v * edge2.y + side * normal.y, lit);
    direction[2] = SELECT(direction[2], start.z + along * edge1.z + v * edge2.z + side * normal.z, lit);
  }
}
