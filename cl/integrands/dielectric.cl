/* Directions in which dielectrics scatter, VEC at a time: what is reflected, and what goes through.
 *
 * Walter et al. 2007. A microfacet normal h is drawn from those that the viewer sees (bounce.cl), or is the surface's
 * own where that is smooth (the least roughness, and thin panes): then light is scattered in two directions. With
 * probability q that is the reflection by h, else the refraction. q is Fresnel's reflectance F(h . o), and a third number
 * chooses. A shading point has but its square: there q follows F at the surface's own normal, u < q chooses, and what is
 * left of u is stretched. A sample is worth, with i the direction and G1 Smith's masking of it,
 *
 *   F(h . o) G1(i) / q                      reflected
 *   tint (1 - F(h . o)) G1(i) / (1 - q) / eta^2     refracted
 *
 * 1 / eta^2 makes radiance of what paths carry: it is eta^2 times larger in the denser medium. Panes do not bend light and
 * have the same air on both sides, so it is not there. Their F is that of the triangle's own normal, as for shadow rays
 * (panes.py).
 *
 * Lights are sampled for the rough reflection alone; what goes through, and what a smooth surface reflects, is found by
 * these directions alone, which the density UNMATCHED says.
 *
 * Work-group contract: none; pure functions of private values.
 */

#if HAS_GLASS
/* The density of directions that light sampling does not find: beside it any other is nothing. */
#define UNMATCHED 1e30f
/* A direction on the wrong side of its triangle, as shading normals make some, becomes one at this sine above it. */
#define BESIDE 1e-3f

typedef struct {
  triple direction, throughput;
  real density; /* per solid angle, for the weight of light that is met */
  whole passes; /* whether it leaves on the side behind the surface */
} GlassRay;

whole is_smooth_glass(const Scatterer *s) { return (s->eta < 0.0f) || (s->roughness <= SMOOTH_GLASS); }

/* q of a shading point: a multiple of 1/8, for the square's boundary between the two to be on the dyadic grid. */
real reflected_strip(const Scatterer *s, const real cosine) {
  return clamp(0.125f * rint(8.0f * glass_reflectance(s, cosine)), (real)0.125f, (real)0.875f);
}

/* Factor, by the balance heuristic, of light that was sampled in a direction above the surface. */
real glass_light_weight(const Scatterer *s, const triple towards, const real density, const int is_first) {
  const triple sum = {towards.x + s->outgoing.x, towards.y + s->outgoing.y, towards.z + s->outgoing.z};
  const real cosine_h = dot_triple(s->outgoing, sum) * rsqrt(max(dot_triple(sum, sum), (real)1e-20f));
  const real share =
      is_first ? reflected_strip(s, dot_triple(s->normal, s->outgoing)) : glass_reflectance(s, cosine_h);
  const real own = share * lobe_density(s, towards);
  return SELECT(density / (density + own), (real)0.0f, is_smooth_glass(s));
}

/* A direction as it is where it leaves on the side of `normal`, else moved to just above the triangle. */
triple on_side(const triple d, const triple normal) {
  const real lift = max((real)0.0f, BESIDE - dot_triple(d, normal));
  const triple moved = {FMA(lift, normal.x, d.x), FMA(lift, normal.y, d.y), FMA(lift, normal.z, d.z)};
  const real unit = rsqrt(max(dot_triple(moved, moved), (real)1e-20f));
  const real scale = SELECT((real)1.0f, unit, lift > 0.0f);
  return (triple){scale * moved.x, scale * moved.y, scale * moved.z};
}

/* h, unit: the surface's own normal where it is smooth. */
triple microfacet_normal(const Scatterer *s, const real u, const real v) {
  if (!ANY(!is_smooth_glass(s))) return s->normal;
  real cosine;
  const real sine = sincos_of_turns(u, &cosine);
  const triple h = visible_normal(s, outgoing_in_frame(s), v, cosine, sine);
  const real unit = rsqrt(h.x * h.x + h.y * h.y + h.z * h.z);
  const triple world = from_frame(s->normal, unit * h.x, unit * h.y, unit * h.z);
  const whole own = is_smooth_glass(s);
  return (triple){SELECT(world.x, s->normal.x, own), SELECT(world.y, s->normal.y, own),
                  SELECT(world.z, s->normal.z, own)};
}

