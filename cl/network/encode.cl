/* phi -> features: a hash grid over position, one-blobs over directions, identities.
 *
 * Work-items encode VEC points at a time. Points are taken in any order: `order[i]` is the shading point
 * of feature column i (training shuffles points into minibatches). Features are structure of arrays,
 * feature f of column i at features[f * stride + i]; the grid's GRID_ROWS rows come first, then the
 * inputs with USE_* set, in the order below. Columns from `count` to `stride` repeat the last one.
 *
 * Hash grid (Mueller et al. 2022): level l has GRID_BASE * 2^l cells an axis over the scene's bounding
 * cube; a level whose corners fit into GRID_ENTRIES is stored densely, else hashed. Entry e of level l,
 * feature f, at table[(l * GRID_ENTRIES + e) * entry_floats + f], where entry_floats is GRID_FEATURES
 * or, while training keeps more beside the values, larger. `unit` holds positions relative to the cube,
 * three rows of `stride`: finding the corners again is cheaper than reading them.
 *
 * One-blob (Mueller et al. 2019): BLOB_BINS Gaussians of deviation 1 / BLOB_BINS at the bins' centres;
 * around the azimuth it wraps. Directions are polar angle / pi and azimuth / 2 pi.
 *
 * Work-group contract: one-dimensional, any size, no local memory, no barriers.
 */

#define GRID_ROWS (GRID_LEVELS * GRID_FEATURES)

/* VEC points' values of one row of the surface. */
real gather_row(global const float *restrict surface, const uint total_points, const uint row,
                const uint point[VEC]) {
  float values[VEC];
  for (uint lane = 0; lane < VEC; ++lane) values[lane] = surface[row * (ulong)total_points + point[lane]];
  return LOAD(values);
}

void one_blob(const real x, const int wraps, float *features) {
#pragma unroll
  for (uint bin = 0; bin < BLOB_BINS; ++bin) {
    real distance = fabs(x - ((float)bin + 0.5f) / (float)BLOB_BINS);
    if (wraps) distance = min(distance, 1.0f - distance);
    distance *= (float)BLOB_BINS;
    STORE(exp(-0.5f * distance * distance), features + bin * VEC);
  }
}

void direction_blobs(global const float *restrict surface, const uint total_points, const uint row,
                     const uint point[VEC], float *features) {
  const real x = gather_row(surface, total_points, row, point);
  const real y = gather_row(surface, total_points, row + 1, point);
  const real z = gather_row(surface, total_points, row + 2, point);
  one_blob(acos(clamp(z, (real)-1.0f, (real)1.0f)) * M_1_PI_F, 0, features);
  one_blob(atan2(y, x) * (0.5f * M_1_PI_F) + 0.5f, 1, features + BLOB_BINS * VEC);
}

/* The rows after the grid's; row f of VEC points at features + f * VEC. */
void fixed_features(global const float *restrict surface, const uint total_points,
                    const uint point[VEC], float *features) {
  /* Where position is all that varies there are none. */
  (void)surface, (void)total_points, (void)point, (void)features;
#if USE_NORMAL
  direction_blobs(surface, total_points, ROW_NORMAL, point, features);
  features += 2 * BLOB_BINS * VEC;
#endif
#if USE_OUTGOING
  direction_blobs(surface, total_points, ROW_OUTGOING, point, features);
  features += 2 * BLOB_BINS * VEC;
#endif
#if USE_ALBEDO
  for (uint c = 0; c < 3; ++c)
    STORE(gather_row(surface, total_points, ROW_ALBEDO + c, point), features + c * VEC);
  features += 3 * VEC;
#endif
#if USE_ROUGHNESS
  STORE(gather_row(surface, total_points, ROW_ROUGHNESS, point), features);
#endif
}

/* Where in the cube VEC points are. cube: its lower corner, and 1 / its side. */
void unit_position(global const float *restrict surface, const uint total_points,
                   const uint point[VEC], const float4 cube, real unit[3]) {
  const float lower[3] = {cube.x, cube.y, cube.z};
#pragma unroll
  for (uint axis = 0; axis < 3; ++axis)
    unit[axis] = clamp((gather_row(surface, total_points, ROW_POSITION + axis, point) - lower[axis]) * cube.w,
                       (real)0.0f, (real)1.0f);
}

bits corner_entry(const bits x, const bits y, const bits z, const uint corners_an_axis) {
  const ulong dense = (ulong)corners_an_axis * corners_an_axis * corners_an_axis;
  if (dense <= GRID_ENTRIES) return (z * corners_an_axis + y) * corners_an_axis + x;
  return (x ^ (y * 2654435761u) ^ (z * 805459861u)) % GRID_ENTRIES;
}

