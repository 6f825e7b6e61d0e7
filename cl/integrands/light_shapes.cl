/* Where on a light the points of its part of the square lie, seen from a position, and their densities; VEC at a time.
 *
 * Seen from a position at distance z from the light's plane, a line along edge2 is
 * at an angle theta from the plane's foot, and a point on it at an angle of sine h from the line's foot: cylindrical
 * coordinates about an axis along edge2, in which d(theta) dh is solid angle, as Archimedes found. (u, v) are theta and
 * h stretched from 0 to 1, so the density of directions is 1 / (range of theta * range of h on the line): all but
 * uniform over the solid angle for any parallelogram, known exactly, and without the cancellation of angles'
 * sums (Urena, Fajardo and King 2013 have uniform ones for rectangles). A line u = const is a straight line on
 * the light. Lights that are small as seen from the position are sampled by area, (u, v) along the edges, which
 * is then as good and costs less.
 *
 * Shapes. Lines get shorter towards the tip of a triangle, and towards both ends of a disc; all else is as for
 * parallelograms. A triangle's lines are the denser the longer they are, at a share 1 - sqrt(1 - u) of its width or of its
 * range of theta. A ball is sampled uniformly over the cone of directions that meet it.
 *
 * Work-group contract: none; pure functions of private values.
 */

/* A light from a position: its plane's distance, where lines along edge2 begin and end across it, and where the first
 * of them begins along it. */
typedef struct {
  real z, x0, width, y0, slope, length;
#if HAS_SHAPES
  real shape;
#endif
} LightView;

#if HAS_SHAPES
/* The line at a share `at` across a light, as a part of edge2's length, and where on that it begins. */
INLINED real line_part(const real shape, const real at, real *start) {
  const real chord = 2.0f * sqrt(max(at - at * at, (real)0.0f));
  *start = SELECT((real)0.0f, FMA((real)-0.5f, chord, (real)0.5f), shape == (float)SHAPE_DISC);
  const real tapered = SELECT((real)1.0f, max(1.0f - at, (real)0.0f), shape == (float)SHAPE_TRIANGLE);
  return SELECT(tapered, chord, shape == (float)SHAPE_DISC);
}

/* u by which a triangle's lines are the denser the longer they are; `density` is that of what is returned. */
INLINED real toward_tip(const real shape, const real u, real *density) {
  const real left = sqrt(1.0f - u);
  const whole tapered = shape == (float)SHAPE_TRIANGLE;
  *density = SELECT((real)1.0f, 2.0f * left, tapered);
  return SELECT(u, u / (1.0f + left), tapered);
}

/* Lines of a disc are equally dense, so the longer count for more: over the mean chord, pi / 4 of the longest. */
INLINED real chord_weight(const real shape, const real part) {
  return SELECT((real)1.0f, part * (4.0f * M_1_PI_F), shape == (float)SHAPE_DISC);
}
#endif

/* Where the line at x begins; its length. */
INLINED real line_of_light(const LightView *view, const real x, real *length) {
  const real begin = FMA(x - view->x0, view->slope, view->y0);
#if HAS_SHAPES
  real start;
  *length = view->length * line_part(view->shape, clamp((x - view->x0) / view->width, (real)0.0f, (real)1.0f), &start);
  return FMA(view->length, start, begin);
#else
  *length = view->length;
  return begin;
#endif
}

/* atan2(y, x) of y >= 0, which is not zero if x is, and below the sine and cosine of angles from 0 to pi: to a rounding
 * error or two of the largest results, for a third of what the built-in ones cost (Moshier 1992, Cephes). */
