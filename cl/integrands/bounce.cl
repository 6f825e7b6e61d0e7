/* Directions of the hemisphere by the surface's scattering, VEC at a time, and their density.
 *
 * A point of the unit square becomes a direction of the mixture
 *
 *   q D G1(o) / (4 cos_o) + (1 - q) cos_i / pi
 *
 * of GGX's visible normals, reflected (Heitz 2018; sampled by a spherical cap, Dupuy and Benyoub 2023), and
 * cosines: u < q picks the lobe, and what is left of u is stretched. q, the lobe's share, is 0 without
 * reflectance and follows the two reflectances otherwise. The lobe is there by itself too. Cosines come from the disc by Shirley's and
 * Chiu's concentric map (1997), which keeps neighbours of the square neighbours on the hemisphere.
 *
 * Work-group contract: none; pure functions of private values.
 */

/* tangent_frame, a frame a lane. */
void triple_frame(const triple n, triple *tangent, triple *bitangent) {
  const real sign = copysign((real)1.0f, n.z);
  const real a = -1.0f / (sign + n.z);
  const real b = n.x * n.y * a;
  *tangent = (triple){1.0f + sign * n.x * n.x * a, sign * b, -sign * n.x};
  *bitangent = (triple){b, sign + n.y * n.y * a, -n.y};
}

/* x tangent + y bitangent + z normal. */
triple from_frame(const triple n, const real x, const real y, const real z) {
  triple tangent, bitangent;
  triple_frame(n, &tangent, &bitangent);
  return (triple){x * tangent.x + y * bitangent.x + z * n.x, x * tangent.y + y * bitangent.y + z * n.y,
                  x * tangent.z + y * bitangent.z + z * n.z};
}

/* Sine and cosine of an angle in turns, at most a few: a quarter turn takes off exactly, so that no reduction by pi is
 * needed, and polynomials (those of the Cephes library, in single precision) do for the rest. */
real sincos_of_turns(const real turns, real *cosine) {
  const real quarters = rint(4.0f * turns);
  const real x = (turns - 0.25f * quarters) * (2.0f * M_PI_F);
  const real x2 = x * x;
  const real sine = FMA(x * x2, FMA(x2, FMA(x2, (real)-1.9515295891e-4f, (real)8.3321608736e-3f),
                                    (real)-1.6666654611e-1f), x);
  const real c = FMA(x2 * x2, FMA(x2, FMA(x2, (real)2.443315711809948e-5f, (real)-1.388731625493765e-3f),
                                  (real)4.166664568298827e-2f), FMA(x2, (real)-0.5f, (real)1.0f));
  const whole quadrant = TO_WHOLE(quarters) & 3;
  const whole odd = (quadrant & 1) == 1;
  const real s = SELECT(sine, c, odd);
  const real other = SELECT(c, sine, odd);
  *cosine = SELECT(other, -other, (quadrant == 1) || (quadrant == 2));
  return SELECT(s, -s, quadrant >= 2);
}

/* Radius and azimuth, in turns, on the unit disc, of equal areas. */
void concentric(const real u, const real v, real *radius, real *azimuth) {
  const real a = 2.0f * u - 1.0f;
  const real b = 2.0f * v - 1.0f;
  const whole wide = fabs(a) > fabs(b);
  const real major = SELECT(b, a, wide);
  const real ratio = SELECT(a, b, wide) / SELECT(major, (real)1.0f, major == 0.0f);
  *radius = major;
  *azimuth = SELECT(0.25f - 0.125f * ratio, 0.125f * ratio, wide);
}

#if HAS_SPECULAR
/* q, the share of directions that the lobe gives. */
real lobe_share(const Scatterer *s) {
  const real weight = schlick_weight(dot_triple(s->normal, s->outgoing));
  const real f0 = (s->reflectance.x + s->reflectance.y + s->reflectance.z) * (1.0f / 3.0f);
  const real lobe = f0 + (1.0f - f0) * weight;
  const real matte = (s->albedo.x + s->albedo.y + s->albedo.z) * (1.0f / 3.0f) * (1.0f - lobe);
  return SELECT((real)0.0f, clamp(lobe / (lobe + matte), (real)0.1f, (real)0.9f), f0 > 0.0f);
}

/* A visible normal of any length: a point of the sphere's cap that these, stretched to a hemisphere, come from. */
triple lobe_normal(const Scatterer *s, const triple o, const real height, const real sine, const real cosine_a,
                   const real sine_a) {
  const real alpha = s->roughness * s->roughness;
  const real inverse = rsqrt(max(alpha * alpha * (o.x * o.x + o.y * o.y) + o.z * o.z, (real)1e-30f));
  const real x = alpha * (sine * cosine_a + alpha * o.x * inverse);
  const real y = alpha * (sine * sine_a + alpha * o.y * inverse);
  const real z = max(height + o.z * inverse, (real)1e-20f);
  return (triple){x, y, z};
}

