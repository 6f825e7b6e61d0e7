/* Points on the area lights, VEC at a time, as seen from the surface.
 *
 * Several lights share the one unit square: light k owns a strip first <= u < first + width, and u is
 * stretched over the strip. So what is integrated over all lights stays two-dimensional and one network serves all
 * of them. Widths are made by lights.py, multiples of 1 / STRIP_STEPS, a power of two, that sum to 1: exact, as all this
 * is with them. Strips depend on the cell of the scene that the surface is in (light_cells.py): a row holds those of
 * the lights that may light something in the cell, as wide as what they bring there asks for. A table says which light
 * a step of the square belongs to, so a sample costs the same however many lights there are.
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
 * `lights`: LIGHT_COUNT records of LIGHT in lights.py, which says what they hold. With two lights or more, or an environment (HAS_ROWS), follow a
 * record of FRAME there; rows of STRIP_STEPS numbers of lights, then first and width of each light's strip (STRIP), and
 * SKY_NUMBERS for environment.cl, the first row by the lights' power alone; and the number of each cell's row. A row is known by where it begins.
 *
 * Work-group contract: none; pure functions of private values.
 */

#define LIGHT_FRAME (LIGHT_COUNT * LIGHT_FLOATS)
#define FIRST_ROW (LIGHT_FRAME + FRAME_FLOATS)
#define STRIP_COUNT LIGHT_COUNT
#define LIGHT_ROW_FLOATS (STRIP_STEPS + STRIP_FLOATS * STRIP_COUNT + SKY_NUMBERS)
/* Calls cost more than these functions' own arithmetic, and compilers count several kernels' calls of them. */
#ifndef INLINED
#define INLINED __attribute__((always_inline))
#endif
/* Of so many lights each is looked at for all samples at once; of more, every sample gathers its own's numbers. */
#define SELECTED_LIGHTS 8

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
  return record[LIGHT_OFFSET] + 2.0f * RELATIVE_OFFSET * dot(fabs(vload3(0, record + LIGHT_NORMAL)), fabs(position));
}

/* A light from a position: its plane's distance, where lines along edge2 begin and end across it, and where the first
 * of them begins along it. */
typedef struct {
  real z, x0, width, y0, slope, length;
} LightView;

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

/* Of the line at x, which begins at y: the square of its distance, and at both ends h and 1 - h^2; the range of h. */
typedef struct {
  real squared, h[2], rest[2], range;
} LightLine;