INLINED real half_turn_angle(const real y, const real x) {
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

INLINED void half_turn_sincos(const real angle, real *sine, real *cosine) {
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
INLINED real view_angle(const LightView *view) {
  const real x1 = view->x0 + view->width;
  return half_turn_angle(view->z * view->width, FMA(view->z, view->z, view->x0 * x1));
}

/* Of the line at x, of this length, which begins at y: the square of its distance, and at both ends h and 1 - h^2; the
 * range of h. */
typedef struct {
  real squared, h[2], rest[2], range;
} LightLine;

INLINED LightLine light_line(const LightView *view, const real x, const real y, const real length) {
  LightLine line;
  line.squared = FMA(x, x, view->z * view->z);
  const real ends[2] = {y, y + length};
  real inverse[2];
  for (int end = 0; end < 2; ++end) {
    inverse[end] = rsqrt(FMA(ends[end], ends[end], line.squared));
    line.h[end] = ends[end] * inverse[end];
    line.rest[end] = line.squared * inverse[end] * inverse[end];
  }
  /* Without cancellation where both ends lie on one side. */
  const real both = length * (ends[0] + ends[1]) * inverse[0] * inverse[1];
  const real same = line.squared * inverse[0] * inverse[1] * both / (line.h[0] + line.h[1]);
  line.range = SELECT(line.h[1] - line.h[0], same, line.h[0] * line.h[1] > 0.0f);
  return line;
}

/* Sends u to x across edge2; `angle` is the light's `view_angle`. */
INLINED real view_x(const LightView *view, const real u, const real angle) {
  real sine, cosine;
  half_turn_sincos(u * angle, &sine, &cosine);
  const real toward = FMA(view->z, cosine, -view->x0 * sine);
  /* Tangent of theta by the sum of its beginning and u's part: as exact near the foot as at the light's ends. */
  const real tangent = FMA(view->z, sine, view->x0 * cosine) / max(toward, (real)1e-30f);
  return clamp(view->z * tangent, view->x0, view->x0 + view->width);
}

#if HAS_SHAPES
/* `toward_tip`'s density where the line is at x. */
INLINED real tip_density(const LightView *view, const real x, const real angle) {
  const real x1 = view->x0 + view->width;
  const real beyond = half_turn_angle(view->z * max(x1 - x, (real)0.0f), FMA(view->z, view->z, x * x1));
  const real left = beyond / max(angle, (real)1e-30f);
  return SELECT((real)1.0f, 2.0f * min(left, (real)1.0f), view->shape == (float)SHAPE_TRIANGLE);
}
#endif

/* Sends (u, v) to x across edge2 and y along it, about the position; returns the solid angle that a sample stands for. */
INLINED real sample_view(const LightView *view, const real u, const real v, real *x, real *y) {
  const real angle = view_angle(view);
  real length;
#if HAS_SHAPES
  real density;
  *x = view_x(view, toward_tip(view->shape, u, &density), angle);
#else
  *x = view_x(view, u, angle);
#endif
  const real begin = line_of_light(view, *x, &length);
  const LightLine line = light_line(view, *x, begin, length);
  /* Of positive terms: 1 - h^2 at h = (1 - v) h0 + v h1. */
  const real left = 1.0f - v;
  const real h = FMA(v, line.h[1], left * line.h[0]);
  const real rest = FMA(v, line.rest[1], left * line.rest[0]) + v * left * line.range * line.range;
  *y = clamp(h * sqrt(line.squared / max(rest, (real)1e-30f)), begin, begin + length);
#if HAS_SHAPES
  return angle * line.range / max(density, (real)1e-7f);
#else
  return angle * line.range;
#endif
}

#if HAS_BALLS
/* One minus the cosine of half the angle under which a ball is seen; `outside` is whether from outside. */
INLINED real ball_cap(const real squared, const real radius, whole *outside) {
  const real sine2 = radius * radius / max(squared, (real)1e-30f);
  *outside = sine2 < 1.0f;
  return sine2 / (1.0f + sqrt(max(1.0f - sine2, (real)0.0f)));
}

/* From a position to a ball, `centre` from there: a direction of its cone, all alike; the way to its outer radius. */
INLINED triple sample_ball(const triple centre, const real radius, const real outer, const real u, const real v,
                           real *solid_angle, real *distance, whole *outside) {
  const real squared = dot_triple(centre, centre);
  const real inverse = rsqrt(max(squared, (real)1e-30f));
  const triple axis = {centre.x * inverse, centre.y * inverse, centre.z * inverse};
  const real cap = ball_cap(squared, radius, outside);
  *solid_angle = 2.0f * M_PI_F * cap;
  const real below = v * cap;
  const real sine = sqrt(max(below * (2.0f - below), (real)0.0f));
  real half_sine, half_cosine;
  half_turn_sincos(u * M_PI_F, &half_sine, &half_cosine);
  const real a = sine * FMA(-2.0f * half_sine, half_sine, (real)1.0f);
  const real b = sine * 2.0f * half_sine * half_cosine;
  const real sign = copysign((real)1.0f, axis.z);
  const real c = -1.0f / (sign + axis.z);
  const real d = axis.x * axis.y * c;
  const real cosine = 1.0f - below;
  const real beside2 = squared * sine * sine;
  *distance = FMA(cosine, squared * inverse, -sqrt(max(outer * outer - beside2, (real)0.0f)));
  *outside = *outside && (*distance > 0.0f);
  return (triple){FMA(a, 1.0f + sign * axis.x * axis.x * c, FMA(b, d, cosine * axis.x)),
                  FMA(a, sign * d, FMA(b, sign + axis.y * axis.y * c, cosine * axis.y)),
                  FMA(-a, sign * axis.x, FMA(-b, axis.y, cosine * axis.z))};
}

/* Where a unit direction enters a ball, `centre` from its beginning; whether it does, from outside. */
INLINED whole meet_ball(const triple centre, const triple direction, const real radius, real *distance) {
  const real ahead = dot_triple(centre, direction);
  /* Of the way from the centre to the nearest place: nothing cancels, however far the ball. */
  const triple aside = {FMA(-ahead, direction.x, centre.x), FMA(-ahead, direction.y, centre.y),
                        FMA(-ahead, direction.z, centre.z)};
  const real rest = radius * radius - dot_triple(aside, aside);
  *distance = ahead - sqrt(max(rest, (real)0.0f));
  return (rest > 0.0f) && (*distance > 0.0f);
}
#endif
