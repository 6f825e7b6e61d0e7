/* A shading point as kernels see it: everything that is fixed while (u, v) varies.
 *
 * Memory layout: one float buffer `surface`, structure of arrays: row r of point p at
 * surface[r * total_points + p]. The ROW_* constants come from points.py.
 *
 * Work-group contract: none; pure functions of private values.
 */

typedef struct {
  float3 position;         /* on the surface, about the scene's origin */
  float3 normal;           /* shading normal, unit, on the viewer's side */
  float3 geometric_normal; /* of the triangle, unit, on the viewer's side */
  float3 outgoing;         /* unit, towards the viewer */
  float offset;            /* how far ray origins are moved along geometric_normal */
  float3 albedo;
  float3 reflectance;      /* at normal incidence */
  float roughness;
  float eta;               /* of glass, see bsdf.cl; 0 of other surfaces */
  float lobe_share;        /* of the unit square, see lobe.cl; 0 until that is found */
  float detached;          /* 1: on no surface of the scene but a light, else 0 */
} ShadingPoint;

float3 load_row3(global const float *restrict surface, const uint total_points, const uint row,
                 const uint point) {
  const ulong stride = total_points;
  return (float3)(surface[row * stride + point], surface[(row + 1u) * stride + point],
                  surface[(row + 2u) * stride + point]);
}

/* Vectors in space, one a lane. */
typedef struct {
  real x, y, z;
} triple;

triple to_triple(const float3 v) { return (triple){(real)v.x, (real)v.y, (real)v.z}; }

triple gather_triple(global const float *restrict array, const whole at) {
  return (triple){gather(array, at), gather(array, at + 1), gather(array, at + 2)};
}

real dot_triple(const triple a, const triple b) { return a.x * b.x + a.y * b.y + a.z * b.z; }

triple select_triple(const triple a, const triple b, const whole condition) {
  return (triple){SELECT(a.x, b.x, condition), SELECT(a.y, b.y, condition), SELECT(a.z, b.z, condition)};
}

ShadingPoint load_shading_point(global const float *restrict surface, const uint total_points,
                                const uint point) {
  const ulong stride = total_points;
  ShadingPoint p;
  p.position = load_row3(surface, total_points, ROW_POSITION, point);
  p.normal = load_row3(surface, total_points, ROW_NORMAL, point);
  p.geometric_normal = load_row3(surface, total_points, ROW_GEOMETRIC_NORMAL, point);
  p.outgoing = load_row3(surface, total_points, ROW_OUTGOING, point);
  p.offset = surface[ROW_OFFSET * stride + point];
  p.albedo = load_row3(surface, total_points, ROW_ALBEDO, point);
  p.reflectance = load_row3(surface, total_points, ROW_REFLECTANCE, point);
  p.roughness = surface[ROW_ROUGHNESS * stride + point];
  p.eta = surface[ROW_ETA * stride + point];
  p.lobe_share = surface[ROW_LOBE_SHARE * stride + point];
  p.detached = surface[ROW_DETACHED * stride + point];
  return p;
}

float largest(const float3 x) { return fmax(fabs(x.x), fmax(fabs(x.y), fabs(x.z))); }

/* How far rays start off a surface: RELATIVE_OFFSET times the coordinates whose rounding can move the
 * hit. These are the position's own and, since a ray tracer subtracts the ray's origin from a triangle's
 * corners, the corners' distance from the position. Of the latter only the part along the normal
 * matters: `spread` bounds it for a triangle whose box has size `extent`. */
float triangle_spread(const float3 extent, const float3 normal) {
  return dot(fabs(normal), extent) + LEAST_SPREAD * largest(extent);
}

float surface_offset(const float3 position, const float spread) {
  return RELATIVE_OFFSET * (largest(position) + spread);
}

/* Where rays that leave on the geometric normal's side start. */
float3 ray_origin(const ShadingPoint *p) { return p->position + p->offset * p->geometric_normal; }

/* Two unit vectors that complete `n` to a right-handed frame (Duff et al. 2017, JCGT 6(1)). */
void tangent_frame(const float3 n, float3 *tangent, float3 *bitangent) {
  const float sign = copysign(1.0f, n.z);
  const float a = -1.0f / (sign + n.z);
  const float b = n.x * n.y * a;
  *tangent = (float3)(1.0f + sign * n.x * n.x * a, sign * b, -sign * n.x);
  *bitangent = (float3)(b, sign + n.y * n.y * a, -n.y);
}
