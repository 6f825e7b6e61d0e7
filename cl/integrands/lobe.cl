/* The lobe's strip of the unit square, beside those of the lights: directions that may find a light.
 *
 * Samples of the lights alone starve where a lobe is narrower than a light is seen: most of their directions are not
 * those in which the surface shines. So u < share is the lobe's strip, sampled by visible normals (bounce.cl), and
 * (u - share) / (1 - share) is a point on a light (lights.cl). A direction that meets a light is one that the light's own
 * strip could have given too, and the other way about: both count over the sum of their densities, each times its
 * share of the square (the balance heuristic of Veach 1997, which is unbiased for any shares). Directions that meet no
 * light, or the back of a one-sided one, are zero.
 *
 * The share is one of LOBE_SHARES, multiples of 1/8 so that strips stay on the dyadic grid, and alike for all samples
 * of a point. It is the one that makes a guess of the estimate's second moment least, integral f^2 / density: of each
 * light two regions are taken, that where the lobe is largest on it, and the rest, as its middle. Without a lobe there is
 * no strip, nor where it gains little (LOBE_GAIN) and the lobe is nowhere much denser than a light's own samples
 * (LOBE_NEED).
 *
 * Work-group contract: one-dimensional, any size, no local memory, no barriers; find_lobe_shares is one work-item a
 * point; the rest are functions of private values.
 */

#if HAS_SPECULAR
/* What a point on each of VEC lights brings. */
typedef struct {
  real lobe;   /* density of its direction by the lobe */
  real light;  /* by the light's strip, per unit of the lights' share */
  real amount; /* f_r cos L, summed over channels */
  real solid_angle;
} LightGuess;

LightGuess guess_light(global const float *restrict lights, const whole record, const real width, const Scatterer *s,
                       const triple position, const triple segment) {
  const real squared = max(dot_triple(segment, segment), (real)1e-30f);
  const real inverse = rsqrt(squared);
  const triple towards = {segment.x * inverse, segment.y * inverse, segment.z * inverse};
  const real facing = fabs(dot_triple(gather_triple(lights, record + LIGHT_NORMAL), towards));
  LightGuess guess;
  guess.solid_angle = light_stands_for(lights, record, position, segment, facing);
  guess.light = width / max(guess.solid_angle, (real)1e-30f);
  guess.lobe = lobe_density(s, towards);
  real f_r[3];
  scattering(s, towards, f_r);
  const triple radiance = gather_triple(lights, record + LIGHT_RADIANCE);
  guess.amount = (f_r[0] * radiance.x + f_r[1] * radiance.y + f_r[2] * radiance.z) *
                 max(dot_triple(s->normal, towards), (real)0.0f);
  return guess;
}

/* From the position to the middle of each light, and to the point on it that is about the nearest to a direction. */
void guess_places(global const float *restrict lights, const whole record, const triple position, const triple direction,
                  triple *middle, triple *nearest) {
  const triple corner = gather_triple(lights, record + LIGHT_CORNER);
  const triple edge1 = gather_triple(lights, record + LIGHT_EDGE1);
  const triple edge2 = gather_triple(lights, record + LIGHT_EDGE2);
  const triple normal = gather_triple(lights, record + LIGHT_NORMAL);
  const triple begin = {corner.x - position.x, corner.y - position.y, corner.z - position.z};
  *middle = (triple){FMA((real)0.5f, edge1.x + edge2.x, begin.x), FMA((real)0.5f, edge1.y + edge2.y, begin.y),
                     FMA((real)0.5f, edge1.z + edge2.z, begin.z)};
  /* Where the direction does not meet the plane: far out that way. */
  const real away = 1e3f * sqrt(dot_triple(*middle, *middle) + gather(lights, record + LIGHT_AREA));
  const real distance = dot_triple(begin, normal) / dot_triple(direction, normal);
  const real t = SELECT(away, min(distance, away), distance > 0.0f);
  const triple met = {FMA(t, direction.x, -begin.x), FMA(t, direction.y, -begin.y), FMA(t, direction.z, -begin.z)};
  const real width = gather(lights, record + LIGHT_WIDTH);
  const real length = gather(lights, record + LIGHT_LENGTH);
  const real x = clamp(dot_triple(met, gather_triple(lights, record + LIGHT_ACROSS)), (real)0.0f, width);
  const real y = dot_triple(met, gather_triple(lights, record + LIGHT_ALONG)) - x * gather(lights, record + LIGHT_SLOPE);
  const real a = x / width;
#if HAS_SHAPES
  const real shape = gather(lights, record + LIGHT_SHAPE);
  real start;
  const real part = line_part(shape, a, &start);
  const real b = clamp(y / length, start, start + part);
#else
  const real b = clamp(y, (real)0.0f, length) / length;
#endif
  *nearest = (triple){FMA(a, edge1.x, FMA(b, edge2.x, begin.x)), FMA(a, edge1.y, FMA(b, edge2.y, begin.y)),
                      FMA(a, edge1.z, FMA(b, edge2.z, begin.z))};
#if HAS_BALLS
  /* Where the direction passes a ball, or the ball's point that is nearest to it. */
  const real ahead = max(dot_triple(begin, direction), (real)0.0f);
  const triple beside = {FMA(ahead, direction.x, -begin.x), FMA(ahead, direction.y, -begin.y),
                         FMA(ahead, direction.z, -begin.z)};
  const real aside = sqrt(dot_triple(beside, beside));
  const real inward = min(length / max(aside, (real)1e-30f), (real)1.0f);
  const triple on_ball = {FMA(inward, beside.x, begin.x), FMA(inward, beside.y, begin.y), FMA(inward, beside.z, begin.z)};
  *nearest = select_triple(*nearest, on_ball, shape == (float)SHAPE_BALL);
#endif
}