INLINED LightLine light_line(const LightView *view, const real x, const real y) {
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
INLINED real view_x(const LightView *view, const real u, const real angle) {
  real sine, cosine;
  half_turn_sincos(u * angle, &sine, &cosine);
  const real toward = FMA(view->z, cosine, -view->x0 * sine);
  /* Tangent of theta by the sum of its beginning and u's part: as exact near the foot as at the light's ends. */
  const real tangent = FMA(view->z, sine, view->x0 * cosine) / max(toward, (real)1e-30f);
  return clamp(view->z * tangent, view->x0, view->x0 + view->width);
}

/* Sends (u, v) to x across edge2 and y along it, about the position; returns the solid angle that a sample stands for. */
INLINED real sample_view(const LightView *view, const real u, const real v, real *x, real *y) {
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

/* The row by the lights' power alone. */
whole all_strips(global const float *restrict lights) {
  (void)lights;
  return (whole)FIRST_ROW;
}

#if HAS_ROWS
/* Where the strips of surfaces at (x, y, z) with this geometric normal, on the side that is lit, begin. One text for
 * a shading point and for VEC hits. */
#define DEFINE_STRIPS(name, number, integer, to_integer, choose, look_up)                                           \
  integer name(global const float *restrict lights, const number x, const number y, const number z,                 \
               const number normal_x, const number normal_y, const number normal_z) {                               \
    global const float *restrict frame = lights + LIGHT_FRAME;                                                      \
    const number x_boxes = (x - frame[FRAME_LOWER]) * frame[FRAME_INVERSE];                                         \
    const number last_x = (number)(frame[FRAME_COUNTS] - 1.0f);                                                     \
    const integer column = to_integer(clamp(x_boxes, (number)0.0f, last_x));                                        \
    const number y_boxes = (y - frame[FRAME_LOWER + 1]) * frame[FRAME_INVERSE + 1];                                 \
    const number last_y = (number)(frame[FRAME_COUNTS + 1] - 1.0f);                                                 \
    const integer row = to_integer(clamp(y_boxes, (number)0.0f, last_y));                                           \
    const number z_boxes = (z - frame[FRAME_LOWER + 2]) * frame[FRAME_INVERSE + 2];                                 \
    const number last_z = (number)(frame[FRAME_COUNTS + 2] - 1.0f);                                                 \
    const integer layer = to_integer(clamp(z_boxes, (number)0.0f, last_z));                                         \
    const number size_x = fabs(normal_x);                                                                           \
    const number size_y = fabs(normal_y);                                                                           \
    const number size_z = fabs(normal_z);                                                                           \
    const integer along_x = (size_x >= size_y) && (size_x >= size_z);                                               \
    const integer along_y = size_y >= size_z;                                                                       \
    const number along = choose(choose(normal_z, normal_y, along_y), normal_x, along_x);                            \
    const integer axis = choose(choose((integer)2, (integer)1, along_y), (integer)0, along_x);                      \
    const integer direction = 2 * axis + choose((integer)0, (integer)1, along > 0.0f);                              \
    const integer box = (layer * (int)frame[FRAME_COUNTS + 1] + row) * (int)frame[FRAME_COUNTS] + column;           \
    return FIRST_ROW + LIGHT_ROW_FLOATS * to_integer(look_up(lights, (int)frame[FRAME_TABLE] + 6 * box + direction));\
  }

DEFINE_STRIPS(hit_strips, real, whole, TO_WHOLE, SELECT, gather)
#if VEC == 1
#define point_strips hit_strips
#else
#define CHOOSE(if_false, if_true, condition) ((condition) ? (if_true) : (if_false))
#define LOOK_UP(array, at) (array)[at]
DEFINE_STRIPS(point_strips, float, int, convert_int, CHOOSE, LOOK_UP)
#endif
#endif

whole strips_of(global const float *restrict lights, const triple position, const triple normal) {
#if HAS_ROWS
  return hit_strips(lights, position.x, position.y, position.z, normal.x, normal.y, normal.z);
#else
  (void)position;
  (void)normal;
  return all_strips(lights);
#endif
}

whole strips_at(global const float *restrict lights, const ShadingPoint *p) {
#if HAS_ROWS
  const float3 x = p->position;
  const float3 n = p->geometric_normal;
  /* What a cell's row leaves out is known of its surfaces only. */
  if (p->detached > 0.0f) return all_strips(lights);
  return (whole)point_strips(lights, x.x, x.y, x.z, n.x, n.y, n.z);
#else
  (void)p;
  return all_strips(lights);
#endif
}

/* The light that a row gives to u, as the place of its record; its strip. */
INLINED whole light_at(global const float *restrict lights, const whole row, const real u, real *first, real *width) {
#if LIGHT_COUNT > 1
  const whole step = min(TO_WHOLE(u * (float)STRIP_STEPS), (whole)(STRIP_STEPS - 1));
  const whole light = TO_WHOLE(gather(lights, row + step));
  const whole strip = row + STRIP_STEPS + STRIP_FLOATS * light;
  *first = gather(lights, strip + STRIP_FIRST);
  *width = gather(lights, strip + STRIP_WIDTH);
  return light * LIGHT_FLOATS;
#else
  (void)lights;
  (void)row;
  (void)u;
  *first = (real)0.0f;
  *width = (real)1.0f;
  return (whole)0;
#endif
}

/* Number `at` of the records of VEC lights. */
INLINED real light_number(global const float *restrict lights, const whole record, const int at) {
#if LIGHT_COUNT <= SELECTED_LIGHTS
  real number = (real)lights[at];
#pragma unroll
  for (int light = 1; light < LIGHT_COUNT; ++light)
    number = SELECT(number, (real)lights[light * LIGHT_FLOATS + at], record == light * LIGHT_FLOATS);
  return number;
#else
  return gather(lights, record + at);
#endif
}

INLINED triple light_triple(global const float *restrict lights, const whole record, const int at) {
  return (triple){light_number(lights, record, at), light_number(lights, record, at + 1),
                  light_number(lights, record, at + 2)};
}

/* The light of a record about a position, `begin` being its corner from there. */
INLINED LightView light_view(global const float *restrict lights, const whole record, const triple begin, const triple normal,
                     const triple across, const triple along) {
  return (LightView){fabs(dot_triple(begin, normal)),
                     dot_triple(begin, across),
                     light_number(lights, record, LIGHT_WIDTH),
                     dot_triple(begin, along),
                     light_number(lights, record, LIGHT_SLOPE),
                     light_number(lights, record, LIGHT_LENGTH)};
}

INLINED LightSample sample_lights(global const float *restrict lights, const whole strips, const triple position,
                          const triple origin, const real u, const real v) {
#if LIGHT_COUNT == 0
  (void)lights;
  (void)strips;
  (void)position;
  (void)origin;
  (void)u;
  (void)v;
  const triple none = {(real)0.0f, (real)0.0f, (real)0.0f};
  return (LightSample){none, none, {(real)0.0f, (real)0.0f, (real)0.0f}, (real)0.0f, (whole)0};
#else
  real first, width;
  const whole record = light_at(lights, strips, u, &first, &width);
  const real along = (u - first) / width;
  const triple corner = light_triple(lights, record, LIGHT_CORNER);
  const triple edge1 = light_triple(lights, record, LIGHT_EDGE1);
  const triple edge2 = light_triple(lights, record, LIGHT_EDGE2);
  const triple normal = light_triple(lights, record, LIGHT_NORMAL);
  const triple begin = {corner.x - position.x, corner.y - position.y, corner.z - position.z};
  const triple middle = {begin.x + 0.5f * (edge1.x + edge2.x), begin.y + 0.5f * (edge1.y + edge2.y),
                         begin.z + 0.5f * (edge1.z + edge2.z)};
  /* From the point on the surface: what the integrand is made of. */
  triple to = {begin.x + along * edge1.x + v * edge2.x, begin.y + along * edge1.y + v * edge2.y,
               begin.z + along * edge1.z + v * edge2.z};
  const whole large = dot_triple(middle, middle) < light_number(lights, record, LIGHT_LARGE);
  real solid_angle = (real)0.0f;
  if (ANY(large)) {
    const triple e2 = light_triple(lights, record, LIGHT_ALONG);
    const triple e1 = light_triple(lights, record, LIGHT_ACROSS);
    const LightView view = light_view(lights, record, begin, normal, e1, e2);
    real x, y;
    solid_angle = sample_view(&view, along, v, &x, &y);
    /* In the light's frame: what a huge light's corners would round away is kept. */
    const real height = dot_triple(begin, normal);
    to.x = SELECT(to.x, x * e1.x + y * e2.x + height * normal.x, large);
    to.y = SELECT(to.y, x * e1.y + y * e2.y + height * normal.y, large);
    to.z = SELECT(to.z, x * e1.z + y * e2.z + height * normal.z, large);
  }
  const real squared = max(dot_triple(to, to), (real)1e-30f);
  const real inverse = rsqrt(squared);
  const real emitted = -(normal.x * to.x + normal.y * to.y + normal.z * to.z) * inverse;
  const real facing = SELECT(emitted, fabs(emitted), light_number(lights, record, LIGHT_TWO_SIDED) > 0.0f);
  const real by_area = facing * inverse * inverse * light_number(lights, record, LIGHT_AREA);
  const real stands_for = SELECT(by_area, solid_angle, large);
  LightSample found;
  found.lit = facing > 0.0f;
  found.towards = (triple){to.x * inverse, to.y * inverse, to.z * inverse};
  for (int channel = 0; channel < 3; ++channel)
    found.radiance[channel] = stands_for * (light_number(lights, record, LIGHT_RADIANCE + channel) / width);
  found.density = width / max(stands_for, (real)1e-30f);
  /* From the moved origin to a point off the light's plane, on the side the ray comes from. */
  /* As light_offset. */
  const real along_normal = fabs(normal.x * position.x) + fabs(normal.y * position.y) + fabs(normal.z * position.z);
  const real offset = FMA((real)(2.0f * RELATIVE_OFFSET), along_normal, light_number(lights, record, LIGHT_OFFSET));
  const real side = SELECT(-offset, offset, emitted > 0.0f);
  found.segment.x = to.x + side * normal.x - (origin.x - position.x);
  found.segment.y = to.y + side * normal.y - (origin.y - position.y);
  found.segment.z = to.z + side * normal.z - (origin.z - position.z);
  return found;
#endif
}

/* The solid angle that a sample of a whole light stands for, of lights of several records, each at a point at `segment`
 * from a position that sees it under the cosine `facing`. */
real light_stands_for(global const float *restrict lights, const whole record, const triple position,
                      const triple segment, const real facing) {
  const triple corner = light_triple(lights, record, LIGHT_CORNER);
  const triple begin = {corner.x - position.x, corner.y - position.y, corner.z - position.z};
  const triple edge1 = light_triple(lights, record, LIGHT_EDGE1);
  const triple edge2 = light_triple(lights, record, LIGHT_EDGE2);
  const triple middle = {FMA((real)0.5f, edge1.x + edge2.x, begin.x), FMA((real)0.5f, edge1.y + edge2.y, begin.y),
                         FMA((real)0.5f, edge1.z + edge2.z, begin.z)};
  const real squared = dot_triple(segment, segment);
  real stands_for = facing / squared * light_number(lights, record, LIGHT_AREA);
  const whole large = dot_triple(middle, middle) < light_number(lights, record, LIGHT_LARGE);
  if (ANY(large)) {
    const triple along = light_triple(lights, record, LIGHT_ALONG);
    const triple across = light_triple(lights, record, LIGHT_ACROSS);
    const LightView view = light_view(lights, record, begin, light_triple(lights, record, LIGHT_NORMAL), across, along);
    const real x = dot_triple(segment, across);
    const LightLine line = light_line(&view, x, FMA(x - view.x0, view.slope, view.y0));
    stands_for = SELECT(stands_for, view_angle(&view) * line.range, large);
  }
  return stands_for;
}

/* How wide the strips of several records are in their rows. */
real strip_width(global const float *restrict lights, const whole strips, const whole record) {
#if LIGHT_COUNT > 1
  return gather(lights, strips + STRIP_STEPS + STRIP_WIDTH + record / (LIGHT_FLOATS / STRIP_FLOATS));
#else
  (void)lights;
  (void)strips;
  (void)record;
  return (real)1.0f;
#endif
}

/* Per solid angle, the density of these directions; zero for lights without a strip. */
real light_density(global const float *restrict lights, const whole strips, const whole record, const triple position,
                   const triple segment, const real facing) {
  const real stands_for = light_stands_for(lights, record, position, segment, facing);
  return strip_width(lights, strips, record) / max(stands_for, (real)1e-30f);
}