/* The direction towards the viewer in the normal's frame. */
triple outgoing_in_frame(const Scatterer *s) {
  triple tangent, bitangent;
  triple_frame(s->normal, &tangent, &bitangent);
  return (triple){dot_triple(tangent, s->outgoing), dot_triple(bitangent, s->outgoing),
                  max(dot_triple(s->normal, s->outgoing), (real)1e-6f)};
}

/* The visible normal at height v, from the pole down, and at an azimuth: in the normal's frame, of any length. */
triple visible_normal(const Scatterer *s, const triple o, const real v, const real cosine, const real sine) {
  /* The cap reaches from the pole down to the direction opposite to the viewer's, stretched. */
  const real alpha = s->roughness * s->roughness;
  const real stretched = o.z * rsqrt(max(alpha * alpha * (o.x * o.x + o.y * o.y) + o.z * o.z, (real)1e-30f));
  const real height = (1.0f - v) * (1.0f + stretched) - stretched;
  const real sine_h = sqrt(max((real)0.0f, FMA(-height, height, (real)1.0f)));
  return lobe_normal(s, o, height, sine_h, cosine, sine);
}

/* The lobe's direction there: the reflection by it. */
triple lobe_direction(const Scatterer *s, const real v, const real cosine, const real sine) {
  const triple o = outgoing_in_frame(s);
  const triple h = visible_normal(s, o, v, cosine, sine);
  const real unit = rsqrt(h.x * h.x + h.y * h.y + h.z * h.z);
  const real twice = 2.0f * (o.x * h.x + o.y * h.y + o.z * h.z) * unit * unit;
  return (triple){twice * h.x - o.x, twice * h.y - o.y, twice * h.z - o.z};
}

/* The direction of a point of the unit square by the lobe alone; may lie below the surface. */
triple sample_lobe(const Scatterer *s, const real u, const real v) {
  real cosine;
  const real sine = sincos_of_turns(u, &cosine);
  const triple lobe = lobe_direction(s, v, cosine, sine);
  return from_frame(s->normal, lobe.x, lobe.y, lobe.z);
}

/* Its density, per solid angle. */
real lobe_density(const Scatterer *s, const triple incident) {
  const triple sum = {incident.x + s->outgoing.x, incident.y + s->outgoing.y, incident.z + s->outgoing.z};
  const real inverse = rsqrt(max(dot_triple(sum, sum), (real)1e-20f));
  const real cosine_o = max(dot_triple(s->normal, s->outgoing), (real)1e-6f);
  return microfacet_density(s, sum, inverse) * 0.5f / (cosine_o + masking(s, (real)1.0f, cosine_o));
}
#endif

/* Density of a unit direction, per solid angle. */
real scattering_density(const Scatterer *s, const triple incident) {
  const real matte = max(dot_triple(s->normal, incident), (real)0.0f) * M_1_PI_F;
#if HAS_SPECULAR
  const real share = lobe_share(s);
  return matte + share * (lobe_density(s, incident) - matte);
#else
  return matte;
#endif
}

/* The direction of a point of the unit square; may lie below the surface, where the scattering is zero. */
triple sample_scattering(const Scatterer *s, const real u, const real v) {
#if HAS_SPECULAR
  const real share = lobe_share(s);
  const whole in_lobe = u < share;
  const real along = SELECT((u - share) / (1.0f - share), u / max(share, (real)1e-30f), in_lobe);
#else
  const real along = u;
#endif
  real radius, azimuth;
  concentric(along, v, &radius, &azimuth);
#if HAS_SPECULAR
  azimuth = SELECT(azimuth, along, in_lobe);
#endif
  real cosine;
  const real sine = sincos_of_turns(azimuth, &cosine);
  const real z = sqrt(max((real)0.0f, FMA(-radius, radius, (real)1.0f)));
  const triple matte = {radius * cosine, radius * sine, z};
#if HAS_SPECULAR
  const triple lobe = lobe_direction(s, v, cosine, sine);
  return from_frame(s->normal, SELECT(matte.x, lobe.x, in_lobe), SELECT(matte.y, lobe.y, in_lobe),
                    SELECT(matte.z, lobe.z, in_lobe));
#else
  return from_frame(s->normal, matte.x, matte.y, matte.z);
#endif
}