#if HAS_ENVIRONMENT
/* What a direction of the environment brings, had all directions above the surface as much. */
LightGuess guess_environment(global const float *restrict lights, const whole strips, const Scatterer *s,
                             const triple towards) {
  const SkySeen seen = sky_seen(lights, strips, towards, (whole)NO_STRIP);
  LightGuess guess;
  guess.solid_angle = (real)(2.0f * M_PI_F);
  guess.light = seen.density;
  guess.lobe = lobe_density(s, towards);
  real f_r[3];
  scattering(s, towards, f_r);
  guess.amount = (f_r[0] * seen.radiance.x + f_r[1] * seen.radiance.y + f_r[2] * seen.radiance.z) *
                 max(dot_triple(s->normal, towards), (real)0.0f);
  return guess;
}
#endif

/* Adds to the second moments by each share what lanes of lights that are `here` make of them. */
void add_moments(const Scatterer *s, const LightGuess *peak, const LightGuess *rest, const whole here,
                 float moment[LOBE_SHARE_COUNT]) {
  const float shares[LOBE_SHARE_COUNT] = {LOBE_SHARES};
  /* A region of about the lobe's density where it is largest, had it the middle there or its tail. */
  const real alpha = s->roughness * s->roughness;
  const real region = min(alpha * sqrt(4.0f * M_PI_F / max(peak->lobe, (real)1e-30f)), peak->solid_angle);
  const real left = max(rest->solid_angle - region, (real)0.0f);
  const real of_peak = region * peak->amount * peak->amount;
  const real of_rest = left * rest->amount * rest->amount;
  for (uint k = 0; k < LOBE_SHARE_COUNT; ++k) {
    const float share = shares[k];
    const real density = FMA((real)share, peak->lobe, (1.0f - share) * peak->light);
    const real density_rest = FMA((real)share, rest->lobe, (1.0f - share) * rest->light);
    moment[k] += sum_lanes(SELECT((real)0.0f, of_peak / max(density, (real)1e-30f) +
                                                  of_rest / max(density_rest, (real)1e-30f), here));
  }
}

/* The lobe's share of the point's square; lights in lanes. */
float lobe_share_of_square(global const float *restrict lights, const whole strips, const ShadingPoint *p) {
  const float shares[LOBE_SHARE_COUNT] = {LOBE_SHARES};
  const real part = lights_share(lights, strips);
  const Scatterer surface = scatterer_of(p);
  const Scatterer *s = &surface;
  const real twice = 2.0f * dot_triple(s->normal, s->outgoing);
  const triple mirrored = {twice * s->normal.x - s->outgoing.x, twice * s->normal.y - s->outgoing.y,
                           twice * s->normal.z - s->outgoing.z};
  const triple position = to_triple(p->position);
  float moment[LOBE_SHARE_COUNT];
  for (uint k = 0; k < LOBE_SHARE_COUNT; ++k) moment[k] = 0.0f;
  bool needed = false;
  for (uint first = 0; first < LIGHT_COUNT; first += VEC) {
    const whole light = min(TO_WHOLE(LANE_NUMBER) + (int)first, (whole)(LIGHT_COUNT - 1));
    const whole record = light * LIGHT_FLOATS;
    const real width = part * strip_width(lights, strips, record);
    const whole here = (TO_WHOLE(LANE_NUMBER) + (int)first < LIGHT_COUNT) && (width > 0.0f);
    triple middle, nearest;
    guess_places(lights, record, position, mirrored, &middle, &nearest);
    const LightGuess rest = guess_light(lights, record, width, s, position, middle);
    const LightGuess peak = guess_light(lights, record, width, s, position, nearest);
    needed = needed || ANY(here && (peak.lobe > LOBE_NEED * peak.light));
    add_moments(s, &peak, &rest, here, moment);
  }
#if HAS_ENVIRONMENT
  const LightGuess above = guess_environment(lights, strips, s, s->normal);
  const LightGuess ahead = guess_environment(lights, strips, s, mirrored);
  needed = needed || ANY((ahead.amount > 0.0f) && (ahead.lobe > LOBE_NEED * ahead.light));
  add_moments(s, &ahead, &above, LANE_NUMBER < (bits)1u, moment);
#endif
  uint best = 0;
  float least = needed && shares[0] == 0.0f ? INFINITY : moment[0];
  for (uint k = 1; k < LOBE_SHARE_COUNT; ++k)
    if (moment[k] < least && (needed || shares[0] > 0.0f || moment[k] * LOBE_GAIN < moment[0])) {
      least = moment[k];
      best = k;
    }
  return shares[best];
}

