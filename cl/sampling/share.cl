/* Paths that several shading points share: what leaves the first surface that a path reaches goes to all of them.
 *
 * MEMBERS points make a group. Each draws directions of its own, and from where its rays hit paths go on (paths.cl). A
 * matte surface looks the same from everywhere, so what a path found there counts for every member that sees the place,
 * for one shadow ray instead of a path: MEMBERS times as many samples of each integral (Bekaert, Sbert and Halton,
 * Accelerating Path Tracing by Re-Using Paths, 2002). Member k's density of the place that member j found is
 *
 *   t_k(u, v) * cos_k / pi * cos_place / distance^2     where k sees the place, else 0,
 *
 * with (u, v) the place's direction in k's square and t_k the density that its samples follow there. By the balance
 * heuristic the sample counts for member k by MEMBERS * (k's density without t_k) / (the sum of all members'): at most
 * MEMBERS over k's own t_k. Where no path is shared (no surface was hit, a light, or one with a lobe) a sample counts for
 * its own member alone, MEMBERS over t_k times. Either way each direction of each member's hemisphere is covered once.
 *
 *   share_rays    shadow rays from every member to the places that the others found
 *   share_seen    keeps which of them reach their ends
 *   share_paths   coordinates, weights and values of all samples of all members
 *
 * Members are matte and reflect some light. `hits` has a plane of places * float a number of SHARED in share.py: what
 * keep_hit (below) writes of a path's first hit. A batch's entries: sample s that member j drew, as one of point p, is
 * element (p * MEMBERS + j) * stride + s of `visible`, `u`, `v`, `weight` and of each channel's plane of `value`.
 *
 * Joined after vertex.cl. With SHARES_DENSITY (warp.cl) samples follow the records in `density`.
 *
 * Work-group contract: one-dimensional, any size, no local memory, no barriers; a work-item of share_rays and
 * share_paths has VEC samples of all members of a group.
 */

/* Planes that keep_hit writes, the first so many. */
#define KEPT SHARED_BEGUN
#define HIT_PLANE(number) (hits + (number) * (ulong)places)

#if SHARED
/* Whether surfaces look the same from everywhere. Not where a normal is the triangle's own because the interpolated one,
 * or a bent one, faces away from where it was seen. */
whole looks_alike(global const float *restrict triangles, const whole at, const triple geometric_normal,
                  const Scatterer *s) {
  whole alike = !is_shiny(s);
#if HAS_NORMALS
  const whole own = (s->normal.x == geometric_normal.x) && (s->normal.y == geometric_normal.y) &&
                    (s->normal.z == geometric_normal.z);
  alike = alike && !(own && (gather(triangles, at + TRIANGLE_OFFSET) < 0.0f));
#endif
#if HAS_NORMAL_MAPS
  alike = alike && (gather(triangles, at + TRIANGLE_NORMAL_TEXTURE) < 0.0f);
#endif
  (void)triangles, (void)at, (void)geometric_normal;
  return alike;
}

/* The first hits of VEC paths. Shared are those `here`. */
void keep_hit(const triple position, const triple geometric_normal, const triple normal, const real offset,
              const whole here, const bits path, const uint places, global float *restrict hits) {
  const real numbers[KEPT] = {offset, position.x, position.y, position.z, geometric_normal.x, geometric_normal.y,
                              geometric_normal.z, normal.x, normal.y, normal.z};
  float number[KEPT][VEC];
  uint name[VEC];
  int is_here[VEC];
  for (uint row = 0; row < KEPT; ++row) STORE(numbers[row], number[row]);
  STORE(path, name);
  STORE(here, is_here);
  for (uint lane = 0; lane < VEC; ++lane)
    if (is_here[lane] != 0)
      for (uint row = 0; row < KEPT; ++row) HIT_PLANE(row)[name[lane]] = number[row][lane];
}

/* A point of a group. */
typedef struct {
  triple origin, geometric_normal;
  Scatterer s;
  real matte; /* the part of its square that is not the lobe's */
} Member;

