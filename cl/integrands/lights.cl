/* Points on the area lights, VEC at a time, as seen from the surface.
 *
 * Several lights share the one unit square: light k owns a strip first <= u < first + width, and u is
 * stretched over the strip. So what is integrated over all lights stays two-dimensional and one network serves all
 * of them. Widths are made by lights.py, multiples of 1 / STRIP_STEPS, a power of two, that sum to 1: exact, as all this
 * is with them. Strips depend on the cell of the scene that the surface is in (light_cells.py): a row holds those of
 * the lights that may light something in the cell, as wide as what they bring there asks for. A table says which light
 * a step of the square belongs to, so a sample costs the same however many lights there are.
 *
 * light_shapes.cl has where on its light a sample lies.
 *
 * With HAS_CLUSTERS a strip may belong to many lights: u, stretched over the strip, chooses one of these by power, again
 * by a table, and is stretched over its part.
 *
 * `lights`: LIGHT_COUNT records of LIGHT in lights.py, which says what they hold. With two lights or more, or an
 * environment (HAS_ROWS), follow a record of FRAME there; CLUSTER_FLOATS of clusters (CLUSTER), if there are any, and
 * their tables of lights; rows of STRIP_STEPS numbers of strips, then first and width of each of STRIP_COUNT strips
 * (STRIP), and SKY_NUMBERS for environment.cl, the first row by the lights' power alone; and the number of each cell's
 * row. A row is known by where it begins.
 *
 * Work-group contract: none; pure functions of private values.
 */

#define LIGHT_FRAME (LIGHT_COUNT * LIGHT_FLOATS)
#define FIRST_ROW (LIGHT_FRAME + FRAME_FLOATS + ALL_CLUSTERS_FLOATS)
#define LIGHT_ROW_FLOATS (STRIP_STEPS + STRIP_FLOATS * STRIP_COUNT + SKY_NUMBERS)
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

/* The light that a row gives to u, as the place of its record; its part of the square. */
INLINED whole light_at(global const float *restrict lights, const whole row, const real u, real *first, real *width) {
#if LIGHT_COUNT > 1
  const whole step = min(TO_WHOLE(u * (float)STRIP_STEPS), (whole)(STRIP_STEPS - 1));
  const whole owner = TO_WHOLE(gather(lights, row + step));
  const whole strip = row + STRIP_STEPS + STRIP_FLOATS * owner;
  *first = gather(lights, strip + STRIP_FIRST);
  *width = gather(lights, strip + STRIP_WIDTH);
#if HAS_CLUSTERS
  const whole cluster = LIGHT_FRAME + FRAME_FLOATS + CLUSTER_FLOATS * owner;
  const real steps = gather(lights, cluster + CLUSTER_STEPS);
  const whole own = min(TO_WHOLE((u - *first) / *width * steps), TO_WHOLE(steps) - 1);
  const whole record = LIGHT_FLOATS * TO_WHOLE(gather(lights, TO_WHOLE(gather(lights, cluster + CLUSTER_TABLE)) + own));
  *first = FMA(*width, gather(lights, record + LIGHT_PART), *first);
  *width *= gather(lights, record + LIGHT_PART + 1);
  return record;
#else
  return owner * LIGHT_FLOATS;
#endif
#else
  (void)lights;
  (void)row;
  (void)u;
  *first = (real)0.0f;
  *width = (real)1.0f;
  return (whole)0;
#endif
}

/* The light of a record about a position, `begin` being its corner from there. */
INLINED LightView light_view(global const float *restrict lights, const whole record, const triple begin, const triple normal,
                     const triple across, const triple along) {
  LightView view;
  view.z = fabs(dot_triple(begin, normal));
  view.x0 = dot_triple(begin, across);
  view.width = light_number(lights, record, LIGHT_WIDTH);
  view.y0 = dot_triple(begin, along);
  view.slope = light_number(lights, record, LIGHT_SLOPE);
  view.length = light_number(lights, record, LIGHT_LENGTH);
#if HAS_SHAPES
  view.shape = light_number(lights, record, LIGHT_SHAPE);
#endif
  return view;
}