/* The eight corners around VEC points: their entries, counted over all levels, and trilinear weights. */
void grid_cell(const uint level, const real unit[3], bits entry[8], real weight[8]) {
  const uint cells = (uint)GRID_BASE << level;
  bits corner[3];
  real part[3];
#pragma unroll
  for (uint axis = 0; axis < 3; ++axis) {
    const real scaled = unit[axis] * (float)cells;
    const real cell = min(floor(scaled), (real)(float)(cells - 1));
    corner[axis] = TO_BITS(cell);
    part[axis] = scaled - cell;
  }
#pragma unroll
  for (uint k = 0; k < 8; ++k) {
    const uint dx = k & 1u, dy = (k >> 1) & 1u, dz = k >> 2;
    entry[k] =
        level * GRID_ENTRIES + corner_entry(corner[0] + dx, corner[1] + dy, corner[2] + dz, cells + 1);
    weight[k] = (dx ? part[0] : 1.0f - part[0]) * (dy ? part[1] : 1.0f - part[1]) *
                (dz ? part[2] : 1.0f - part[2]);
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

/* The grid's rows of VEC points, from the present table; row f at features + f * VEC. */
void grid_features(const real unit[3], global const float *restrict table, const uint entry_floats,
                   float *features) {
  UNROLL_FOR_LANES
  for (uint level = 0; level < GRID_LEVELS; ++level) {
    bits cell_entry[8];
    real cell_weight[8];
    grid_cell(level, unit, cell_entry, cell_weight);
    uint entry[8 * VEC];
    float weight[8 * VEC];
#pragma unroll
    for (uint k = 0; k < 8; ++k) {
      STORE(cell_entry[k], entry + k * VEC);
      STORE(cell_weight[k], weight + k * VEC);
    }
    for (uint lane = 0; lane < VEC; ++lane) {
      entry_features sum = (entry_features)0.0f;
#pragma unroll
      for (uint k = 0; k < 8; ++k)
        sum += weight[k * VEC + lane] * LOAD_ENTRY(table + entry[k * VEC + lane] * (ulong)entry_floats);
      float each[GRID_FEATURES];
      STORE_ENTRY(sum, each);
#pragma unroll
      for (uint f = 0; f < GRID_FEATURES; ++f) features[(level * GRID_FEATURES + f) * VEC + lane] = each[f];
    }
  }
}

/* What does not change in training, and is computed once an image: `unit` and the rows after the
 * grid's. */
kernel void encode_fixed(const uint count, const uint stride, const uint total_points,
                         const float lower_x, const float lower_y, const float lower_z,
                         const float inverse_side, global const uint *restrict order,
                         global const float *restrict surface, global float *restrict unit,
                         global float *restrict features) {
  const uint first = (uint)get_global_id(0) * VEC;
  if (first >= count) return;
  uint point[VEC];
  for (uint lane = 0; lane < VEC; ++lane) point[lane] = order[min(first + lane, count - 1)];
  real position[3];
  unit_position(surface, total_points, point, (float4)(lower_x, lower_y, lower_z, inverse_side), position);
  for (uint axis = 0; axis < 3; ++axis) STORE(position[axis], unit + axis * (ulong)stride + first);
  float fixed_rows[FEATURES * VEC];
  fixed_features(surface, total_points, point, fixed_rows);
  for (uint f = GRID_ROWS; f < FEATURES; ++f)
    STORE(LOAD(fixed_rows + (f - GRID_ROWS) * VEC), features + f * (ulong)stride + first);
}

/* The grid's rows of all columns, from the present table. */
kernel void encode_grid(const uint count, const uint stride, global const float *restrict unit,
                        global const float *restrict table, global float *restrict features) {
  const uint first = (uint)get_global_id(0) * VEC;
  if (first >= count) return;
  real position[3];
  for (uint axis = 0; axis < 3; ++axis) position[axis] = LOAD(unit + axis * (ulong)stride + first);
  float rows[GRID_ROWS * VEC];
  grid_features(position, table, GRID_FEATURES, rows);
  UNROLL_FOR_LANES
  for (uint f = 0; f < GRID_ROWS; ++f) STORE(LOAD(rows + f * VEC), features + f * (ulong)stride + first);
}

/* Corner k of level l of column i, and its weight, at [(l * 8 + k) * stride + i]. */
kernel void grid_corners(const uint count, const uint stride, global const float *restrict unit,
                         global uint *restrict corner, global float *restrict weight) {
  const uint first = (uint)get_global_id(0) * VEC;
  if (first >= count) return;
  real position[3];
  for (uint axis = 0; axis < 3; ++axis) position[axis] = LOAD(unit + axis * (ulong)stride + first);
  for (uint level = 0; level < GRID_LEVELS; ++level) {
    bits cell_entry[8];
    real cell_weight[8];
    grid_cell(level, position, cell_entry, cell_weight);
    for (uint k = 0; k < 8; ++k) {
      const ulong at = (level * 8 + k) * (ulong)stride + first;
      STORE(cell_entry[k], corner + at);
      STORE(cell_weight[k], weight + at);
    }
  }
}