Member load_member(global const float *restrict surface, const uint total_points, const uint point) {
  const ShadingPoint p = load_shading_point(surface, total_points, point);
  Member found = {to_triple(ray_origin(&p)), to_triple(p.geometric_normal), scatterer_of(&p), (real)1.0f};
#if HAS_SPECULAR
  found.matte -= lobe_share(&found.s);
#endif
  return found;
}

/* A place that a path found, VEC of them. */
typedef struct {
  triple position, geometric_normal, normal;
  real offset; /* 0: not shared */
} Place;

Place load_place(global const float *restrict hits, const uint places, const ulong at, const Member *member,
                 const real u) {
  Place found;
  /* What the lobe found is not shared. */
  found.offset = SELECT((real)0.0f, LOAD(HIT_PLANE(SHARED_OFFSET) + at), u >= 1.0f - member->matte);
  found.position = (triple){LOAD(HIT_PLANE(SHARED_POSITION) + at), LOAD(HIT_PLANE(SHARED_POSITION + 1) + at),
                            LOAD(HIT_PLANE(SHARED_POSITION + 2) + at)};
  found.geometric_normal =
      (triple){LOAD(HIT_PLANE(SHARED_GEOMETRIC_NORMAL) + at), LOAD(HIT_PLANE(SHARED_GEOMETRIC_NORMAL + 1) + at),
               LOAD(HIT_PLANE(SHARED_GEOMETRIC_NORMAL + 2) + at)};
  found.normal = (triple){LOAD(HIT_PLANE(SHARED_NORMAL) + at), LOAD(HIT_PLANE(SHARED_NORMAL + 1) + at),
                          LOAD(HIT_PLANE(SHARED_NORMAL + 2) + at)};
  return found;
}

/* From a member to a place: the direction, unit, and the density of the place, per area, of a direction uniform in the
 * member's square. 0 where one of them does not see the other's side that counts. */
real place_density(const Member *member, const Place *place, triple *towards) {
  const triple to = {place->position.x - member->origin.x, place->position.y - member->origin.y,
                     place->position.z - member->origin.z};
  const real inverse = rsqrt(max(dot_triple(to, to), (real)1e-30f));
  *towards = scaled(to, inverse);
  const real cosine = dot_triple(member->s.normal, *towards);
  const real facing = -dot_triple(place->geometric_normal, *towards);
  const whole open = (place->offset > 0.0f) && (cosine > 0.0f) && (facing > 0.0f) &&
                     (dot_triple(member->geometric_normal, *towards) > 0.0f) &&
                     (dot_triple(place->normal, *towards) < 0.0f);
  return SELECT((real)0.0f, member->matte * cosine * facing * (inverse * inverse * M_1_PI_F), open);
}

kernel void share_rays(const uint first_point, const uint point_count, const uint total_points, const uint stride,
                       const uint places, global const uint *restrict order, global const float *restrict surface,
                       global const float *restrict casters, global const float *restrict hits,
                       global const float *restrict own_u,
                       global uchar *restrict visible, const uint plane, global float *restrict wave) {
  const uint blocks = stride / VEC;
  const uint item = (uint)get_global_id(0);
  if (item >= point_count / MEMBERS * blocks) return;
  const uint first = item / blocks * MEMBERS;
  const uint block = item % blocks * VEC;
  Member members[MEMBERS];
  for (uint k = 0; k < MEMBERS; ++k) members[k] = load_member(surface, total_points, order[first_point + first + k]);
#if !CASTERS
  (void)casters;
#endif
  for (uint j = 0; j < MEMBERS; ++j) {
    const ulong own = (first + j) * (ulong)stride + block;
    const Place place = load_place(hits, places, own, &members[j], LOAD(own_u + own));
    /* Rays end off the surface. */
    const triple end = sum_of(place.position, place.geometric_normal, place.offset);
    for (uint k = 0; k < MEMBERS; ++k) {
      const ulong entry = ((first + k) * (ulong)MEMBERS + j) * stride + block;
      Ray ray;
      const whole open = (place_density(&members[k], &place, &ray.direction) > 0.0f) && (whole)(k != j ? -1 : 0);
      ray.origin = members[k].origin;
      ray.direction = (triple){end.x - ray.origin.x, end.y - ray.origin.y, end.z - ray.origin.z};
#if CASTERS
      count_shadow_rays(open, wave);
      const whole seen = reaches_light(casters, ray.origin, ray.direction, open);
#else
      const whole seen = (whole)0;
      ray.throughput = (triple){(real)0.0f, (real)0.0f, (real)0.0f};
      ray.density = (real)0.0f;
      ray.strips = (whole)0;
      ray.path = LANE_NUMBER + (uint)entry;
      append_rays(&ray, open, 1, plane, wave);
#endif
      int is_seen[VEC];
      STORE(seen, is_seen);
      for (uint lane = 0; lane < VEC; ++lane) visible[entry + lane] = is_seen[lane] != 0 || k == j ? 1 : 0;
    }
  }
}

