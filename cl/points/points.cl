/* Camera rays, and shading points from what they hit.
 *
 * camera_rays: one work-item a sub-pixel of a regular grid (supersampling k makes k*k sub-pixels of a
 * pixel, each an integral of its own); writes origins and directions as embree reads them, three
 * floats a ray, into host-visible memory.
 *
 * shading_points: one work-item a hit; barycentric interpolation instead of origin + t * direction, so
 * that the position's error is a few ulps of the triangle's coordinates and not of the distance.
 * Writes the rows of surface.cl. Joined after surface.cl.
 *
 * placed_points: one work-item a point that was given by position, normal and direction of view, three floats each,
 * and the triangle that it lies on, or -1: that one's normal and size are taken then, by the rules of shading_points.
 * `detached` is copied.
 *
 * camera: a record of CAMERA in points.py: position, forward, right * tan(fov/2) * aspect, up * tan(fov/2). A
 * record of MATERIAL there for each material.
 *
 * Work-group contract: one-dimensional, any size, no local memory, no barriers.
 */

float3 load3(global const float *restrict array, const ulong index) {
  return (float3)(array[3 * index], array[3 * index + 1], array[3 * index + 2]);
}

/* Unit direction through the centre of sub-pixel `cell` of a `columns` x `rows` grid. */
float3 camera_direction(global const float *restrict camera, const uint cell, const uint columns,
                        const uint rows) {
  const float x = ((float)(cell % columns) + 0.5f) / (float)columns * 2.0f - 1.0f;
  const float y = 1.0f - ((float)(cell / columns) + 0.5f) / (float)rows * 2.0f;
  return normalize(vload3(0, camera + CAMERA_FORWARD) + x * vload3(0, camera + CAMERA_RIGHT) +
                   y * vload3(0, camera + CAMERA_UP));
}

kernel void camera_rays(global const float *restrict camera, const uint first_cell, const uint count,
                        const uint columns, const uint rows, global float *restrict origins,
                        global float *restrict directions) {
  const uint ray = (uint)get_global_id(0);
  if (ray >= count) return;
  vstore3(vload3(0, camera + CAMERA_POSITION), ray, origins);
  vstore3(camera_direction(camera, first_cell + ray, columns, rows), ray, directions);
}

void store_row3(global float *restrict surface, const uint total_points, const uint row,
                const uint point, const float3 value) {
  const ulong stride = total_points;
  surface[row * stride + point] = value.x;
  surface[(row + 1u) * stride + point] = value.y;
  surface[(row + 2u) * stride + point] = value.z;
}

/* A triangle's normal, unit, by the order of its corners. The edges are scaled before the cross product, whose squared
 * length would leave float's range for very small triangles. */
float3 front_normal(const float3 vertex0, const float3 vertex1, const float3 vertex2) {
  const float3 edge1 = vertex1 - vertex0;
  const float3 edge2 = vertex2 - vertex0;
  const float3 scaled1 = edge1 / largest(edge1);
  const float3 scaled2 = edge2 / largest(edge2);
  return normalize(cross(scaled1, scaled2));
}

/* Surfaces are two-sided: this normal on the side of a direction. */
float3 triangle_normal(const float3 vertex0, const float3 vertex1, const float3 vertex2, const float3 towards) {
  const float3 normal = front_normal(vertex0, vertex1, vertex2);
  return dot(normal, towards) < 0.0f ? -normal : normal;
}

/* `eta` of bsdf.cl, of a material's `ior` as a viewer on the front or behind sees it. */
float relative_index(const float ior, const bool is_front) { return is_front || ior <= 0.0f ? ior : 1.0f / ior; }

/* The size of a triangle's box. */
float3 triangle_extent(const float3 vertex0, const float3 vertex1, const float3 vertex2) {
  return fmax(vertex0, fmax(vertex1, vertex2)) - fmin(vertex0, fmin(vertex1, vertex2));
}

void store_place(global float *restrict surface, const uint total_points, const uint point, const float3 position,
                 const float3 normal, const float3 geometric_normal, const float3 outgoing, const float spread) {
  const ulong stride = total_points;
  store_row3(surface, total_points, ROW_POSITION, point, position);
  store_row3(surface, total_points, ROW_NORMAL, point, normal);
  store_row3(surface, total_points, ROW_GEOMETRIC_NORMAL, point, geometric_normal);
  store_row3(surface, total_points, ROW_OUTGOING, point, outgoing);
  surface[ROW_OFFSET * stride + point] = surface_offset(position, spread);
  surface[ROW_LOBE_SHARE * stride + point] = 0.0f;
  surface[ROW_DETACHED * stride + point] = 0.0f;
}

