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
 * Members reflect some light. Where they have a lobe, its strip of the square is not shared, and cos_k / pi counts for the
 * rest of the square. `hits`: place.cl. What a lobe at the place sends depends on who looks, and counts for the member that
 * drew it alone. So a path's sums are kept in SLOTS: of each, keep_matte says how much the place's albedo scattered.
 *
 * A batch's entries: sample s that member j drew, as one of point p, is element (p * MEMBERS + j) * stride + s of
 * `visible`, `u`, `v`, `weight` and of each channel's plane of `value`.
 *
 * Joined after place.cl. With SHARES_DENSITY (warp.cl) samples follow the records in `density`.
 *
 * Work-group contract: one-dimensional, any size; where VEC is 1 share_rays has barriers, and two words of local memory
 * (wave.cl). A work-item of share_rays and share_paths has VEC samples of all members of a group.
 */

#if SHARED && !FOLLOWED
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
#if HAS_SPECULAR
  triple reflectance;
#endif
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
#if HAS_SPECULAR
  found.reflectance = (triple){LOAD(HIT_PLANE(SHARED_REFLECTANCE) + at), LOAD(HIT_PLANE(SHARED_REFLECTANCE + 1) + at),
                               LOAD(HIT_PLANE(SHARED_REFLECTANCE + 2) + at)};
#endif
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
  const uint items = point_count / MEMBERS * blocks;
  const bool is_item = get_global_id(0) < items;
  if (VEC > 1 && !is_item) return;
  GROUP_WORDS(words);
  const Sink to = {plane, wave, words};
  const uint item = min((uint)get_global_id(0), items - 1);
  const uint first = item / blocks * MEMBERS;
  const uint block = item % blocks * VEC;
#if !CASTERS
  (void)casters;
#endif
  for (uint j = 0; j < MEMBERS; ++j) {
    const ulong own = (first + j) * (ulong)stride + block;
    const Member finder = load_member(surface, total_points, order[first_point + first + j]);
    const Place place = load_place(hits, places, own, &finder, LOAD(own_u + own));
    /* Rays end off the surface. */
    const triple end = sum_of(place.position, place.geometric_normal, place.offset);
    for (uint k = 0; k < MEMBERS; ++k) {
      const ulong entry = ((first + k) * (ulong)MEMBERS + j) * stride + block;
      const Member member = load_member(surface, total_points, order[first_point + first + k]);
      Ray ray;
      const whole open = (place_density(&member, &place, &ray.direction) > 0.0f) && (whole)(k != j && is_item ? -1 : 0);
      ray.origin = member.origin;
      ray.direction = (triple){end.x - ray.origin.x, end.y - ray.origin.y, end.z - ray.origin.z};
#if CASTERS
      count_shadow_rays(open, &to);
      const whole seen = reaches_light(casters, ray.origin, ray.direction, open);
#else
      const whole seen = (whole)0;
      ray.throughput = (triple){(real)0.0f, (real)0.0f, (real)0.0f};
      ray.density = (real)0.0f;
      ray.strips = (whole)0;
      ray.path = LANE_NUMBER + (uint)entry;
      give_rays(&ray, open, 1, &to);
#endif
      int is_seen[VEC];
      STORE(seen, is_seen);
      for (uint lane = 0; is_item && lane < VEC; ++lane) visible[entry + lane] = is_seen[lane] != 0 || k == j ? 1 : 0;
    }
  }
}

