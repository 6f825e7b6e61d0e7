/* phi -> features: a hash grid over position, one-blobs over directions, identities.
 *
 * Points are taken in any order: `order[i]` is the shading point of feature column i (training shuffles
 * points into minibatches). Features are structure of arrays, feature f of column i at
 * features[f * stride + i]; the grid's GRID_LEVELS * GRID_FEATURES rows come first, then the inputs with
 * USE_* set, in the order below.
 *
 * Hash grid (Mueller et al. 2022): level l has GRID_BASE * 2^l cells an axis over the scene's bounding
 * cube; a level whose corners fit into GRID_ENTRIES is stored densely, else hashed. Entry e of level l,
 * feature f, at table[(l * GRID_ENTRIES + e) * GRID_FEATURES + f]. Points do not move, so corner entries
 * and trilinear weights are found once: corner k of level l of column i at [(l * 8 + k) * stride + i].
 *
 * One-blob (Mueller et al. 2019): BLOB_BINS Gaussians of deviation 1 / BLOB_BINS at the bins' centres;
 * around the azimuth it wraps. Directions are polar angle / pi and azimuth / 2 pi.
 *
 * Work-group contract: one-dimensional, any size, no local memory, no barriers; one work-item a column.
 */

void one_blob(const float x, const int wraps, global float *restrict features, const ulong stride) {
  for (uint bin = 0; bin < BLOB_BINS; ++bin) {
    float distance = fabs(x - ((float)bin + 0.5f) / (float)BLOB_BINS);
    if (wraps) distance = fmin(distance, 1.0f - distance);
    distance *= (float)BLOB_BINS;
    features[bin * stride] = exp(-0.5f * distance * distance);
  }
}

void direction_blobs(const float3 direction, global float *restrict features, const ulong stride) {
  one_blob(acos(clamp(direction.z, -1.0f, 1.0f)) * M_1_PI_F, 0, features, stride);
  one_blob(atan2(direction.y, direction.x) * (0.5f * M_1_PI_F) + 0.5f, 1, features + BLOB_BINS * stride,
           stride);
}

#if FEATURES > GRID_LEVELS * GRID_FEATURES
/* The rows after the grid's; they never change, so once per image is enough. */
kernel void encode_fixed(const uint count, const uint stride, const uint total_points,
                         global const uint *restrict order, global const float *restrict surface,
                         global float *restrict features) {
  const uint column = (uint)get_global_id(0);
  if (column >= count) return;
  const ShadingPoint p = load_shading_point(surface, total_points, order[column]);
  global float *restrict row = features + GRID_LEVELS * GRID_FEATURES * (ulong)stride + column;
#if USE_NORMAL
  direction_blobs(p.normal, row, stride);
  row += 2 * BLOB_BINS * (ulong)stride;
#endif
#if USE_OUTGOING
  direction_blobs(p.outgoing, row, stride);
  row += 2 * BLOB_BINS * (ulong)stride;
#endif
#if USE_ALBEDO
  row[0] = p.albedo.x;
  row[stride] = p.albedo.y;
  row[2 * (ulong)stride] = p.albedo.z;
  row += 3 * (ulong)stride;
#endif
#if USE_ROUGHNESS
  row[0] = p.roughness;
#endif
}
#endif

uint corner_entry(const uint x, const uint y, const uint z, const uint corners_an_axis) {
  const ulong dense = (ulong)corners_an_axis * corners_an_axis * corners_an_axis;
  if (dense <= GRID_ENTRIES) return (z * corners_an_axis + y) * corners_an_axis + x;
  return (x ^ (y * 2654435761u) ^ (z * 805459861u)) % GRID_ENTRIES;
}

/* `corner` is an index of an entry over all levels. bounds: lower corner of the cube, 1 / its side. */
kernel void grid_corners(const uint count, const uint stride, const uint total_points,
                         const float lower_x, const float lower_y, const float lower_z,
                         const float inverse_side, global const uint *restrict order,
                         global const float *restrict surface, global uint *restrict corner,
                         global float *restrict weight) {
  const uint column = (uint)get_global_id(0);
  if (column >= count) return;
  const float3 position = load_row3(surface, total_points, ROW_POSITION, order[column]);
  const float3 unit =
      clamp((position - (float3)(lower_x, lower_y, lower_z)) * inverse_side, 0.0f, 1.0f);
  for (uint level = 0; level < GRID_LEVELS; ++level) {
    const uint cells = (uint)GRID_BASE << level;
    const float3 scaled = unit * (float)cells;
    const float3 cell = min(floor(scaled), (float)(cells - 1));
    const float3 part = scaled - cell;
    for (uint k = 0; k < 8; ++k) {
      const uint dx = k & 1u, dy = (k >> 1) & 1u, dz = k >> 2;
      const ulong at = (level * 8 + k) * (ulong)stride + column;
      corner[at] = level * GRID_ENTRIES + corner_entry((uint)cell.x + dx, (uint)cell.y + dy,
                                                       (uint)cell.z + dz, cells + 1);
      weight[at] = (dx ? part.x : 1.0f - part.x) * (dy ? part.y : 1.0f - part.y) *
                   (dz ? part.z : 1.0f - part.z);
    }
  }
}

/* The features of one table entry together. */
#if GRID_FEATURES == 1
typedef float entry_features;
#define LOAD_ENTRY(pointer) (*(pointer))
#define STORE_ENTRY(value, pointer) (*(pointer) = (value))
#else
typedef JOIN(float, GRID_FEATURES) entry_features;
#define LOAD_ENTRY(pointer) JOIN(vload, GRID_FEATURES)(0, pointer)
#define STORE_ENTRY(value, pointer) JOIN(vstore, GRID_FEATURES)(value, 0, pointer)
#endif

/* One level's features of one column, from the present table. */
entry_features grid_features(const uint level, const uint column, const uint stride,
                             global const uint *restrict corner, global const float *restrict weight,
                             global const float *restrict table) {
  entry_features sum = (entry_features)0.0f;
  for (uint k = 0; k < 8; ++k) {
    const ulong at = (level * 8 + k) * (ulong)stride + column;
    sum += weight[at] * LOAD_ENTRY(table + (ulong)corner[at] * GRID_FEATURES);
  }
  return sum;
}

/* The grid's rows of all columns, from the present table. */
kernel void encode_grid(const uint count, const uint stride, global const uint *restrict corner,
                        global const float *restrict weight, global const float *restrict table,
                        global float *restrict features) {
  const uint column = (uint)get_global_id(0);
  if (column >= count) return;
  for (uint level = 0; level < GRID_LEVELS; ++level) {
    float sum[GRID_FEATURES];
    STORE_ENTRY(grid_features(level, column, stride, corner, weight, table), sum);
    for (uint f = 0; f < GRID_FEATURES; ++f)
      features[(level * GRID_FEATURES + f) * (ulong)stride + column] = sum[f];
  }
}
