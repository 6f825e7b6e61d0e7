/* Images on surfaces, looked up at texture coordinates.
 *
 * `textures`: records of TEXTURE in textures.py. `texels`: all images one after another, four halves a texel: linear
 * red, green, blue, and alpha; of an image row after row, the lowest first. Coordinates (0, 0) are the lower left
 * corner of an image, (1, 1) the upper right one, and texels stand for their centres. Beyond its sides an image is
 * repeated or mirrored, or goes on as its border is.
 *
 * Joined after bsdf.cl. Half precision is only read: that needs no extension.
 *
 * Work-group contract: none; pure functions of private values and of constant buffers.
 */

typedef struct {
  whole first, second; /* two neighbours in a row or column of texels */
  real weight;         /* of the second */
} Neighbours;

/* The texels about a coordinate along an axis of `size` texels. */
Neighbours neighbours_of(const real coordinate, const bits size, const bits wrap, const whole is_nearest) {
  const whole repeats = wrap == (bits)WRAP_REPEAT;
  const whole mirrors = wrap == (bits)WRAP_MIRROR;
  const real repeated = coordinate - floor(coordinate);
  const real mirrored = 1.0f - fabs(coordinate - 2.0f * floor(0.5f * coordinate) - 1.0f);
  const real clamped = clamp(coordinate, (real)0.0f, (real)1.0f);
  const real inside = SELECT(SELECT(clamped, mirrored, mirrors), repeated, repeats);
  const whole last = TO_WHOLE(size) - 1;
  const real place = FMA(inside, TO_REAL(size), (real)-0.5f);
  const real at = SELECT(place, floor(place + 0.5f), is_nearest);
  const real before = floor(at);
  const whole first = clamp(TO_WHOLE(before), (whole)-1, last);
  const whole second = first + 1;
  Neighbours found;
  found.weight = at - before;
  /* A coordinate whose fraction rounds to 1 is behind the last texel. */
  found.first = SELECT(first, SELECT((whole)0, last, repeats), first < 0);
  found.second = SELECT(second, SELECT(last, (whole)0, repeats), second > last);
  return found;
}

/* Red, green and blue of VEC textures at VEC coordinates, each in its lane; 1 where a texture's index is negative. */
triple texture_at(global const uint *restrict textures, global const half *restrict texels, const whole texture,
                  const real u, const real v) {
  const bits record = TO_BITS(max(texture, (whole)0)) * TEXTURE_WORDS;
  const bits width = gather_bits(textures, record + TEXTURE_WIDTH);
  const whole is_nearest = gather_bits(textures, record + TEXTURE_NEAREST) != (bits)0;
  const Neighbours column =
      neighbours_of(u, width, gather_bits(textures, record + TEXTURE_WRAP_U), is_nearest);
  const Neighbours row = neighbours_of(v, gather_bits(textures, record + TEXTURE_HEIGHT),
                                       gather_bits(textures, record + TEXTURE_WRAP_V), is_nearest);
  const bits first = gather_bits(textures, record + TEXTURE_FIRST);
  const bits lower = first + TO_BITS(row.first) * width;
  const bits upper = first + TO_BITS(row.second) * width;
  uint place[4][VEC];
  float across[VEC], up[VEC];
  float red[VEC], green[VEC], blue[VEC];
  STORE(lower + TO_BITS(column.first), place[0]);
  STORE(lower + TO_BITS(column.second), place[1]);
  STORE(upper + TO_BITS(column.first), place[2]);
  STORE(upper + TO_BITS(column.second), place[3]);
  STORE(column.weight, across);
  STORE(row.weight, up);
  for (uint lane = 0; lane < VEC; ++lane) {
    const float4 low = mix(vload_half4(place[0][lane], texels), vload_half4(place[1][lane], texels), across[lane]);
    const float4 high = mix(vload_half4(place[2][lane], texels), vload_half4(place[3][lane], texels), across[lane]);
    const float4 colour = mix(low, high, up[lane]);
    red[lane] = colour.x;
    green[lane] = colour.y;
    blue[lane] = colour.z;
  }
  const whole is_there = texture >= 0;
  return (triple){SELECT((real)1.0f, LOAD(red), is_there), SELECT((real)1.0f, LOAD(green), is_there),
                  SELECT((real)1.0f, LOAD(blue), is_there)};
}

real interpolated(const real a, const real b, const real c, const real b1, const real b2) {
  return FMA(b2, c, FMA(b1, b, (1.0f - b1 - b2) * a));
}

triple product(const triple a, const triple b) { return (triple){a.x * b.x, a.y * b.y, a.z * b.z}; }

#if HAS_TEXTURES
/* Texture coordinates where rays hit. */
void coordinates_at(global const float *restrict triangles, const whole at, const real b1, const real b2, real *u,
                    real *v) {
  const whole uv = at + TRIANGLE_UV_0;
  *u = interpolated(gather(triangles, uv), gather(triangles, uv + 2), gather(triangles, uv + 4), b1, b2);
  *v = interpolated(gather(triangles, uv + 1), gather(triangles, uv + 3), gather(triangles, uv + 5), b1, b2);
}
#endif

#if HAS_NORMAL_MAPS
/* Bends the shading normals of surfaces that have a texture for that, where the viewer would still be above them: as
 * textures/normals.py does it. */