#if HAS_BALLS
/* How far before a ball rays from a position end. */
INLINED real ball_offset(global const float *restrict lights, const whole record, const triple position) {
  const real coordinates = fabs(position.x) + fabs(position.y) + fabs(position.z);
  return FMA((real)(2.0f * RELATIVE_OFFSET), coordinates, light_number(lights, record, LIGHT_OFFSET));
}

/* What a ball, `centre` from a position, sends there, over its radiance: less outside a spot's inner angle. */
INLINED real beam_share(global const float *restrict lights, const whole record, const triple centre) {
  const real inverse = rsqrt(max(dot_triple(centre, centre), (real)1e-30f));
  const triple towards = {centre.x * inverse, centre.y * inverse, centre.z * inverse};
  const triple axis = light_triple(lights, record, LIGHT_ALONG);
  const triple beside = {axis.y * towards.z - axis.z * towards.y, axis.z * towards.x - axis.x * towards.z,
                         axis.x * towards.y - axis.y * towards.x};
  const real sine = max(sqrt(dot_triple(beside, beside)), (real)1e-20f);
  const real left = light_number(lights, record, LIGHT_ACROSS) - half_turn_angle(sine, -dot_triple(axis, towards));
  return clamp(left * light_number(lights, record, LIGHT_ACROSS + 1), (real)0.0f, (real)1.0f);
}
#endif

#if HAS_BRIGHT_SURFACES
/* Whether rays begin on the side of a light's plane that their position is on: not where this lies in the plane, which
 * rounding takes to either side, as on the light itself. */
INLINED whole is_before(const triple begin, const triple normal, const triple position, const triple origin) {
  const triple moved = {origin.x - position.x, origin.y - position.y, origin.z - position.z};
  const real height = dot_triple(begin, normal);
  return height * (height - dot_triple(moved, normal)) > 0.0f;
}
#endif

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
#if HAS_CLUSTERS
  /* A part's bounds may not be single numbers. */
  const real chosen = clamp((u - first) / width, (real)0.0f, (real)0.99999994f);
#else
  const real chosen = (u - first) / width;
#endif
#if HAS_SHAPES
  const real shape = light_number(lights, record, LIGHT_SHAPE);
  real start, density;
  const real along = toward_tip(shape, chosen, &density);
  const real part = line_part(shape, along, &start);
  const real on_line = FMA(part, v, start);
#else
  const real along = chosen;
  const real on_line = v;
