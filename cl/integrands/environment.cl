/* The scene's environment and its suns as one more emitter beside the lights, VEC directions at a time.
 *
 * The unit square begins with the environment's strips, 0 <= u < share: one for the image, then one a sun. Over what is
 * left u is stretched for the lights (lights.cl). A row of strips ends with the numbers of SKY_ROW in environment.py: the
 * share, the widths, and which map of the image serves the row's cells.
 *
 * A map is a density over the sphere that follows the image's radiance times a cosine: cells of surfaces that face one
 * way share one, and it is zero only where none of their points has the direction above its surface. It has SKY_ROWS
 * rows of equal solid angle, from the upper pole down, and SKY_COLUMNS columns of equal azimuth. v chooses the height
 * by the cumulative sums of the rows; u the azimuth by cumulative sums within a row, interpolated between the middles of
 * rows. So the direction is continuous in (u, v), and the density, row's share times interpolated column's share, is
 * known exactly. A sun's strip is uniform over its disc.
 *
 * All strips of the environment are one emitter: a direction brings the radiance of image and suns, over the sum of all
 * densities that could have given it. Rays to it are longer than what is left of the scene in any direction.
 *
 * `lights`: what lights.cl reads; at FRAME_SKY a record of SKY, SUN_COUNT records of SUN, then maps (SKY_ROWS + 1
 * sums of rows, and for each row SKY_COLUMNS + 1 of columns) and the image's texels, three floats each, from the upper
 * row down. Joined after lights.cl.
 *
 * Work-group contract: none; pure functions of private values.
 */

#if HAS_ENVIRONMENT
/* Where they are in a row of strips. */
#define SKY_ROW_BEGIN (STRIP_STEPS + STRIP_FLOATS * STRIP_COUNT)
#define IMAGE_STRIP (-1)
#define NO_STRIP (-2)

/* Radiance that arrives, and the density by which the environment's strips give its direction. */
typedef struct {
  triple radiance;
  real density;
} SkySeen;

global const float *sky_record(global const float *restrict lights) {
  return lights + FIRST_ROW + (int)lights[LIGHT_FRAME + FRAME_SKY];
}

#if HAS_SKY_IMAGE
/* Between row `upper` of a map and the next one, which part of the latter counts at height `down` in rows. */
INLINED real row_part(const real down, whole *upper) {
  const real middle = clamp(down - 0.5f, (real)0.0f, (real)(SKY_ROWS - 1.0f));
  *upper = min(TO_WHOLE(middle), (whole)(SKY_ROWS - 2));
  return middle - TO_REAL(*upper);
}

/* Where a row's sums of columns begin. */
INLINED whole columns_of(const whole map, const whole row) { return map + (SKY_ROWS + 1) + (SKY_COLUMNS + 1) * row; }

/* Height and azimuth in rows and columns of a map. */
void sample_map(global const float *restrict lights, const whole map, const real u, const real v, real *down,
                real *around) {
  whole row = (whole)0;
  for (int step = SKY_ROWS / 2; step > 0; step /= 2) row += SELECT((whole)0, (whole)step, gather(lights, map + row + step) <= v);
  const real above = gather(lights, map + row);
  *down = TO_REAL(row) + (v - above) / max(gather(lights, map + row + 1) - above, (real)1e-30f);
  whole upper;
  const real part = row_part(*down, &upper);
  const whole first = columns_of(map, upper);
  const whole second = columns_of(map, upper + 1);
  whole column = (whole)0;
  real before = (real)0.0f;
  for (int step = SKY_COLUMNS / 2; step > 0; step /= 2) {
    const real one = gather(lights, first + column + step);
    const real sum = FMA(part, gather(lights, second + column + step) - one, one);
    const whole on = sum <= u;
    column += SELECT((whole)0, (whole)step, on);
    before = SELECT(before, sum, on);
  }
  const real one = gather(lights, first + column + 1);
  const real after = FMA(part, gather(lights, second + column + 1) - one, one);
  *around = TO_REAL(column) + clamp((u - before) / max(after - before, (real)1e-30f), (real)0.0f, (real)1.0f);
}

/* The density per solid angle at a height and an azimuth, in turns. */
real map_density(global const float *restrict lights, const whole map, const real height, const real turns) {
  const real down = (0.5f * SKY_ROWS) * (1.0f - height);
  const whole row = clamp(TO_WHOLE(down), (whole)0, (whole)(SKY_ROWS - 1));
  whole upper;
  const real part = row_part(down, &upper);
  const whole column = min(TO_WHOLE(turns * (float)SKY_COLUMNS), (whole)(SKY_COLUMNS - 1));
  const whole first = columns_of(map, upper) + column;
  const whole second = columns_of(map, upper + 1) + column;
  const real of_first = gather(lights, first + 1) - gather(lights, first);
  const real of_second = gather(lights, second + 1) - gather(lights, second);
  const real of_row = gather(lights, map + row + 1) - gather(lights, map + row);
  return of_row * FMA(part, of_second - of_first, of_first) * (SKY_ROWS * (SKY_COLUMNS / (4.0f * M_PI_F)));
}