void bend_normal(global const float *restrict triangles, global const uint *restrict textures,
                 global const half *restrict texels, const whole at, const real b1, const real b2, Scatterer *s) {
  const whole texture = TO_WHOLE(gather(triangles, at + TRIANGLE_NORMAL_TEXTURE));
  if (!ANY(texture >= 0)) return;
  real u, v;
  coordinates_at(triangles, at, b1, b2, &u, &v);
  const triple colour = texture_at(textures, texels, texture, u, v);
  const real scale = gather(triangles, at + TRIANGLE_NORMAL_SCALE);
  const real x = scale * FMA((real)2.0f, colour.x, (real)-1.0f);
  const real y = scale * FMA((real)2.0f, colour.y, (real)-1.0f) * gather(triangles, at + TRIANGLE_SIDE);
  const real z = FMA((real)2.0f, colour.z, (real)-1.0f);
  const real facing =
      SELECT((real)1.0f, (real)-1.0f, dot_triple(gather_triple(triangles, at + TRIANGLE_NORMAL), s->outgoing) < 0.0f);
  const triple own = {facing * s->normal.x, facing * s->normal.y, facing * s->normal.z};
  triple t = gather_triple(triangles, at + TRIANGLE_TANGENT);
  const real along = dot_triple(t, own);
  t = (triple){t.x - along * own.x, t.y - along * own.y, t.z - along * own.z};
  const real across2 = dot_triple(t, t);
  const real unit = rsqrt(max(across2, (real)1e-30f));
  t = (triple){t.x * unit, t.y * unit, t.z * unit};
  const triple b = {own.y * t.z - own.z * t.y, own.z * t.x - own.x * t.z, own.x * t.y - own.y * t.x};
  const triple bent = {x * t.x + y * b.x + z * own.x, x * t.y + y * b.y + z * own.y, x * t.z + y * b.z + z * own.z};
  const real inverse = facing * rsqrt(max(dot_triple(bent, bent), (real)1e-30f));
  const triple normal = {bent.x * inverse, bent.y * inverse, bent.z * inverse};
  const whole usable = (texture >= 0) && (across2 > 1e-12f) && (dot_triple(normal, s->outgoing) > 0.0f);
  s->normal.x = SELECT(s->normal.x, normal.x, usable);
  s->normal.y = SELECT(s->normal.y, normal.y, usable);
  s->normal.z = SELECT(s->normal.z, normal.z, usable);
}
#endif

#if HAS_EMISSION
/* What surfaces emit where rays hit them. */
triple emission_at(global const float *restrict triangles, global const uint *restrict textures,
                   global const half *restrict texels, const whole at, const real b1, const real b2) {
  triple emission = gather_triple(triangles, at + TRIANGLE_EMISSION);
#if HAS_TEXTURES
  const whole texture = TO_WHOLE(gather(triangles, at + TRIANGLE_EMISSION_TEXTURE));
  if (ANY(texture >= 0)) {
    real u, v;
    coordinates_at(triangles, at, b1, b2, &u, &v);
    emission = product(emission, texture_at(textures, texels, texture, u, v));
  }
#endif
  (void)textures, (void)texels, (void)b1, (void)b2;
  return emission;
}
#endif

/* Puts in what textures and colours of vertices make of the surfaces that rays hit: `at` are their triangles' records
 * (triangles.py), `b1` and `b2` the shares of corners 1 and 2. */
void vary_surface(global const float *restrict triangles, global const uint *restrict textures,
                  global const half *restrict texels, const whole at, const real b1, const real b2, Scatterer *s) {
#if HAS_COLOURS
  const triple colour0 = gather_triple(triangles, at + TRIANGLE_COLOUR_0);
  const triple colour1 = gather_triple(triangles, at + TRIANGLE_COLOUR_1);
  const triple colour2 = gather_triple(triangles, at + TRIANGLE_COLOUR_2);
  const triple colour = {interpolated(colour0.x, colour1.x, colour2.x, b1, b2),
                         interpolated(colour0.y, colour1.y, colour2.y, b1, b2),
                         interpolated(colour0.z, colour1.z, colour2.z, b1, b2)};
  s->albedo = product(s->albedo, colour);
#endif
#if HAS_TEXTURES
  real u, v;
  coordinates_at(triangles, at, b1, b2, &u, &v);
  const whole texture = TO_WHOLE(gather(triangles, at + TRIANGLE_TEXTURE));
  if (ANY(texture >= 0)) s->albedo = product(s->albedo, texture_at(textures, texels, texture, u, v));
#endif
#if HAS_NORMAL_MAPS
  bend_normal(triangles, textures, texels, at, b1, b2, s);
#endif
#if HAS_SPECULAR && (HAS_TEXTURES || HAS_COLOURS)
  real metallic = gather(triangles, at + TRIANGLE_METALLIC);
#if HAS_TEXTURES
  const whole of_surface = TO_WHOLE(gather(triangles, at + TRIANGLE_SURFACE_TEXTURE));
  if (ANY(of_surface >= 0)) {
    const triple factors = texture_at(textures, texels, of_surface, u, v);
    s->roughness = clamp(s->roughness * factors.y, (real)SMALLEST_ROUGHNESS, (real)1.0f);
    metallic *= factors.z;
  }
#endif
  const real matte = 1.0f - metallic;
  const triple base = s->albedo;
  s->albedo = (triple){base.x * matte, base.y * matte, base.z * matte};
  s->reflectance.x = FMA(s->reflectance.x, matte, base.x * metallic);
  s->reflectance.y = FMA(s->reflectance.y, matte, base.y * metallic);
  s->reflectance.z = FMA(s->reflectance.z, matte, base.z * metallic);
#endif
  (void)triangles, (void)textures, (void)texels, (void)at, (void)b1, (void)b2, (void)s;
}
