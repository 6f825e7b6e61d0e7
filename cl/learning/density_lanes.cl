/* The network of density.cl on GPUs, by groups of GROUP_ITEMS work-items that take a tile of TILE columns at a time:
 * with FITTING a step's gradients, as density_gradients.cl, else the densities, as density_tables.cl. Phases are
 * shared among all work-items, and end with a barrier.
 *
 * Gradients: the columns' features and hidden units; each of the PAIRS = TILE * DENSITY_SAMPLES pairs' cell, and the
 * gradient by its log e; gradients by the units; gradients by the parameters. A sample touches one cell's row, so
 * the gradients by rows are sums over the pairs of that cell: of unit j and cell k work-item
 * j + DENSITY_HIDDEN * (k % ROW_PARTS) alone takes them, in the order of the pairs. Every group owns one row of
 * `partial`: the same bits every time.
 *
 * Densities: features and units; e of each cell; its mean; the edges of each strip's bins, then of the strips.
 *
 * Local memory: `x`, `h`, `delta_h`, `e`, `strips` are rows of TILE columns; `cells`, `deltas` a number a pair;
 * `rows`, `biases` the sums of all tiles.
 *
 * Work-group contract: groups of exactly GROUP_ITEMS work-items, VEC 1; the bounds of the tile loop, which holds the
 * barriers, are the same for the whole group.
 */

/* Features and hidden units of columns first .. first + TILE, the last before `end` repeated. */
void tile_units(const uint lane, const uint first, const uint end, const uint stride,
                global const float *restrict features, global const float *restrict feature_mean,
                global const float *restrict feature_scale, global const float *restrict parameters, local float *x,
                local float *h) {
  for (uint k = lane; k < FEATURES * TILE; k += GROUP_ITEMS) {
    const uint f = k / TILE;
    x[k] = (features[f * (ulong)stride + min(first + k % TILE, end - 1)] - feature_mean[f]) * feature_scale[f];
  }
  barrier(CLK_LOCAL_MEM_FENCE);
  for (uint k = lane; k < DENSITY_HIDDEN * TILE; k += GROUP_ITEMS) {
    const uint j = k % DENSITY_HIDDEN;
    const uint t = k / DENSITY_HIDDEN;
    float sum = parameters[MAGNITUDE_UNIT_BIAS + j];
#pragma unroll 4
    for (uint f = 0; f < FEATURES; ++f)
      sum = FMA(parameters[MAGNITUDE_UNITS + f * DENSITY_HIDDEN + j], x[f * TILE + t], sum);
    h[j * TILE + t] = max(sum, 0.0f);
  }
  barrier(CLK_LOCAL_MEM_FENCE);
}

#if FITTING
#define PAIRS (TILE * DENSITY_SAMPLES)
/* Work-items that share a unit's rows. */
#define ROW_PARTS (GROUP_ITEMS / DENSITY_HIDDEN > 0 ? GROUP_ITEMS / DENSITY_HIDDEN : 1)

/* Adds the pairs of the tile to the sums by rows. */
void add_rows(const uint lane, local const float *h, local const int *cells, local const float *deltas,
              local float *rows, local float *biases) {
  for (uint k = lane; k < DENSITY_HIDDEN * ROW_PARTS; k += GROUP_ITEMS) {
    const uint j = k % DENSITY_HIDDEN;
    const uint part = k / DENSITY_HIDDEN;
#pragma unroll 1
    for (uint pair = 0; pair < PAIRS; ++pair) {
      const uint cell = (uint)cells[pair];
      if (cell % ROW_PARTS != part) continue;
      rows[cell * DENSITY_HIDDEN + j] = FMA(deltas[pair], h[j * TILE + pair % TILE], rows[cell * DENSITY_HIDDEN + j]);
      if (j == 0) biases[cell] += deltas[pair];
    }
  }
}