kernel void find_lobe_shares(const uint point_count, const uint total_points, global float *restrict surface,
                             global const float *restrict integrand_data) {
  const uint point = (uint)get_global_id(0);
  if (point >= point_count) return;
  const ShadingPoint p = load_shading_point(surface, total_points, point);
  const bool shiny = p.reflectance.x + p.reflectance.y + p.reflectance.z > 0.0f;
  surface[ROW_LOBE_SHARE * (ulong)total_points + point] =
      shiny ? lobe_share_of_square(integrand_data, strips_at(integrand_data, &p), &p) : 0.0f;
}

/* The lights that directions meet first. Their radiance is that of the light itself: nothing is divided by a density,
 * which is that of the light's strip. */
LightSample lights_met(global const float *restrict lights, const whole strips, const triple position,
                       const triple origin, const triple direction) {
  real nearest = (real)MAXFLOAT;
  whole found = (whole)(-1);
  for (int light = 0; light < LIGHT_COUNT; ++light) {
    global const float *restrict record = lights + light * LIGHT_FLOATS;
    const triple begin = {record[LIGHT_CORNER] - position.x, record[LIGHT_CORNER + 1] - position.y,
                          record[LIGHT_CORNER + 2] - position.z};
    const triple normal = to_triple(vload3(0, record + LIGHT_NORMAL));
    const triple along = to_triple(vload3(0, record + LIGHT_ALONG));
    const triple across = to_triple(vload3(0, record + LIGHT_ACROSS));
    real t = dot_triple(begin, normal) / dot_triple(direction, normal);
    const triple met = {FMA(t, direction.x, -begin.x), FMA(t, direction.y, -begin.y), FMA(t, direction.z, -begin.z)};
    const real x = dot_triple(met, across);
    const real y = dot_triple(met, along) - x * record[LIGHT_SLOPE];
#if HAS_SHAPES
    const float shape = record[LIGHT_SHAPE];
    real start;
    const real part = line_part((real)shape, clamp(x / record[LIGHT_WIDTH], (real)0.0f, (real)1.0f), &start);
    const real high = record[LIGHT_LENGTH] * (start + part);
    whole inside = (x >= 0.0f) && (x <= record[LIGHT_WIDTH]) && (y >= record[LIGHT_LENGTH] * start) && (y <= high);
#else
    whole inside = (x >= 0.0f) && (x <= record[LIGHT_WIDTH]) && (y >= 0.0f) && (y <= record[LIGHT_LENGTH]);
#endif
#if HAS_BRIGHT_SURFACES
    inside = inside && is_before(begin, normal, position, origin);
#endif
#if HAS_BALLS
    real entered;
    const whole meets = meet_ball(begin, direction, record[LIGHT_LENGTH], &entered);
    if (shape == (float)SHAPE_BALL) {
      inside = meets;
      t = entered;
    }
#endif
    const whole here = (t > 0.0f) && (t < nearest) && inside;
    nearest = SELECT(nearest, t, here);
    found = SELECT(found, (whole)light, here);
  }
  const whole light = max(found, (whole)0);
  const whole record = light * LIGHT_FLOATS;
  const triple normal = gather_triple(lights, record + LIGHT_NORMAL);
  const real emitted = -dot_triple(normal, direction);
  const real facing = SELECT(emitted, fabs(emitted), gather(lights, record + LIGHT_TWO_SIDED) > 0.0f);
  LightSample sample;
  sample.lit = (found >= 0) && (facing > 0.0f);
  const real distance = SELECT((real)1.0f, nearest, found >= 0);
  const triple to = {distance * direction.x, distance * direction.y, distance * direction.z};
  const real stands_for = light_stands_for(lights, record, position, to, max(facing, (real)1e-20f));
  sample.density = strip_width(lights, strips, record) / max(stands_for, (real)1e-30f);
  sample.towards = direction;
  for (int channel = 0; channel < CHANNELS; ++channel)
    sample.radiance[channel] = gather(lights, record + LIGHT_RADIANCE + channel);
  /* As in sample_lights. */
  const real along_normal = fabs(normal.x * position.x) + fabs(normal.y * position.y) + fabs(normal.z * position.z);
  const real offset = FMA((real)(2.0f * RELATIVE_OFFSET), along_normal, gather(lights, record + LIGHT_OFFSET));
  const real side = SELECT(-offset, offset, emitted > 0.0f);
  sample.segment = (triple){to.x + side * normal.x - (origin.x - position.x), to.y + side * normal.y - (origin.y - position.y),
                            to.z + side * normal.z - (origin.z - position.z)};
#if HAS_BALLS
  const whole ball = gather(lights, record + LIGHT_SHAPE) == (float)SHAPE_BALL;
  const triple corner = gather_triple(lights, record + LIGHT_CORNER);
  const triple centre = {corner.x - position.x, corner.y - position.y, corner.z - position.z};
  real entered;
  const whole meets = meet_ball(centre, direction, gather(lights, record + LIGHT_WIDTH), &entered);
  const real reach = max(entered - ball_offset(lights, record, position), 0.5f * entered);
  const triple end = {FMA(reach, direction.x, position.x - origin.x), FMA(reach, direction.y, position.y - origin.y),
                      FMA(reach, direction.z, position.z - origin.z)};
  sample.segment = select_triple(sample.segment, end, ball);
  sample.lit = SELECT(sample.lit, (found >= 0) && meets, ball);
  const real sent = SELECT((real)1.0f, beam_share(lights, record, centre), ball);
  for (int channel = 0; channel < CHANNELS; ++channel) sample.radiance[channel] *= sent;
#endif
  return sample;
}