void store_material(global float *restrict surface, const uint total_points, const uint point,
                    global const float *restrict material, const bool is_front) {
  const ulong stride = total_points;
  for (uint i = 0; i < 3; ++i) {
    surface[(ROW_ALBEDO + i) * stride + point] = material[MATERIAL_ALBEDO + i];
    surface[(ROW_REFLECTANCE + i) * stride + point] = material[MATERIAL_REFLECTANCE + i];
  }
  surface[ROW_ROUGHNESS * stride + point] = material[MATERIAL_ROUGHNESS];
  surface[ROW_ETA * stride + point] = relative_index(material[MATERIAL_IOR], is_front);
}

kernel void shading_points(global const float *restrict camera, const uint columns, const uint rows,
                           const uint total_points, global const uint *restrict cells,
                           global const uint *restrict hit_triangle, global const float *restrict hit_u,
                           global const float *restrict hit_v, global const float *restrict vertices,
                           global const float *restrict vertex_normals,
                           global const uint *restrict triangles,
                           global const int *restrict triangle_material,
                           global const float *restrict materials, global float *restrict surface) {
  const uint point = (uint)get_global_id(0);
  if (point >= total_points) return;
  const uint triangle = hit_triangle[point];
  const uint corner0 = triangles[3 * (ulong)triangle];
  const uint corner1 = triangles[3 * (ulong)triangle + 1];
  const uint corner2 = triangles[3 * (ulong)triangle + 2];
  const float3 vertex0 = load3(vertices, corner0);
  const float3 vertex1 = load3(vertices, corner1);
  const float3 vertex2 = load3(vertices, corner2);
  const float b1 = hit_u[point];
  const float b2 = hit_v[point];
  const float b0 = 1.0f - b1 - b2;
  const float3 outgoing = -camera_direction(camera, cells[point], columns, rows);

  const float3 geometric_normal = triangle_normal(vertex0, vertex1, vertex2, outgoing);
  float3 normal = b0 * load3(vertex_normals, corner0) + b1 * load3(vertex_normals, corner1) +
                  b2 * load3(vertex_normals, corner2);
  if (dot(normal, geometric_normal) < 0.0f) normal = -normal;
  /* Both normals turn towards the viewer. Flat triangles carry zero normals; an interpolated normal that turns away from the viewer, as at
   * silhouettes of coarse meshes, would make the surface black. */
  const float length2 = dot(normal, normal);
  normal = length2 > 0.0f ? normal * rsqrt(length2) : geometric_normal;
  if (dot(normal, outgoing) <= 0.0f) normal = geometric_normal;

  const float3 position = b0 * vertex0 + b1 * vertex1 + b2 * vertex2;
  const float spread = triangle_spread(triangle_extent(vertex0, vertex1, vertex2), geometric_normal);
  store_place(surface, total_points, point, position, normal, geometric_normal, outgoing, spread);
  const bool is_front = dot(front_normal(vertex0, vertex1, vertex2), geometric_normal) > 0.0f;
  store_material(surface, total_points, point, materials + (ulong)triangle_material[triangle] * MATERIAL_FLOATS,
                 is_front);
}

kernel void placed_points(const uint total_points, global const float *restrict positions,
                          global const float *restrict normals, global const float *restrict outgoings,
                          global const int *restrict on_triangle, global const float *restrict detached,
                          global const uint *restrict point_material, global const float *restrict vertices,
                          global const uint *restrict triangles,
                          global const float *restrict materials, global float *restrict surface) {
  const uint point = (uint)get_global_id(0);
  if (point >= total_points) return;
  const int triangle = on_triangle[point];
  const float3 outgoing = load3(outgoings, point);
  float3 normal = load3(normals, point);
  float3 geometric_normal = normal;
  float spread = 0.0f;
  bool is_front = true;
  if (triangle >= 0) {
    const float3 vertex0 = load3(vertices, triangles[3 * (ulong)triangle]);
    const float3 vertex1 = load3(vertices, triangles[3 * (ulong)triangle + 1]);
    const float3 vertex2 = load3(vertices, triangles[3 * (ulong)triangle + 2]);
    geometric_normal = triangle_normal(vertex0, vertex1, vertex2, outgoing);
    is_front = dot(front_normal(vertex0, vertex1, vertex2), geometric_normal) > 0.0f;
    spread = triangle_spread(triangle_extent(vertex0, vertex1, vertex2), geometric_normal);
    if (dot(normal, geometric_normal) < 0.0f) normal = -normal;
    if (dot(normal, outgoing) <= 0.0f) normal = geometric_normal;
  }
  store_place(surface, total_points, point, load3(positions, point), normal, geometric_normal, outgoing, spread);
  surface[ROW_DETACHED * (ulong)total_points + point] = detached[point];
  store_material(surface, total_points, point, materials + (ulong)point_material[point] * MATERIAL_FLOATS, is_front);
}

/* Work-item (i, r): row r of the point that is taken i-th. */
kernel void take_points(const uint count, const uint total_points, global const uint *restrict order,
                        global const float *restrict surface, global float *restrict taken) {
  const uint i = (uint)get_global_id(0);
  const ulong row = get_global_id(1);
  if (i < count) taken[row * count + i] = surface[row * total_points + order[i]];
}