#endif
  const triple corner = light_triple(lights, record, LIGHT_CORNER);
  const triple edge1 = light_triple(lights, record, LIGHT_EDGE1);
  const triple edge2 = light_triple(lights, record, LIGHT_EDGE2);
  const triple normal = light_triple(lights, record, LIGHT_NORMAL);
  const triple begin = {corner.x - position.x, corner.y - position.y, corner.z - position.z};
  const triple middle = {begin.x + 0.5f * (edge1.x + edge2.x), begin.y + 0.5f * (edge1.y + edge2.y),
                         begin.z + 0.5f * (edge1.z + edge2.z)};
  /* From the point on the surface: what the integrand is made of. */
  triple to = {begin.x + along * edge1.x + on_line * edge2.x, begin.y + along * edge1.y + on_line * edge2.y,
               begin.z + along * edge1.z + on_line * edge2.z};
  const whole large = dot_triple(middle, middle) < light_number(lights, record, LIGHT_LARGE);
  real solid_angle = (real)0.0f;
  if (ANY(large)) {
    const triple e2 = light_triple(lights, record, LIGHT_ALONG);
    const triple e1 = light_triple(lights, record, LIGHT_ACROSS);
    const LightView view = light_view(lights, record, begin, normal, e1, e2);
    real x, y;
    solid_angle = sample_view(&view, chosen, v, &x, &y);
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
#if HAS_SHAPES
  const real area = light_number(lights, record, LIGHT_AREA) * chord_weight(shape, part);
#else
  const real area = light_number(lights, record, LIGHT_AREA);
#endif
  const real by_area = facing * inverse * inverse * area;
  const real stands_for = SELECT(by_area, solid_angle, large);
  LightSample found;
  found.lit = facing > 0.0f;
#if HAS_BRIGHT_SURFACES
  found.lit = found.lit && is_before(begin, normal, position, origin);
#endif
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
#if HAS_BALLS
  const whole ball = shape == (float)SHAPE_BALL;
  if (ANY(ball)) {
    real cone, distance;
    whole outside;
    const triple towards = sample_ball(begin, light_number(lights, record, LIGHT_LENGTH),
                                       light_number(lights, record, LIGHT_WIDTH), chosen, v, &cone, &distance, &outside);
    const real sent = beam_share(lights, record, begin);
    const real reach = max(distance - ball_offset(lights, record, position), 0.5f * distance);
    for (int channel = 0; channel < 3; ++channel) {
      const real radiance = sent * cone * (light_number(lights, record, LIGHT_RADIANCE + channel) / width);
      found.radiance[channel] = SELECT(found.radiance[channel], radiance, ball);
    }
    found.density = SELECT(found.density, width / max(cone, (real)1e-30f), ball);
    found.lit = SELECT(found.lit, outside && (sent > 0.0f), ball);
    found.towards = select_triple(found.towards, towards, ball);
    const triple end = {FMA(reach, towards.x, position.x - origin.x), FMA(reach, towards.y, position.y - origin.y),
                        FMA(reach, towards.z, position.z - origin.z)};
    found.segment = select_triple(found.segment, end, ball);
  }
#endif
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
#if HAS_SHAPES
  const triple over = light_triple(lights, record, LIGHT_ACROSS);
  const real at = clamp((dot_triple(segment, over) - dot_triple(begin, over)) / light_number(lights, record, LIGHT_WIDTH),
                        (real)0.0f, (real)1.0f);
  const real shape = light_number(lights, record, LIGHT_SHAPE);
  real start;
  const real area = light_number(lights, record, LIGHT_AREA) * chord_weight(shape, line_part(shape, at, &start));
#else
  const real area = light_number(lights, record, LIGHT_AREA);
#endif
  real stands_for = facing / squared * area;
  const whole large = dot_triple(middle, middle) < light_number(lights, record, LIGHT_LARGE);
  if (ANY(large)) {
    const triple along = light_triple(lights, record, LIGHT_ALONG);
    const triple across = light_triple(lights, record, LIGHT_ACROSS);
    const LightView view = light_view(lights, record, begin, light_triple(lights, record, LIGHT_NORMAL), across, along);
    const real x = dot_triple(segment, across);
    real length;
    const real y = line_of_light(&view, x, &length);
    const LightLine line = light_line(&view, x, y, length);
    const real angle = view_angle(&view);
#if HAS_SHAPES
    const real by_angle = angle * line.range / max(tip_density(&view, x, angle), (real)1e-7f);
#else
    const real by_angle = angle * line.range;
#endif
    stands_for = SELECT(stands_for, by_angle, large);
  }
#if HAS_BALLS
  /* Nothing else than the cone's directions are sampled; what is outside of it has no density. */
  whole outside;
  const real away2 = dot_triple(begin, begin);
  const real cap = ball_cap(away2, light_number(lights, record, LIGHT_LENGTH), &outside);
  const real cosine = dot_triple(segment, begin) * rsqrt(max(squared * away2, (real)1e-30f));
  const real cone = SELECT((real)1e30f, 2.0f * M_PI_F * cap, outside && (1.0f - cosine <= cap));
  stands_for = SELECT(stands_for, cone, shape == (float)SHAPE_BALL);
#endif
  return stands_for;
}

/* How wide the strips of several records are in their rows. */
real strip_width(global const float *restrict lights, const whole strips, const whole record) {
#if HAS_CLUSTERS
  const whole own = STRIP_FLOATS * TO_WHOLE(gather(lights, record + LIGHT_STRIP));
  return gather(lights, strips + STRIP_STEPS + STRIP_WIDTH + own) * gather(lights, record + LIGHT_PART + 1);
#elif LIGHT_COUNT > 1
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
