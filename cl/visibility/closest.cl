/* What rays of a scene of few triangles hit first: each is tested against all of them, VEC rays at a time.
 *
 * Joined after shadow.cl, whose records and test of the three edges it shares: no ray slips through an edge between
 * neighbours. Of triangles at one distance the first counts.
 *
 * Work-group contract: none; a pure function of private values and of `casters`, which all work-items read alike.
 */

/* A triangle's number or -1, the distance in multiples of the direction, and the weights of the corners 1 and 2. */
typedef struct {
  whole triangle;
  real distance, u, v;
} Hit;

/* Those of the rays that are `open`. */
Hit closest_hit(global const float *restrict casters, const triple origin, const triple direction, const whole open) {
  const triple start = {origin.x - casters[0], origin.y - casters[1], origin.z - casters[2]};
  const triple moment = cross_triple(start, direction);
  Hit hit = {(whole)(-1), (real)MAXFLOAT, (real)0.0f, (real)0.0f};
  for (uint k = 0; k < CASTERS; ++k) {
    global const float *restrict record = casters + CENTRE_FLOATS + k * CASTER_FLOATS;
    const real height = dot_record(record + CASTER_NORMAL, start) - record[CASTER_DISTANCE];
    const real slope = dot_record(record + CASTER_NORMAL, direction);
    /* The plane lies ahead, and nearer than what is known. */
    const whole nearer = open && (height * slope < 0.0f) && (fabs(height) < hit.distance * fabs(slope));
    if (!ANY(nearer)) continue;
    const real side_0 = dot_record(record + CASTER_MOMENT_0, direction) + dot_record(record + CASTER_EDGE_0, moment);
    const real side_1 = dot_record(record + CASTER_MOMENT_1, direction) + dot_record(record + CASTER_EDGE_1, moment);
    const real side_2 = dot_record(record + CASTER_MOMENT_2, direction) + dot_record(record + CASTER_EDGE_2, moment);
    const real low = min(side_0, min(side_1, side_2));
    const real high = max(side_0, max(side_1, side_2));
    const whole inside = nearer && ((low >= 0.0f) || (high <= 0.0f));
    const real inverse = 1.0f / (side_0 + side_1 + side_2);
    hit.triangle = SELECT(hit.triangle, (whole)(int)k, inside);
    hit.distance = SELECT(hit.distance, -height / slope, inside);
    hit.u = SELECT(hit.u, side_2 * inverse, inside);
    hit.v = SELECT(hit.v, side_0 * inverse, inside);
  }
  return hit;
}
