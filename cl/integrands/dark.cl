/* Points that no light and no sun can reach, whatever is in the way, by where they face.
 *
 * A cosine times a distance is affine on a light, so its signs at the light's corners decide; of a ball its
 * highest value is that at the centre, and the radius more. Points must see the light by both normals, and
 * be on the side of it that shines. Suns are as far as any.
 *
 * `wide` is double where the device has it (WIDE_DOUBLE). In float a point is dark only if it is by more than
 * rounding may be, MARGIN of the terms (0 in double): points that are only just dark are sampled, for nothing.
 *
 * Memory layout: `surface` as in surface.cl; lights of DARK_LIGHT_FLOATS numbers, suns of DARK_SUN_FLOATS,
 * see dark.py.
 *
 * Work-group contract: none; one work-item a point.
 */

#if WIDE_DOUBLE
#pragma OPENCL EXTENSION cl_khr_fp64 : enable
typedef double wide;
#define TO_WIDE(x) convert_double(x)
#else
typedef float wide;
#define TO_WIDE(x) (x)
#endif
/* As on the host. */
#pragma OPENCL FP_CONTRACT OFF

typedef struct {
  wide x, y, z;
} WideVector;

WideVector widened(const float3 v) { return (WideVector){TO_WIDE(v.x), TO_WIDE(v.y), TO_WIDE(v.z)}; }

WideVector load_wide(global const wide *restrict from) { return (WideVector){from[0], from[1], from[2]}; }

wide dot_wide(const WideVector a, const WideVector b) { return a.x * b.x + a.y * b.y + a.z * b.z; }

/* What rounding may have made of the product of two vectors. */
wide doubt(const WideVector a, const WideVector b) {
  return (wide)MARGIN * (fabs(a.x * b.x) + fabs(a.y * b.y) + fabs(a.z * b.z));
}

/* Whether all of a light is behind the plane through a point. */
bool is_behind(global const wide *restrict light, const WideVector position, const WideVector normal) {
  const wide height = dot_wide(normal, position) - doubt(normal, position);
  for (uint corner = 0; corner < 4; ++corner) {
    const WideVector place = load_wide(light + DARK_LIGHT_CORNERS + 3 * corner);
    if (dot_wide(place, normal) + light[DARK_LIGHT_REACH] + doubt(place, normal) > height) return false;
  }
  return true;
}

/* Whether neither normal lets the sun's disc be seen: `least` is the cosine of the last angle from which it is. */
bool is_below(global const wide *restrict suns, const uint sun_count, const WideVector normal) {
  for (uint sun = 0; sun < sun_count; ++sun) {
    global const wide *own = suns + sun * DARK_SUN_FLOATS;
    const WideVector towards = load_wide(own + DARK_SUN_TOWARDS);
    if (dot_wide(towards, normal) + doubt(towards, normal) > own[DARK_SUN_LEAST]) return false;
  }
  return true;
}

kernel void find_dark(const uint point_count, const uint total_points, const uint light_count, const uint sun_count,
                      global const float *restrict surface, global const wide *restrict lights,
                      global const wide *restrict suns, global uchar *restrict dark) {
  const uint point = (uint)get_global_id(0);
  if (point >= point_count) return;
  const WideVector position = widened(load_row3(surface, total_points, ROW_POSITION, point));
  const WideVector normal = widened(load_row3(surface, total_points, ROW_NORMAL, point));
  const WideVector geometric_normal = widened(load_row3(surface, total_points, ROW_GEOMETRIC_NORMAL, point));
  bool is_dark = is_below(suns, sun_count, normal) || is_below(suns, sun_count, geometric_normal);
  for (uint number = 0; number < light_count && is_dark; ++number) {
    global const wide *light = lights + number * DARK_LIGHT_FLOATS;
    const WideVector side = load_wide(light + DARK_LIGHT_SIDE);
    is_dark = dot_wide(side, position) + doubt(side, position) <= light[DARK_LIGHT_LEVEL] ||
              is_behind(light, position, normal) || is_behind(light, position, geometric_normal);
  }
  dark[point] = is_dark ? 1 : 0;
}
