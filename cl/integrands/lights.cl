/* Points on the area lights, VEC at a time, as seen from the surface.
 *
 * Several lights share the one unit square: light k owns a strip first <= u < first + width, and u is
 * stretched over the strip. So what is integrated over all lights stays two-dimensional and one network serves all
 * of them. Widths are made by lights.py, multiples of a power of two that sum to 1: exact, as all this is with them.
 * Lights without power have no strip. Of a few lights, those that cannot light a point have none there either: for
 * every choice of lights there is a row of strips.
 *

 * Where on its light a sample lies. Seen from a position at distance z from the light's plane, a line along edge2 is
 * at an angle theta from the plane's foot, and a point on it at an angle of sine h from the line's foot: cylindrical
 * coordinates about an axis along edge2, in which d(theta) dh is solid angle, as Archimedes found. (u, v) are theta and
 * h stretched from 0 to 1, so the density of directions is 1 / (range of theta * range of h on the line): all but
 * uniform over the solid angle for any parallelogram, known exactly, and without the cancellation of angles'
 * sums (Urena, Fajardo and King 2013 have uniform ones for rectangles). A line u = const is a straight line on
 * the light. Lights that are small as seen from the position are sampled by area, (u, v) along the edges, which
 * is then as good and costs less.
 *
 * `lights`: LIGHT_COUNT records of LIGHT_FLOATS floats:
 *   0 corner, 3 edge1, 6 edge2, 9 unit normal of the emitting side, 12 radiance, 15 first and 16 width of the
 *   strip where all lights have one, 17 two-sided (0 or 1), 18 offset of ray ends off the light's plane, for rays from the scene's origin, 19 area,
 *   20 unit vector along edge2, 23 unit vector across it in the plane, 26 length of edge2, 27 edge1 across, 28 edge1
 *   along edge2 over that, 29 squared distance of the middle from which on the light is small, 30 two unused.
 *   Then STRIP_ROWS rows, first and width of each light's strip.
 *
 * Work-group contract: none; pure functions of private values.
 */

typedef struct {
  triple towards;   /* unit, from the position to the light */
  triple segment;   /* from the ray's origin to a point off the light's plane, on the side the ray comes from */
  real radiance[3]; /* L_e over the density of the direction: times f_r cos, the integrand */
  real density;     /* of the direction, per solid angle */
  whole lit;        /* whether the light shines that way */
} LightSample;

/* How far rays from `position` end off the light's plane: some rounding errors of the coordinates that enter there,
 * along its normal, which are those of the light about the position (surface.cl). */
float light_offset(global const float *restrict record, const float3 position) {
  return record[18] + 2.0f * RELATIVE_OFFSET * dot(fabs(vload3(3, record)), fabs(position));
}

/* A light from a position: its plane's distance, where lines along edge2 begin and end across it, and where the first
 * of them begins along it. */
typedef struct {
  real z, x0, width, y0, slope, length;
} LightView;

/* atan2(y, x) of y >= 0, which is not zero if x is, and below the sine and cosine of angles from 0 to pi: to a rounding
 * error or two of the largest results, for a third of what the built-in ones cost (Moshier 1992, Cephes). */
real half_turn_angle(const real y, const real x) {
  const real low = min(y, fabs(x));
  const real high = max(y, fabs(x));
  const whole steep = low > 0.41421356f * high;
  const real t = SELECT(low, low - high, steep) / SELECT(high, low + high, steep);
  const real t2 = t * t;
  const real tail = FMA(FMA(FMA((real)8.05374449538e-2f, t2, (real)-1.38776856032e-1f), t2, (real)1.99777106478e-1f), t2,
                        (real)-3.33329491539e-1f);
  real angle = FMA(tail * t2, t, t) + SELECT((real)0.0f, (real)(0.25f * M_PI_F), steep);
  angle = SELECT(angle, 0.5f * M_PI_F - angle, y > fabs(x));
  return SELECT(angle, M_PI_F - angle, x < 0.0f);
}

void half_turn_sincos(const real angle, real *sine, real *cosine) {
  /* From the quarter's, doubled twice: as exact for small angles as these are. */
  const real a = 0.25f * angle;
  const real a2 = a * a;
  const real sine_tail =
      FMA(FMA((real)-1.9515295891e-4f, a2, (real)8.3321608736e-3f), a2, (real)-1.6666654611e-1f);
  const real quarter_sine = FMA(sine_tail * a2, a, a);
  const real cosine_tail =
      FMA(FMA((real)2.443315711809948e-5f, a2, (real)-1.388731625493765e-3f), a2, (real)4.166664568298827e-2f);
  const real quarter_cosine = FMA(cosine_tail * a2, a2, FMA((real)-0.5f, a2, (real)1.0f));
  const real half_sine = 2.0f * quarter_sine * quarter_cosine;
  const real half_cosine = FMA(-2.0f * quarter_sine, quarter_sine, (real)1.0f);
  *sine = 2.0f * half_sine * half_cosine;
  *cosine = FMA(-2.0f * half_sine, half_sine, (real)1.0f);
}