/* Where in its part of the unit interval, below or above a share, a number lies. */
real stretched(const real u, const real share) {
  return SELECT((u - share) / max(1.0f - share, (real)1e-30f), u / max(share, (real)1e-30f), u < share);
}

/* A point of the unit square of a dielectric's directions; `choice`, a number of the unit interval, is as good as new
 * afterwards, and for a shading point left as it is. */
GlassRay sample_glass(const Scatterer *s, const triple geometric_normal, const real u, const real v, real *choice,
                      const int is_first) {
  const whole thin = s->eta < 0.0f;
  const whole smooth = is_smooth_glass(s);
  const triple o = s->outgoing;
  const triple n = geometric_normal;
  const real cosine_o = SELECT(dot_triple(s->normal, o), dot_triple(n, o), thin);
  const real strip = reflected_strip(s, cosine_o);
  const triple h = microfacet_normal(s, is_first ? stretched(u, strip) : u, v);
  const real cosine_h = clamp(dot_triple(o, h), (real)1e-6f, (real)1.0f);
  const real reflected = glass_reflectance(s, SELECT(cosine_h, cosine_o, smooth));
  const real share = is_first ? strip : reflected;
  const whole reflects = (is_first ? u : *choice) < share;
  if (!is_first) *choice = stretched(*choice, share);

  const triple mirrored = {2.0f * cosine_h * h.x - o.x, 2.0f * cosine_h * h.y - o.y, 2.0f * cosine_h * h.z - o.z};
  const real inverse_eta = 1.0f / fabs(s->eta);
  const real sine2 = (1.0f - cosine_h * cosine_h) * inverse_eta * inverse_eta;
  const real bend = cosine_h * inverse_eta - sqrt(max((real)0.0f, 1.0f - sine2));
  const triple bent = {bend * h.x - inverse_eta * o.x, bend * h.y - inverse_eta * o.y, bend * h.z - inverse_eta * o.z};
  const triple through = {SELECT(bent.x, -o.x, thin), SELECT(bent.y, -o.y, thin), SELECT(bent.z, -o.z, thin)};
  const triple below = {-n.x, -n.y, -n.z};
  const triple passed = on_side(through, below);
  const triple lifted = on_side(mirrored, n);

  /* Rough lobes end at both normals, as other surfaces' do: light sampling finds nothing below. */
  const real cosine_i = SELECT(-dot_triple(s->normal, through), dot_triple(s->normal, mirrored), reflects);
  const whole lost = !smooth && ((cosine_i <= 0.0f) || (reflects && (dot_triple(n, mirrored) <= 0.0f)));
  const real masked = SELECT(masked_once(s, max(cosine_i, (real)1e-6f)), (real)1.0f, smooth);
  const real of_reflected = reflected / max(share, (real)1e-30f);
  const real radiance = SELECT(inverse_eta * inverse_eta, (real)1.0f, thin);
  const real of_passed = (1.0f - reflected) * radiance / max(1.0f - share, (real)1e-30f);
  const real weight = SELECT(masked * SELECT(of_passed, of_reflected, reflects), (real)0.0f, lost);

  GlassRay ray;
  ray.passes = !reflects;
  ray.direction = (triple){SELECT(passed.x, SELECT(mirrored.x, lifted.x, smooth), reflects),
                           SELECT(passed.y, SELECT(mirrored.y, lifted.y, smooth), reflects),
                           SELECT(passed.z, SELECT(mirrored.z, lifted.z, smooth), reflects)};
  ray.throughput = (triple){weight * SELECT(s->albedo.x, (real)1.0f, reflects),
                            weight * SELECT(s->albedo.y, (real)1.0f, reflects),
                            weight * SELECT(s->albedo.z, (real)1.0f, reflects)};
  const real own = share * lobe_density(s, mirrored);
  ray.density = SELECT((real)UNMATCHED, own, reflects && !smooth);
  return ray;
}
#endif