/* As lights_met; where no light is met, the environment. */
LightSample emitters_met(global const float *restrict lights, const whole strips, const triple position,
                         const triple origin, const triple direction) {
  LightSample met = lights_met(lights, strips, position, origin, direction);
#if HAS_ENVIRONMENT
  const whole outside = !met.lit;
  const SkySeen seen = sky_seen(lights, strips, direction, (whole)NO_STRIP);
  met.radiance[0] = SELECT(met.radiance[0], seen.radiance.x, outside);
  met.radiance[1] = SELECT(met.radiance[1], seen.radiance.y, outside);
  met.radiance[2] = SELECT(met.radiance[2], seen.radiance.z, outside);
  met.density = SELECT(met.density * lights_share(lights, strips), seen.density, outside);
  met.segment = select_triple(met.segment, out_of_scene(lights, position, direction), outside);
  met.lit = met.lit || (seen.density > 0.0f);
#endif
  return met;
}

/* The lights' u of a sample past the lobe's share of the square. */
real past_lobe(const float share, const real u) {
  return min((u - share) / max(1.0f - share, 1e-30f), (real)0.99999994f);
}

/* A point of the square: on a light, or in the lobe; `radiance` is then over the density of both. */
LightSample sample_lights_and_lobe(global const float *restrict lights, const ShadingPoint *p, const Scatterer *s,
                                   const real u, const real v) {
  const whole strips = strips_at(lights, p);
  const triple position = to_triple(p->position);
  const triple origin = to_triple(ray_origin(p));
  const float share = p->lobe_share;
  if (!(share > 0.0f)) return sample_emitters(lights, strips, position, origin, u, v);
  const whole in_lobe = u < share;
  LightSample sample = sample_emitters(lights, strips, position, origin, SELECT(past_lobe(share, u), u, in_lobe), v);
  const LightSample met = emitters_met(lights, strips, position, origin, sample_lobe(s, u / share, v));
  sample.lit = SELECT(sample.lit, met.lit, in_lobe);
  sample.density = SELECT(sample.density, met.density, in_lobe);
  sample.towards = select_triple(sample.towards, met.towards, in_lobe);
  sample.segment = select_triple(sample.segment, met.segment, in_lobe);
  const real density = FMA((real)share, lobe_density(s, sample.towards), (1.0f - share) * sample.density);
  /* What the lights' samples are divided by already. */
  const real weight = SELECT(sample.density, (real)1.0f, in_lobe) / max(density, (real)1e-30f);
  for (int channel = 0; channel < CHANNELS; ++channel)
    sample.radiance[channel] = weight * SELECT(sample.radiance[channel], met.radiance[channel], in_lobe);
  return sample;
}
#endif