kernel void share_seen(const uint count, const uint plane, global const float *restrict wave,
                       global uchar *restrict visible) {
  const uint ray = (uint)get_global_id(0);
  if (ray < count && ((global const uchar *)PLANE(wave, WAVE_LIT))[ray] != 0)
    visible[as_uint(PLANE(wave, WAVE_SHADOW_PATH)[ray])] = 1;
}

/* A matte direction's point of the square: the inverse of bounce.cl's map. */
void square_of(const Member *member, const triple towards, real *u, real *v) {
  triple tangent, bitangent;
  triple_frame(member->s.normal, &tangent, &bitangent);
  const real x = dot_triple(tangent, towards);
  const real y = dot_triple(bitangent, towards);
  const whole wide = fabs(x) > fabs(y);
  const real major = SELECT(y, x, wide);
  const real minor = SELECT(x, y, wide);
  const real radius = copysign(sqrt(min(x * x + y * y, (real)1.0f)), major);
  const real angle = half_turn_angle(fabs(minor), max(fabs(major), (real)1e-30f));
  /* Of the same sign as minor. */
  const real part = copysign(radius, minor) * (angle * (4.0f * M_1_PI_F));
  const real a = SELECT(part, radius, wide);
  const real b = SELECT(radius, part, wide);
  /* What is left of u is the lobe's. */
  *u = clamp(1.0f - member->matte * FMA((real)-0.5f, a, (real)0.5f), (real)0.0f, (real)BELOW_ONE);
  *v = clamp(FMA((real)0.5f, b, (real)0.5f), (real)0.0f, (real)BELOW_ONE);
}

#if SHARES_DENSITY
/* The part of a row's bin, in units of 1 / EDGE_UNITS. */
real bin_part(const bits low, const bits high, const whole bin) {
  const bits number = TO_BITS(bin);
  const bits before = number - 1u;
  const bits lower = SELECT(high, low, before < 4u) >> ((before & 3u) * 8u) & 255u;
  const bits upper = SELECT(high, low, number < 4u) >> ((number & 3u) * 8u) & 255u;
  const real begin = SELECT(TO_REAL(lower), (real)0.0f, bin == 0);
  return SELECT(TO_REAL(upper), (real)EDGE_UNITS, bin == DENSITY_BINS - 1) - begin;
}

real density_at(global const uint *restrict record, const real u, const real v) {
  const whole strip = TO_WHOLE(u * (float)DENSITY_BINS);
  const whole row = DENSITY_ROW * strip + DENSITY_CELLS;
  const real part = bin_part((bits)record[DENSITY_STRIPS], (bits)record[DENSITY_STRIPS + 1], strip) *
                    bin_part(gather_bits(record, TO_BITS(row)), gather_bits(record, TO_BITS(row + 1)),
                             TO_WHOLE(v * (float)DENSITY_BINS));
  const float scale = (float)DENSITY_BINS / (float)EDGE_UNITS;
  return part * (scale * scale);
}
#endif

