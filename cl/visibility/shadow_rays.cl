/* Answers the rays of a batch of samples on the device, so that the host need not even know how many there are.
 *
 * Joined after trace.cl. Rays are laid out as samples.cl appends them; `visible` gets a byte each, 1 where nothing lies
 * between 0 and the ray's distance. `totals`: what the three words of `ray_count` were in all batches together.
 *
 * Work-group contract: one-dimensional, any size, no local memory, no barriers; find_visible is one work-item a ray,
 * add_counts one in all.
 */

kernel void find_visible(const float extent, global const uint *restrict levels, global const float *restrict boxes,
                         global const float *restrict triangles, global const uint *restrict ray_count,
                         global const float *restrict origins, global const float *restrict directions,
                         global const float *restrict distances, global uchar *restrict visible) {
  const uint ray = (uint)get_global_id(0);
  if (ray >= ray_count[0]) return;
  const Tree tree = {levels, boxes, triangles, extent};
  visible[ray] = is_blocked(&tree, vload3(ray, origins), vload3(ray, directions), distances[ray]) ? 0 : 1;
}

kernel void add_counts(global const uint *restrict ray_count, global ulong *restrict totals) {
  if (get_global_id(0) != 0) return;
  for (uint k = 0; k < 3; ++k) totals[k] += ray_count[k];
}