/* The range of theta. */
real view_angle(const LightView *view) {
  const real x1 = view->x0 + view->width;
  return half_turn_angle(view->z * view->width, FMA(view->z, view->z, view->x0 * x1));
}

/* Of the line at x, which begins at y: the square of its distance, and at both ends h and 1 - h^2; the range of h. */
typedef struct {
  real squared, h[2], rest[2], range;
} LightLine;

LightLine light_line(const LightView *view, const real x, const real y) {
  LightLine line;
  line.squared = FMA(x, x, view->z * view->z);
  const real ends[2] = {y, y + view->length};
  real inverse[2];
  for (int end = 0; end < 2; ++end) {
    inverse[end] = rsqrt(FMA(ends[end], ends[end], line.squared));
    line.h[end] = ends[end] * inverse[end];
    line.rest[end] = line.squared * inverse[end] * inverse[end];
  }
  /* Without cancellation where both ends lie on one side. */
  const real both = view->length * (ends[0] + ends[1]) * inverse[0] * inverse[1];
  const real same = line.squared * inverse[0] * inverse[1] * both / (line.h[0] + line.h[1]);
  line.range = SELECT(line.h[1] - line.h[0], same, line.h[0] * line.h[1] > 0.0f);
  return line;
}

/* Sends u to x across edge2; `angle` is the light's `view_angle`. */
real view_x(const LightView *view, const real u, const real angle) {
  real sine, cosine;
  half_turn_sincos(u * angle, &sine, &cosine);
  const real toward = FMA(view->z, cosine, -view->x0 * sine);
  /* Tangent of theta by the sum of its beginning and u's part: as exact near the foot as at the light's ends. */
  const real tangent = FMA(view->z, sine, view->x0 * cosine) / max(toward, (real)1e-30f);
  return clamp(view->z * tangent, view->x0, view->x0 + view->width);
}

/* Sends (u, v) to x across edge2 and y along it, about the position; returns the solid angle that a sample stands for. */
real sample_view(const LightView *view, const real u, const real v, real *x, real *y) {
  const real angle = view_angle(view);
  *x = view_x(view, u, angle);
  const real begin = FMA(*x - view->x0, view->slope, view->y0);
  const LightLine line = light_line(view, *x, begin);
  /* Of positive terms: 1 - h^2 at h = (1 - v) h0 + v h1. */
  const real left = 1.0f - v;
  const real h = FMA(v, line.h[1], left * line.h[0]);
  const real rest = FMA(v, line.rest[1], left * line.rest[0]) + v * left * line.range * line.range;
  *y = clamp(h * sqrt(line.squared / max(rest, (real)1e-30f)), begin, begin + view->length);
  return angle * line.range;
}

/* The strips of a row: those of all lights, the last, and those of the lights that may light a point. */
global const float *all_strips(global const float *restrict lights) {
  return lights + LIGHT_COUNT * (LIGHT_FLOATS + (STRIP_ROWS - 1) * 2);
}

global const float *strips_at(global const float *restrict lights, const ShadingPoint *p) {
#if STRIP_ROWS > 1
  uint row = 0;
  for (uint light = 0; light < LIGHT_COUNT; ++light) {
    global const float *restrict record = lights + light * LIGHT_FLOATS;
    const float3 corner = vload3(0, record) - p->position;
    const float3 edge1 = vload3(1, record);
    const float3 edge2 = vload3(2, record);
    bool above = false, above_triangle = false;
    for (uint k = 0; k < 4; ++k) {
      const float3 to = corner + (float)(k & 1u) * edge1 + (float)(k >> 1) * edge2;
      /* A light that rounding takes for a hidden one would be missing. */
      const float rounding = -1e-5f * largest(to);
      above = above || dot(to, p->normal) > rounding;
      above_triangle = above_triangle || dot(to, p->geometric_normal) > rounding;
    }
    const bool shines = record[17] > 0.0f || dot(corner, vload3(3, record)) < 1e-5f * largest(corner);
    row |= (above && above_triangle && shines ? 1u : 0u) << light;
  }
  return lights + LIGHT_COUNT * (LIGHT_FLOATS + row * 2);
#else
  (void)p;
  return all_strips(lights);
#endif
}

/* The light of `record` about a position, where `corner` is its corner. */
LightView view_of(const triple corner, const triple normal, const triple across, const triple along, const real width,
                  const real slope, const real length) {
  return (LightView){fabs(dot_triple(corner, normal)), dot_triple(corner, across), width, dot_triple(corner, along),
                     slope, length};
}