/* What a path brought, of VEC places, over what its throughput began with. */
triple found_at(global const float *restrict radiance, const ulong at, const uint places, const real begun) {
  float sum[3][VEC];
  for (uint lane = 0; lane < VEC; ++lane)
    for (uint channel = 0; channel < 3; ++channel)
      sum[channel][lane] = branch_sum(radiance + (at + lane) * (ulong)RADIANCE_FLOATS + channel, places);
  return scaled((triple){LOAD(sum[0]), LOAD(sum[1]), LOAD(sum[2])}, 1.0f / max(begun, (real)1e-30f));
}

kernel void share_paths(const uint first_point, const uint point_count, const uint total_points, const uint stride,
                        const uint places, const float most, global const uint *restrict order,
                        global const float *restrict surface, global const float *restrict hits,
                        global const float *restrict radiance, global const uchar *restrict visible,
                        global const float *restrict own_u, global const float *restrict own_v,
#if SHARES_DENSITY
                        global const uint *restrict density, global const float *restrict own_weight,
#endif
                        global float *restrict u, global float *restrict v, global float *restrict weight,
                        global float *restrict value) {
  const uint blocks = stride / VEC;
  const uint item = (uint)get_global_id(0);
  if (item >= point_count / MEMBERS * blocks) return;
  const uint first = item / blocks * MEMBERS;
  const uint block = item % blocks * VEC;
  const ulong value_plane = (ulong)places * MEMBERS;
  Member members[MEMBERS];
  for (uint k = 0; k < MEMBERS; ++k) members[k] = load_member(surface, total_points, order[first_point + first + k]);
  for (uint j = 0; j < MEMBERS; ++j) {
    const ulong own = (first + j) * (ulong)stride + block;
    const Place place = load_place(hits, places, own, &members[j], LOAD(own_u + own));
    const triple found = found_at(radiance, own, places, LOAD(HIT_PLANE(SHARED_BEGUN) + own));
    const whole shared = place.offset > 0.0f;
    /* One over the density of the sample in its own square. */
#if SHARES_DENSITY
    const real inverse = LOAD(own_weight + own);
#else
    const real inverse = (real)1.0f;
#endif
    float part[MEMBERS][VEC];
    real total = (real)0.0f;
    for (uint k = 0; k < MEMBERS; ++k) {
      const ulong entry = ((first + k) * (ulong)MEMBERS + j) * stride + block;
      float seen[VEC];
      for (uint lane = 0; lane < VEC; ++lane) seen[lane] = (float)visible[entry + lane];
      triple towards;
      const real open = place_density(&members[k], &place, &towards) * LOAD(seen);
      real to_u, to_v;
      if (k == j) {
        to_u = LOAD(own_u + own);
        to_v = LOAD(own_v + own);
        towards = sample_scattering(&members[k].s, to_u, to_v);
      } else {
        square_of(&members[k], towards, &to_u, &to_v);
      }
      const triple throughput = bounce_throughput(&members[k].s, members[k].geometric_normal, towards,
                                                  scattering_density(&members[k].s, towards));
      const triple brought = product(throughput, found);
      const real largest = largest_of(brought);
      const real capped = SELECT((real)1.0f, (real)most / largest, largest > most);
      STORE(brought.x * capped, value + entry);
      STORE(brought.y * capped, value + value_plane + entry);
      STORE(brought.z * capped, value + 2 * value_plane + entry);
      STORE(to_u, u + entry);
      STORE(to_v, v + entry);
      STORE(open, part[k]);
#if SHARES_DENSITY
      global const uint *record = density + (ulong)order[first_point + first + k] * DENSITY_WORDS;
      total += open * (k == j ? 1.0f / inverse : density_at(record, to_u, to_v));
#else
      total += open;
#endif
    }
    const real scale = (float)MEMBERS / max(total, (real)1e-37f);
    for (uint k = 0; k < MEMBERS; ++k) {
      const ulong entry = ((first + k) * (ulong)MEMBERS + j) * stride + block;
      const real alone = k == j ? (float)MEMBERS * inverse : (real)0.0f;
      STORE(SELECT(alone, LOAD(part[k]) * scale, shared), weight + entry);
    }
  }
}
#endif