/* The image's radiance at an angle from its upper edge, as a part of pi, and an azimuth, in turns. */
triple image_radiance(global const float *restrict sky, const real angle, const real turns) {
  const int width = (int)sky[SKY_WIDTH];
  const int height = (int)sky[SKY_HEIGHT];
  global const float *restrict texels = sky + (int)sky[SKY_TEXELS];
  const real across = turns * (float)width - 0.5f;
  const real down = clamp(angle * (float)height - 0.5f, (real)0.0f, (real)((float)height - 1.0f));
  const real left = floor(across);
  const whole upper = TO_WHOLE(down);
  const real right_part = across - left;
  const real lower_part = down - TO_REAL(upper);
  const whole first = TO_WHOLE(left);
  const whole column = SELECT(first, (whole)(width - 1), first < 0);
  const whole next = SELECT(column + 1, (whole)0, column + 1 >= width);
  const whole lower = min(upper + 1, (whole)(height - 1));
  const triple a = gather_triple(texels, 3 * (upper * width + column));
  const triple b = gather_triple(texels, 3 * (upper * width + next));
  const triple c = gather_triple(texels, 3 * (lower * width + column));
  const triple d = gather_triple(texels, 3 * (lower * width + next));
  const triple above = {FMA(right_part, b.x - a.x, a.x), FMA(right_part, b.y - a.y, a.y), FMA(right_part, b.z - a.z, a.z)};
  const triple below = {FMA(right_part, d.x - c.x, c.x), FMA(right_part, d.y - c.y, c.y), FMA(right_part, d.z - c.z, c.z)};
  return (triple){FMA(lower_part, below.x - above.x, above.x), FMA(lower_part, below.y - above.y, above.y),
                  FMA(lower_part, below.z - above.z, above.z)};
}
#endif

/* What arrives from unit directions at surfaces whose strips begin at `strips`. A direction that the strip of a sun has
 * given is on its disc, whatever rounding says: `strip` is the sun's number, or no strip of a sun. */
SkySeen sky_seen(global const float *restrict lights, const whole strips, const triple towards, const whole strip) {
  global const float *restrict sky = sky_record(lights);
  const whole row = strips + SKY_ROW_BEGIN;
  SkySeen seen = {{(real)0.0f, (real)0.0f, (real)0.0f}, (real)0.0f};
#if HAS_SKY_IMAGE
  const real x = dot_triple(to_triple(vload3(0, sky + SKY_AXES)), towards);
  const real y = dot_triple(to_triple(vload3(1, sky + SKY_AXES)), towards);
  const real z = dot_triple(to_triple(vload3(2, sky + SKY_AXES)), towards);
  /* Neither angle is known at the poles. */
  const real half_turns = half_turn_angle(max(fabs(x), (real)1e-20f), -z) * (0.5f * M_1_PI_F);
  const real turns = SELECT(half_turns, 1.0f - half_turns, x < 0.0f);
  const real angle = half_turn_angle(max(sqrt(FMA(x, x, z * z)), (real)1e-20f), y) * M_1_PI_F;
  seen.radiance = image_radiance(sky, angle, turns);
  const whole map = FIRST_ROW + TO_WHOLE(gather(lights, row + SKY_ROW_MAP));
  seen.density = gather(lights, row + SKY_ROW_IMAGE) * map_density(lights, map, y, turns);
#endif
  for (int k = 0; k < SUN_COUNT; ++k) {
    global const float *restrict sun = sky + SKY_FLOATS + k * SUN_FLOATS;
    const triple apart = {towards.x - sun[SUN_DIRECTION], towards.y - sun[SUN_DIRECTION + 1],
                          towards.z - sun[SUN_DIRECTION + 2]};
    const whole inside = (strip == k) || (dot_triple(apart, apart) <= sun[SUN_CHORD] * sun[SUN_CHORD]);
    const real density = gather(lights, row + SKY_ROW_SUNS + k) * sun[SUN_DENSITY];
    seen.density += SELECT((real)0.0f, density, inside);
    seen.radiance.x += SELECT((real)0.0f, (real)sun[SUN_RADIANCE], inside);
    seen.radiance.y += SELECT((real)0.0f, (real)sun[SUN_RADIANCE + 1], inside);
    seen.radiance.z += SELECT((real)0.0f, (real)sun[SUN_RADIANCE + 2], inside);
  }
  return seen;
}

/* Directions of a sun's disc, of equal solid angles. */
triple sample_sun(global const float *restrict sun, const real u, const real v) {
  real radius, azimuth;
  concentric(u, v, &radius, &azimuth);
  real cosine;
  const real sine = sincos_of_turns(azimuth, &cosine);
  const real chord = radius * sun[SUN_CHORD];
  /* The distance from the axis, of either sign as the radius is. */
  const real beside = chord * sqrt(FMA(-0.25f * chord, chord, (real)1.0f));
  return from_frame(to_triple(vload3(0, sun + SUN_DIRECTION)), beside * cosine, beside * sine,
                    FMA(-0.5f * chord, chord, (real)1.0f));
}