/* Adds the tile to the sums by the units' weights and biases, or begins them. */
void add_units(const uint lane, const int is_first, local const float *x, local const float *delta_h,
               global float *restrict own) {
  for (uint k = lane; k < (FEATURES + 1) * DENSITY_HIDDEN; k += GROUP_ITEMS) {
    const uint f = k / DENSITY_HIDDEN;
    const uint j = k % DENSITY_HIDDEN;
    float sum = 0.0f;
#pragma unroll
    for (uint t = 0; t < TILE; ++t) sum += (f < FEATURES ? x[min(f, (uint)FEATURES - 1) * TILE + t] : 1.0f) *
                                           delta_h[j * TILE + t];
    global float *gradient = own + (f < FEATURES ? MAGNITUDE_UNITS + k : MAGNITUDE_UNIT_BIAS + j);
    *gradient = is_first ? sum : sum + *gradient;
  }
}

/* One step's gradients: columns first .. first + count, samples sample .. sample + DENSITY_SAMPLES of each. */
kernel __attribute__((reqd_work_group_size(GROUP_ITEMS, 1, 1))) void density_gradients(
    const uint sample, const uint first, const uint count, const uint stride, const float unit_square,
    global const float *restrict features, global const float *restrict feature_mean,
    global const float *restrict feature_scale, global const float *restrict all_u,
    global const float *restrict all_v, global const float *restrict squared,
    global const float *restrict parameters, global float *restrict partial) {
  local float x[FEATURES * TILE];
  local float h[DENSITY_HIDDEN * TILE];
  local float delta_h[DENSITY_HIDDEN * TILE];
  local int cells[PAIRS];
  local float deltas[PAIRS];
  local float rows[CELLS * DENSITY_HIDDEN];
  local float biases[CELLS];
  const uint lane = (uint)get_local_id(0), group = (uint)get_group_id(0), groups = (uint)get_num_groups(0);
  global float *restrict own = partial + group * (ulong)MAGNITUDE_FLOATS;
  const float share = 1.0f / (float)(count * DENSITY_SAMPLES);
  for (uint k = lane; k < CELLS * DENSITY_HIDDEN; k += GROUP_ITEMS) rows[k] = 0.0f;
  for (uint k = lane; k < CELLS; k += GROUP_ITEMS) biases[k] = 0.0f;

  for (uint tile = group; tile * TILE < count; tile += groups) {
    const uint begin = first + tile * TILE, end = first + count;
    tile_units(lane, begin, end, stride, features, feature_mean, feature_scale, parameters, x, h);
    for (uint pair = lane; pair < PAIRS; pair += GROUP_ITEMS) {
      const uint t = pair % TILE;
      const ulong at = (sample + pair / TILE) * (ulong)stride + min(begin + t, end - 1);
      const int cell = cell_of(all_u[at], all_v[at]);
      global const float *restrict weights = parameters + MAGNITUDE_ROWS + cell * DENSITY_HIDDEN;
      float z = parameters[MAGNITUDE_CELL_BIAS + cell];
#pragma unroll 4
      for (uint j = 0; j < DENSITY_HIDDEN; ++j) z = FMA(weights[j], h[j * TILE + t], z);
      const float e = exp(clamp(z, -LOG_LIMIT, LOG_LIMIT));
      /* Beyond the limit only gradients that lead back are used. */
      const float slope = e - squared[at] * unit_square / e;
      cells[pair] = cell;
      deltas[pair] = begin + t < end && (fabs(z) < LOG_LIMIT || z * slope > 0.0f) ? slope * share : 0.0f;
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    for (uint k = lane; k < DENSITY_HIDDEN * TILE; k += GROUP_ITEMS) {
      const uint j = k % DENSITY_HIDDEN;
      const uint t = k / DENSITY_HIDDEN;
      float sum = 0.0f;
#pragma unroll 4
      for (uint pair = t; pair < PAIRS; pair += TILE)
        sum = FMA(deltas[pair], parameters[MAGNITUDE_ROWS + cells[pair] * DENSITY_HIDDEN + (int)j], sum);
      delta_h[j * TILE + t] = h[j * TILE + t] > 0.0f ? sum : 0.0f;
    }
    add_rows(lane, h, cells, deltas, rows, biases);
    barrier(CLK_LOCAL_MEM_FENCE);
    add_units(lane, tile == group, x, delta_h, own);
    barrier(CLK_LOCAL_MEM_FENCE);
  }
  for (uint k = lane; k < CELLS * DENSITY_HIDDEN; k += GROUP_ITEMS) own[MAGNITUDE_ROWS + k] = rows[k];
  for (uint k = lane; k < CELLS; k += GROUP_ITEMS) own[MAGNITUDE_CELL_BIAS + k] = biases[k];
}
#else

/* The densities of points first_point .. first_point + count, whose features are the first `count` columns, and
 * the mean of e over the square in `magnitude`. A share of UNIFORM_SHARE of each density is uniform. */
kernel __attribute__((reqd_work_group_size(GROUP_ITEMS, 1, 1))) void density_tables(
    const uint count, const uint stride, const uint first_point, global const float *restrict features,
    global const float *restrict feature_mean, global const float *restrict feature_scale,
    global const float *restrict parameters, global float *restrict magnitude, global uint *restrict density) {
  local float x[FEATURES * TILE];
  local float h[DENSITY_HIDDEN * TILE];
  local float e[CELLS * TILE];
  local float strips[DENSITY_BINS * TILE];
  local float means[TILE];
  const uint lane = (uint)get_local_id(0);
  const uint begin = (uint)get_group_id(0) * TILE;
  tile_units(lane, begin, count, stride, features, feature_mean, feature_scale, parameters, x, h);
  for (uint k = lane; k < CELLS * TILE; k += GROUP_ITEMS) {
    const uint cell = k / TILE;
    global const float *restrict weights = parameters + MAGNITUDE_ROWS + cell * DENSITY_HIDDEN;
    float z = parameters[MAGNITUDE_CELL_BIAS + cell];
#pragma unroll 4
    for (uint j = 0; j < DENSITY_HIDDEN; ++j) z = FMA(weights[j], h[j * TILE + k % TILE], z);
    e[k] = exp(clamp(z, -LOG_LIMIT, LOG_LIMIT));
  }
  barrier(CLK_LOCAL_MEM_FENCE);
  for (uint t = lane; t < TILE; t += GROUP_ITEMS) {
    float total = 0.0f;
#pragma unroll 4
    for (uint cell = 0; cell < CELLS; ++cell) total += e[cell * TILE + t];
    means[t] = total * (1.0f / CELLS);
    if (begin + t < count) magnitude[first_point + begin + t] = means[t];
  }
  barrier(CLK_LOCAL_MEM_FENCE);
  for (uint k = lane; k < DENSITY_BINS * TILE; k += GROUP_ITEMS) {
    const uint strip = k / TILE;
    const uint t = k % TILE;
    const float uniform_part = means[t] * (UNIFORM_SHARE / (1.0f - UNIFORM_SHARE));
    float weight[DENSITY_BINS];
    float sum = 0.0f;
#pragma unroll
    for (uint bin = 0; bin < DENSITY_BINS; ++bin) {
      weight[bin] = e[(strip * DENSITY_BINS + bin) * TILE + t] + uniform_part;
      sum += weight[bin];
    }
    strips[k] = sum;
    if (begin + t < count)
      store_row(weight, sum, 1,
                density + (first_point + begin + t) * (ulong)DENSITY_WORDS + DENSITY_CELLS + DENSITY_ROW * strip);
  }
  barrier(CLK_LOCAL_MEM_FENCE);
  for (uint t = lane; t < TILE && begin + t < count; t += GROUP_ITEMS) {
    float weight[DENSITY_BINS];
    float sum = 0.0f;
#pragma unroll
    for (uint strip = 0; strip < DENSITY_BINS; ++strip) {
      weight[strip] = strips[strip * TILE + t];
      sum += weight[strip];
    }
    store_row(weight, sum, 1, density + (first_point + begin + t) * (ulong)DENSITY_WORDS + DENSITY_STRIPS);
  }
}
#endif
