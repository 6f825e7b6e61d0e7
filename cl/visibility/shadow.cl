/* Shadow rays of a scene of few triangles: each is tested against all of them, VEC rays at a time.
 *
 * Shadow rays of paths start anywhere, so no occluder list (shaft.cl) serves several of them. But if a
 * scene has few triangles, testing them all costs less than handing a ray to the host and waiting for
 * its answer.
 *
 * The test, in Pluecker coordinates. A line through o along d passes an edge from a to b on the side that the sign of
 * d . (a x b) + (o x d) . (b - a) tells. The three signs of a triangle are alike where the line passes through it, and
 * it is met between o and o + d if these lie on two sides of its plane. An edge's numbers are those of its
 * reverse with their signs turned, bit for bit, so no ray slips through an edge between neighbours.
 *
 * `casters`: a centre (CENTRE_FLOATS floats, three used), then CASTERS records of CASTER in shadow.py: unit normal,
 * distance of the plane from the centre, then for each edge b - a and its moment a x b, taken about the centre, so
 * that nothing is lost to a scene's place in the world.
 *
 * Work-group contract: none; a pure function of private values and of `casters`, which all work-items read alike.
 */

triple cross_triple(const triple a, const triple b) {
  return (triple){a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}

real dot_record(global const float *restrict record, const triple t) {
  return FMA((real)record[0], t.x, FMA((real)record[1], t.y, record[2] * t.z));
}

/* Those of the rays `open` from `origin` that reach origin + segment. */
whole reaches_light(global const float *restrict casters, const triple origin, const triple segment, whole open) {
  const triple start = {origin.x - casters[0], origin.y - casters[1], origin.z - casters[2]};
  const triple moment = cross_triple(start, segment);
  for (uint k = 0; k < CASTERS; ++k) {
    global const float *restrict record = casters + CENTRE_FLOATS + k * CASTER_FLOATS;
    const real height = dot_record(record + CASTER_NORMAL, start) - record[CASTER_DISTANCE];
    const whole crosses = open && ((height > 0.0f) != (height + dot_record(record + CASTER_NORMAL, segment) > 0.0f));
    /* Of a room's walls no ray between two of its points crosses any. */
    if (!ANY(crosses)) continue;
    const real side_0 = dot_record(record + CASTER_MOMENT_0, segment) + dot_record(record + CASTER_EDGE_0, moment);
    const real side_1 = dot_record(record + CASTER_MOMENT_1, segment) + dot_record(record + CASTER_EDGE_1, moment);
    const real side_2 = dot_record(record + CASTER_MOMENT_2, segment) + dot_record(record + CASTER_EDGE_2, moment);
    const real low = min(side_0, min(side_1, side_2));
    const real high = max(side_0, max(side_1, side_2));
    open = open && !(crosses && ((low >= 0.0f) || (high <= 0.0f)));
  }
  return open;
}