/* A segment that leaves the scene, from a position. */
triple out_of_scene(global const float *restrict lights, const triple position, const triple towards) {
  const real far = sky_record(lights)[SKY_REACH] + fabs(position.x) + fabs(position.y) + fabs(position.z);
  return (triple){far * towards.x, far * towards.y, far * towards.z};
}

/* What the strip of u gives; which is that of a sun, the image's, or none. */
LightSample sample_sky(global const float *restrict lights, const whole strips, const triple position, const real u,
                       const real v) {
  global const float *restrict sky = sky_record(lights);
  const whole row = strips + SKY_ROW_BEGIN;
  whole strip = (whole)NO_STRIP;
  triple towards = {(real)0.0f, (real)0.0f, (real)1.0f};
  real first = (real)0.0f;
#if HAS_SKY_IMAGE
  const real width = gather(lights, row + SKY_ROW_IMAGE);
  strip = SELECT(strip, (whole)IMAGE_STRIP, u < width);
  real down, around;
  const real along = min(u / max(width, (real)1e-30f), (real)0.99999994f);
  sample_map(lights, FIRST_ROW + TO_WHOLE(gather(lights, row + SKY_ROW_MAP)), along, v, &down, &around);
  real cosine;
  const real sine = sincos_of_turns(around * (1.0f / SKY_COLUMNS), &cosine);
  const real below = down * (2.0f / SKY_ROWS);
  const real radius = sqrt(max(below * (2.0f - below), (real)0.0f));
  const triple x_axis = to_triple(vload3(0, sky + SKY_AXES));
  const triple y_axis = to_triple(vload3(1, sky + SKY_AXES));
  const triple z_axis = to_triple(vload3(2, sky + SKY_AXES));
  const real x = radius * sine;
  const real y = 1.0f - below;
  const real z = -radius * cosine;
  towards.x = x * x_axis.x + y * y_axis.x + z * z_axis.x;
  towards.y = x * x_axis.y + y * y_axis.y + z * z_axis.y;
  towards.z = x * x_axis.z + y * y_axis.z + z * z_axis.z;
  first = width;
#endif
  for (int k = 0; k < SUN_COUNT; ++k) {
    const real own = gather(lights, row + SKY_ROW_SUNS + k);
    const whole here = (u >= first) && (u < first + own);
    const real part = clamp((u - first) / max(own, (real)1e-30f), (real)0.0f, (real)0.99999994f);
    towards = select_triple(towards, sample_sun(sky + SKY_FLOATS + k * SUN_FLOATS, part, v), here);
    strip = SELECT(strip, (whole)k, here);
    first += own;
  }
  const SkySeen seen = sky_seen(lights, strips, towards, strip);
  LightSample found;
  found.lit = (strip > NO_STRIP) && (seen.density > 0.0f);
  const real inverse = 1.0f / max(seen.density, (real)1e-30f);
  found.radiance[0] = inverse * seen.radiance.x;
  found.radiance[1] = inverse * seen.radiance.y;
  found.radiance[2] = inverse * seen.radiance.z;
  found.density = seen.density;
  found.towards = towards;
  found.segment = out_of_scene(lights, position, towards);
  return found;
}

/* The part of the square that the environment has. */
real environment_share(global const float *restrict lights, const whole strips) {
  return gather(lights, strips + SKY_ROW_BEGIN + SKY_ROW_SHARE);
}

/* What a ray finds that leaves the scene, weighted by how else that could have been found: 0 where the ray's `density`
 * is. */
triple sky_met(global const float *restrict lights, const whole strips, const triple direction, const real density) {
  const SkySeen seen = sky_seen(lights, strips, direction, (whole)NO_STRIP);
  const real weight = density / max(density + seen.density, (real)1e-30f);
  return (triple){weight * seen.radiance.x, weight * seen.radiance.y, weight * seen.radiance.z};
}
#endif

/* The part of the square that the lights have. */
real lights_share(global const float *restrict lights, const whole strips) {
#if HAS_ENVIRONMENT
  return 1.0f - environment_share(lights, strips);
#else
  (void)lights;
  (void)strips;
  return (real)1.0f;
#endif
}

/* A point of the square: on a light, or a direction of the environment. */
LightSample sample_emitters(global const float *restrict lights, const whole strips, const triple position,
                            const triple origin, const real u, const real v) {
#if HAS_ENVIRONMENT
  const real share = environment_share(lights, strips);
  const whole outside = u < share;
  const real left = max(1.0f - share, (real)1e-30f);
  const real past = clamp((u - share) / left, (real)0.0f, (real)0.99999994f);
  LightSample found = sample_lights(lights, strips, position, origin, past, v);
  const LightSample sky = sample_sky(lights, strips, position, u, v);
  for (int channel = 0; channel < 3; ++channel)
    found.radiance[channel] = SELECT(found.radiance[channel] / left, sky.radiance[channel], outside);
  found.density = SELECT(found.density * left, sky.density, outside);
  found.towards = select_triple(found.towards, sky.towards, outside);
  found.segment = select_triple(found.segment, sky.segment, outside);
  found.lit = SELECT(found.lit, sky.lit, outside);
  return found;
#else
  return sample_lights(lights, strips, position, origin, u, v);
#endif
}
