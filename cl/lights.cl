/* Points on the area lights, VEC at a time, as seen from the surface.
 *
 * Several lights share the one unit square: light k owns the strip first_k <= u < first_k + width_k, and u is
 * stretched over the strip. So what is integrated over all lights stays two-dimensional and one network serves all
 * of them. Widths are made by lights.py, multiples of a power of two that sum to 1: exact, as all this is with them.
 * Lights without power have no strip.
 *
 * `lights`: LIGHT_COUNT records of LIGHT_FLOATS floats:
 *   0 corner, 3 edge1, 6 edge2, 9 unit normal of the emitting side, 12 radiance * area / width,
 *   15 first, 16 width, 17 two-sided (0 or 1), 18 offset of ray ends off the light's plane, for rays from the scene's
 *   origin, 19 width / area.
 *
 * Work-group contract: none; pure functions of private values.
 */

typedef struct {
  triple towards;   /* unit, from the position to the light */
  triple segment;   /* from the ray's origin to a point off the light's plane, on the side the ray comes from */
  real radiance[3]; /* L_e cos_light / distance^2 over the density of the point: times f_r cos, the integrand */
  real density;     /* of the direction, per solid angle */
  whole lit;        /* whether the light shines that way */
} LightSample;

/* How far rays from `position` end off the light's plane: some rounding errors of the coordinates that enter there,
 * along its normal, which are those of the light about the position (surface.cl). */
float light_offset(global const float *restrict record, const float3 position) {
  return record[18] + 2.0f * RELATIVE_OFFSET * dot(fabs(vload3(3, record)), fabs(position));
}

LightSample sample_lights(global const float *restrict lights, const triple position, const triple origin,
                          const real u, const real v) {
  LightSample found;
  found.lit = (whole)0;
  found.density = (real)0.0f;
  found.towards = (triple){(real)0.0f, (real)0.0f, (real)0.0f};
  found.segment = found.towards;
  for (int channel = 0; channel < 3; ++channel) found.radiance[channel] = (real)0.0f;
  for (int light = 0; light < LIGHT_COUNT; ++light) {
    global const float *restrict record = lights + light * LIGHT_FLOATS;
    const float3 corner = vload3(0, record);
    const float3 edge1 = vload3(1, record);
    const float3 edge2 = vload3(2, record);
    const float3 normal = vload3(3, record);
    const float first = record[15];
    const real along = (u - first) / record[16];
#if LIGHT_COUNT == 1
    const whole here = (whole)(u >= 0.0f);
#else
    const whole here = (u >= first) && (u < first + record[16]);
    if (!ANY(here)) continue;
#endif
    const real point_x = corner.x + along * edge1.x + v * edge2.x;
    const real point_y = corner.y + along * edge1.y + v * edge2.y;
    const real point_z = corner.z + along * edge1.z + v * edge2.z;
    /* From the point on the surface: what the integrand is made of. */
    const triple to = {point_x - position.x, point_y - position.y, point_z - position.z};
    const real squared = max(dot_triple(to, to), (real)1e-30f);
    const real inverse = rsqrt(squared);
    const real emitted = -(normal.x * to.x + normal.y * to.y + normal.z * to.z) * inverse;
    const real facing = record[17] > 0.0f ? fabs(emitted) : emitted;
    const whole lit = here && (facing > 0.0f);
    found.towards.x = SELECT(found.towards.x, to.x * inverse, lit);
    found.towards.y = SELECT(found.towards.y, to.y * inverse, lit);
    found.towards.z = SELECT(found.towards.z, to.z * inverse, lit);
    for (int channel = 0; channel < 3; ++channel)
      found.radiance[channel] =
          SELECT(found.radiance[channel], facing / squared * record[12 + channel], lit);
    found.density = SELECT(found.density, squared * record[19] / facing, lit);
    /* From the moved origin to a point off the light's plane, on the side the ray comes from. */
    /* As light_offset. */
    const real along_normal =
        fabs(normal.x * position.x) + fabs(normal.y * position.y) + fabs(normal.z * position.z);
    const real offset = FMA((real)(2.0f * RELATIVE_OFFSET), along_normal, (real)record[18]);
    const real side = SELECT(-offset, offset, emitted > 0.0f);
    found.segment.x = SELECT(found.segment.x, point_x + side * normal.x - origin.x, lit);
    found.segment.y = SELECT(found.segment.y, point_y + side * normal.y - origin.y, lit);
    found.segment.z = SELECT(found.segment.z, point_z + side * normal.z - origin.z, lit);
    found.lit = found.lit || lit;
  }
  return found;
}