LightSample sample_lights(global const float *restrict lights, global const float *restrict strips,
                          const triple position, const triple origin, const real u, const real v) {
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
    const float first = strips[2 * light];
    const float width = strips[2 * light + 1];
    const real along = (u - first) / width;
#if LIGHT_COUNT == 1
    const whole here = (whole)(u >= 0.0f);
#else
    const whole here = (u >= first) && (u < first + width);
    if (!ANY(here)) continue;
#endif
    const triple begin = {corner.x - position.x, corner.y - position.y, corner.z - position.z};
    const float3 half_way = 0.5f * (edge1 + edge2);
    const triple middle = {begin.x + half_way.x, begin.y + half_way.y, begin.z + half_way.z};
    /* From the point on the surface: what the integrand is made of. */
    triple to = {begin.x + along * edge1.x + v * edge2.x, begin.y + along * edge1.y + v * edge2.y,
                 begin.z + along * edge1.z + v * edge2.z};
    const whole large = here && (dot_triple(middle, middle) < record[29]);
    real solid_angle = (real)0.0f;
    if (ANY(large)) {
      const float3 e2 = vload3(0, record + 20);
      const float3 e1 = vload3(0, record + 23);
      const LightView view = view_of(begin, to_triple(normal), to_triple(e1), to_triple(e2), (real)record[27],
                                     (real)record[28], (real)record[26]);
      real x, y;
      solid_angle = sample_view(&view, along, v, &x, &y);
      /* In the light's frame: what a huge light's corners would round away is kept. */
      const real height = dot_triple(begin, to_triple(normal));
      to.x = SELECT(to.x, x * e1.x + y * e2.x + height * normal.x, large);
      to.y = SELECT(to.y, x * e1.y + y * e2.y + height * normal.y, large);
      to.z = SELECT(to.z, x * e1.z + y * e2.z + height * normal.z, large);
    }
    const real squared = max(dot_triple(to, to), (real)1e-30f);
    const real inverse = rsqrt(squared);
    const real emitted = -(normal.x * to.x + normal.y * to.y + normal.z * to.z) * inverse;
    const real facing = record[17] > 0.0f ? fabs(emitted) : emitted;
    const whole lit = here && (facing > 0.0f);
    found.towards.x = SELECT(found.towards.x, to.x * inverse, lit);
    found.towards.y = SELECT(found.towards.y, to.y * inverse, lit);
    found.towards.z = SELECT(found.towards.z, to.z * inverse, lit);
    const real stands_for = SELECT(facing * inverse * inverse * record[19], solid_angle, large);
    for (int channel = 0; channel < 3; ++channel)
      found.radiance[channel] = SELECT(found.radiance[channel], stands_for * (record[12 + channel] / width), lit);
    found.density = SELECT(found.density, width / max(stands_for, (real)1e-30f), lit);
    /* From the moved origin to a point off the light's plane, on the side the ray comes from. */
    /* As light_offset. */
    const real along_normal =
        fabs(normal.x * position.x) + fabs(normal.y * position.y) + fabs(normal.z * position.z);
    const real offset = FMA((real)(2.0f * RELATIVE_OFFSET), along_normal, (real)record[18]);
    const real side = SELECT(-offset, offset, emitted > 0.0f);
    found.segment.x = SELECT(found.segment.x, to.x + side * normal.x - (origin.x - position.x), lit);
    found.segment.y = SELECT(found.segment.y, to.y + side * normal.y - (origin.y - position.y), lit);
    found.segment.z = SELECT(found.segment.z, to.z + side * normal.z - (origin.z - position.z), lit);
    found.lit = found.lit || lit;
  }
  return found;
}

/* Per solid angle, the density of directions from a position to lights of several records, each to a point at
 * `segment` from it that it sees under the cosine `facing`; zero for lights without a strip. */
real light_density(global const float *restrict lights, const whole record, const triple position, const triple segment,
                   const real facing) {
  const triple corner = gather_triple(lights, record);
  const triple begin = {corner.x - position.x, corner.y - position.y, corner.z - position.z};
  const triple edge1 = gather_triple(lights, record + 3);
  const triple edge2 = gather_triple(lights, record + 6);
  const triple middle = {FMA((real)0.5f, edge1.x + edge2.x, begin.x), FMA((real)0.5f, edge1.y + edge2.y, begin.y),
                         FMA((real)0.5f, edge1.z + edge2.z, begin.z)};
  const real squared = dot_triple(segment, segment);
  real stands_for = facing / squared * gather(lights, record + 19);
  const whole large = dot_triple(middle, middle) < gather(lights, record + 29);
  if (ANY(large)) {
    const triple along = gather_triple(lights, record + 20);
    const triple across = gather_triple(lights, record + 23);
    const real width = gather(lights, record + 27);
    const LightView view = view_of(begin, gather_triple(lights, record + 9), across, along, width,
                                   gather(lights, record + 28), gather(lights, record + 26));
    const real x = dot_triple(segment, across);
    const LightLine line = light_line(&view, x, FMA(x - view.x0, view.slope, view.y0));
    stands_for = SELECT(stands_for, view_angle(&view) * line.range, large);
  }
  return gather(lights, record + 16) / max(stands_for, (real)1e-30f);
}