kernel void share_seen(const uint plane, global const float *restrict wave, global uchar *restrict visible) {
  const uint count = shadow_rays_of(wave);
  for (uint ray = (uint)get_global_id(0); ray < count; ray += (uint)get_global_size(0))
    if (((global const uchar *)PLANE(wave, WAVE_LIT))[ray] != 0)
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
typedef struct {
  triple all;   /* to the member that drew it */
  triple matte; /* what the place's albedo scattered of it, but for what is lost on the way out */
} Found;

Found found_at(global const float *restrict radiance, global const float *restrict hits, const ulong at,
               const uint places) {
  real all[3], matte[3];
  const real inverse = 1.0f / max(LOAD(HIT_PLANE(SHARED_BEGUN) + at), (real)1e-30f);
#pragma unroll
  for (uint channel = 0; channel < 3; ++channel) {
    all[channel] = matte[channel] = (real)0.0f;
    for (uint slot = 0; slot < SLOTS; ++slot) {
      global const float *sums = radiance + (at + slot * (ulong)places) * RADIANCE_FLOATS + channel;
      float sum[VEC];
      for (uint lane = 0; lane < VEC; ++lane) sum[lane] = sums[lane * RADIANCE_FLOATS];
      const real brought = LOAD(sum) * inverse;
      all[channel] += brought;
#if HAS_SPECULAR
      matte[channel] = FMA(LOAD(MATTE_PLANE(slot, channel) + at), brought, matte[channel]);
#else
      matte[channel] += brought;
#endif
    }
  }
  return (Found){{all[0], all[1], all[2]}, {matte[0], matte[1], matte[2]}};
}

/* What leaves a place's albedo for a member. */
triple matte_from(const Found *found, const Place *place, const triple towards) {
#if HAS_SPECULAR
  const real weight = schlick_weight(-dot_triple(place->normal, towards));
  return (triple){found->matte.x * left_by_lobe(place->reflectance.x, weight),
                  found->matte.y * left_by_lobe(place->reflectance.y, weight),
                  found->matte.z * left_by_lobe(place->reflectance.z, weight)};
#else
  (void)place, (void)towards;
  return found->matte;
#endif
}

/* One over by how much more than `most` is brought, or 1. */
real capped_by(const triple brought, const float most) {
  const real largest = largest_of(brought);
  return SELECT((real)1.0f, (real)most / largest, largest > most);
}

void store_value(const triple brought, const ulong plane, global float *restrict value) {
  STORE(brought.x, value);
  STORE(brought.y, value + plane);
  STORE(brought.z, value + 2 * plane);
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
  for (uint j = 0; j < MEMBERS; ++j) {
    const ulong own = (first + j) * (ulong)stride + block;
    const Member finder = load_member(surface, total_points, order[first_point + first + j]);
    const Place place = load_place(hits, places, own, &finder, LOAD(own_u + own));
    const Found found = found_at(radiance, hits, own, places);
    const whole shared = place.offset > 0.0f;
    /* One over the density of the sample in its own square. */
#if SHARES_DENSITY
    const real inverse = LOAD(own_weight + own);
#else
    const real inverse = (real)1.0f;
#endif
    const triple zero = {(real)0.0f, (real)0.0f, (real)0.0f};
    triple own_matte = zero;
    triple own_all = zero;
    real total = (real)0.0f;
    for (uint k = 0; k < MEMBERS; ++k) {
      const ulong entry = ((first + k) * (ulong)MEMBERS + j) * stride + block;
      const uint point = order[first_point + first + k];
      const Member member = load_member(surface, total_points, point);
      float seen[VEC];
#pragma unroll
      for (uint lane = 0; lane < VEC; ++lane) seen[lane] = (float)visible[entry + lane];
      triple towards;
      const real open = place_density(&member, &place, &towards) * LOAD(seen);
      real to_u, to_v;
      if (k == j) {
        to_u = LOAD(own_u + own);
        to_v = LOAD(own_v + own);
        towards = sample_scattering(&member.s, to_u, to_v);
      } else {
        square_of(&member, towards, &to_u, &to_v);
      }
      const triple throughput = bounce_throughput(&member.s, member.geometric_normal, towards,
                                                  scattering_density(&member.s, towards));
      const triple matte = product(throughput, matte_from(&found, &place, towards));
      if (k == j) {
        own_matte = matte;
        own_all = product(throughput, found.all);
      }
      store_value(scaled(matte, capped_by(matte, most)), value_plane, value + entry);
      STORE(to_u, u + entry);
      STORE(to_v, v + entry);
      /* Until the sum is known. */
      STORE(open, weight + entry);
#if SHARES_DENSITY
      global const uint *record = density + (ulong)point * DENSITY_WORDS;
      total += open * (k == j ? 1.0f / inverse : density_at(record, to_u, to_v));
#else
      total += open;
#endif
    }
    const real scale = (float)MEMBERS / max(total, (real)1e-37f);
    for (uint k = 0; k < MEMBERS; ++k) {
      const ulong entry = ((first + k) * (ulong)MEMBERS + j) * stride + block;
      const real alone = k == j ? (float)MEMBERS * inverse : (real)0.0f;
      const real counts = SELECT(alone, LOAD(weight + entry) * scale, shared);
      STORE(counts, weight + entry);
      if (k == j) {
        /* What a lobe at the place sends is this member's alone. */
        const real ratio = SELECT((real)1.0f, alone / counts, shared && (counts > 0.0f));
        const triple brought = sum_of(scaled(own_matte, 1.0f - ratio), own_all, ratio);
        store_value(scaled(brought, capped_by(own_all, most)), value_plane, value + entry);
      }
    }
  }
}
#endif
