/* Training on GPUs: loss gradients of a minibatch as in train.cl, where everything is described, with the same
 * arguments and results, but a work-item a sample in place of VEC columns.
 *
 * A group of GROUP_ITEMS work-items takes a tile of TILE columns at a time, PAIRS = TILE * SAMPLES_A_STEP pairs of a
 * column and a sample. Each phase shares its results among all work-items, and ends with a barrier:
 *
 *   features of the columns;  theta, the rows that features act on;  forward and backward a pair;
 *   the gradient by theta of a column, summed over its samples;  gradients by parameters and by the grid's rows.
 *
 * Local memory: `feature` and `theta` are rows of TILE columns. What a pair leaves are rows of PAIR_STRIDE numbers, one
 * more than there are pairs, so that neighbouring rows lie in different banks: PAIR_H1 and PAIR_H2, the activations;
 * PAIR_D1, PAIR_D2, PAIR_D3, gradients by what is activated; PAIR_U, PAIR_V, PAIR_ONE; PAIR_LOSS. Each gradient by a
 * row of theta is a sum over pairs of the product of two of these (row_factors). Private arrays are indexed by
 * unrolled loops only; other loops are unrolled by four at most, or loads ahead of time take all registers.
 *
 * Every sum is taken by one work-item in a fixed order, and each group owns one row of `partial`.
 *
 * Work-group contract: groups of exactly GROUP_ITEMS work-items, VEC 1; the bounds of the tile loop, which holds the
 * barriers, are the same for the whole group.
 */

#define THETA_ROWS (HEAD_ROWS + BASE_ROWS)
/* Where no group of weights is modulated there is still an array. */
#define LOCAL_ROWS (HEAD_ROWS > 0 ? HEAD_ROWS : 1)
#define PAIRS (TILE * SAMPLES_A_STEP)
#define PAIR_STRIDE (PAIRS + 1)

#define PAIR_H1 0
#define PAIR_D1 (PAIR_H1 + HIDDEN1)
#define PAIR_H2 (PAIR_D1 + HIDDEN1)
#define PAIR_D2 (PAIR_H2 + HIDDEN2)
#define PAIR_D3 (PAIR_D2 + HIDDEN2)
#define PAIR_U (PAIR_D3 + CHANNELS)
#define PAIR_V (PAIR_U + 1)
#define PAIR_ONE (PAIR_V + 1)
#define PAIR_LOSS (PAIR_ONE + 1)
#define PAIR_ROWS (PAIR_LOSS + 1)

/* Second-layer neurons computed side by side: few, as their weights are loaded ahead into registers. */
#if HIDDEN2 % 4 == 0
#define PAIR_BLOCK 4
#elif HIDDEN2 % 2 == 0
#define PAIR_BLOCK 2
#else
#define PAIR_BLOCK 1
#endif

/* Element i of a group of weights: by the heads, or a base. `parameters`, and `theta` at a column, are in scope. */
#define WEIGHT(group, i)                               \
  ((group) < HEAD_ROWS ? theta[((group) + (i)) * TILE] \
                       : parameters[PARAMETER_BASES + (group) - HEAD_ROWS + (i)])

/* Features of the tile's columns, the last before `end` repeated. */
void tile_features(const uint lane, const uint first, const uint end, const uint stride,
                   global const float *restrict unit, global const float *restrict fixed_rows,
                   global const uint *restrict corner, global const float *restrict table, local float *feature) {
  for (uint k = lane; k < TILE * GRID_LEVELS; k += GROUP_ITEMS) {
    const uint t = k % TILE;
    const uint level = k / TILE;
    const uint column = min(first + t, end - 1);
    const float position[3] = {unit[column], unit[stride + column], unit[2 * (ulong)stride + column]};
    uint unused[8];
    float weight[8];
    grid_cell(level, position, unused, weight);
    global const uint *restrict slot = corner + (column * (ulong)GRID_LEVELS + level) * 8;
    entry_features sum = (entry_features)0.0f;
#pragma unroll
    for (uint c = 0; c < 8; ++c) sum += weight[c] * LOAD_ENTRY(table + slot[c] * (ulong)ENTRY_FLOATS);
    float each[GRID_FEATURES];
    STORE_ENTRY(sum, each);
#pragma unroll
    for (uint f = 0; f < GRID_FEATURES; ++f) feature[(level * GRID_FEATURES + f) * TILE + t] = each[f];
  }
  for (uint k = GRID_ROWS * TILE + lane; k < FEATURES * TILE; k += GROUP_ITEMS)
    feature[k] = fixed_rows[k / TILE * (ulong)stride + min(first + k % TILE, end - 1)];
  for (uint k = FEATURES * TILE + lane; k < FEATURE_FLOATS * TILE; k += GROUP_ITEMS)
    feature[k] = k / TILE == FEATURES ? 1.0f : 0.0f;
}

/* The rows of theta that features act on: heads times features. */
void tile_theta(const uint lane, global const float *restrict parameters, local const float *feature,
                local float *theta) {
  for (uint k = lane; k < HEAD_ROWS * TILE; k += GROUP_ITEMS) {
    global const float *restrict head = parameters + PARAMETER_HEADS + k / TILE * FEATURE_FLOATS;
    float sum = head[FEATURES];
#pragma unroll 4
    for (uint f = 0; f < FEATURES; ++f) sum = FMA(head[f], feature[f * TILE + k % TILE], sum);
    theta[k] = sum;
  }
}

/* One sample, forward and backward; `own` are the pair's rows, of which U, V and ONE are set, and D3 to the targets.
 * `theta` and `weights`, a plane of `stride` a channel, point at the column. */
void pair_gradient(global const float *restrict weights, const uint stride,
                   global const float *restrict parameters, local const float *theta, local float *own) {
  const float u = own[PAIR_U * PAIR_STRIDE], v = own[PAIR_V * PAIR_STRIDE];
  float h1[HIDDEN1];
  float delta1[HIDDEN1];
  float delta3[CHANNELS];
#pragma unroll
  for (int i = 0; i < HIDDEN1; ++i) {
    h1[i] = max(FMA(WEIGHT(ROW_W1, 2 * i), u, FMA(WEIGHT(ROW_W1, 2 * i + 1), v, WEIGHT(ROW_B1, i))), 0.0f);
    own[(PAIR_H1 + i) * PAIR_STRIDE] = h1[i];
    delta1[i] = 0.0f;
  }
#pragma unroll
  for (int c = 0; c < CHANNELS; ++c) delta3[c] = WEIGHT(ROW_B3, c);
#pragma unroll 1
  for (int j = 0; j < HIDDEN2; j += PAIR_BLOCK) {
    float z[PAIR_BLOCK];
#pragma unroll
    for (int k = 0; k < PAIR_BLOCK; ++k) {
      z[k] = WEIGHT(ROW_B2, j + k);
#pragma unroll
      for (int i = 0; i < HIDDEN1; ++i) z[k] = FMA(parameters[(j + k) * W2_STRIDE + i], h1[i], z[k]);
      z[k] = max(z[k], 0.0f);
      own[(PAIR_H2 + j + k) * PAIR_STRIDE] = z[k];
#pragma unroll
      for (int c = 0; c < CHANNELS; ++c) delta3[c] = FMA(WEIGHT(ROW_W3, c * HIDDEN2 + j + k), z[k], delta3[c]);
    }
  }
  float loss = 0.0f;
#pragma unroll
  for (int c = 0; c < CHANNELS; ++c) {
    const float weight = weights[(uint)c * (ulong)stride];
    const float error = weight * (delta3[c] - own[(PAIR_D3 + c) * PAIR_STRIDE]);
    loss = FMA(error, error, loss);
    delta3[c] = 2.0f * weight * error;
    own[(PAIR_D3 + c) * PAIR_STRIDE] = delta3[c];
  }
  own[PAIR_LOSS * PAIR_STRIDE] = loss;
#pragma unroll 1
  for (int j = 0; j < HIDDEN2; ++j) {
    float delta = 0.0f;
#pragma unroll
    for (int c = 0; c < CHANNELS; ++c) delta = FMA(WEIGHT(ROW_W3, c * HIDDEN2 + j), delta3[c], delta);
    delta = own[(PAIR_H2 + j) * PAIR_STRIDE] > 0.0f ? delta : 0.0f;
    own[(PAIR_D2 + j) * PAIR_STRIDE] = delta;
#pragma unroll
    for (int i = 0; i < HIDDEN1; ++i) delta1[i] = FMA(parameters[j * W2_STRIDE + i], delta, delta1[i]);
  }
#pragma unroll
  for (int i = 0; i < HIDDEN1; ++i) own[(PAIR_D1 + i) * PAIR_STRIDE] = h1[i] > 0.0f ? delta1[i] : 0.0f;
}

/* The two rows of pairs whose product, summed, is the gradient by a row of theta. */
int2 row_factors(const int row) {
  if (row >= ROW_W1 && row < ROW_W1 + 2 * HIDDEN1)
    return (int2)(PAIR_D1 + (row - ROW_W1) / 2, (row - ROW_W1) % 2 == 0 ? PAIR_U : PAIR_V);
  if (row >= ROW_B1 && row < ROW_B1 + HIDDEN1) return (int2)(PAIR_D1 + row - ROW_B1, PAIR_ONE);
  if (row >= ROW_B2 && row < ROW_B2 + HIDDEN2) return (int2)(PAIR_D2 + row - ROW_B2, PAIR_ONE);
  if (row >= ROW_W3 && row < ROW_W3 + CHANNELS * HIDDEN2)
    return (int2)(PAIR_H2 + (row - ROW_W3) % HIDDEN2, PAIR_D3 + (row - ROW_W3) / HIDDEN2);
  return (int2)(PAIR_D3 + row - ROW_B3, PAIR_ONE);
}

/* Sum over pairs first, first + step, ... of the product of two rows. */
float sum_products(local const float *pairs, const int2 rows, const uint first, const uint step) {
  float sum = 0.0f;
#pragma unroll 4
  for (uint p = first; p < PAIRS; p += step)
    sum = FMA(pairs[rows.x * PAIR_STRIDE + (int)p], pairs[rows.y * PAIR_STRIDE + (int)p], sum);
  return sum;
}

/* Adds to a group's own sums, or begins them. */
void add_partial(const int is_first, const float value, global float *own) {
  *own = is_first ? value : value + *own;
}

/* Gradients by all parameters, and the loss, as sums over the tile. */
void parameter_gradients(const uint lane, const int is_first, const float scale, local const float *feature,
                         local const float *delta_theta, local const float *pairs, global float *own) {
  for (uint k = lane; k < HIDDEN2 * HIDDEN1; k += GROUP_ITEMS) {
    const int2 rows = (int2)(PAIR_D2 + (int)(k / HIDDEN1), PAIR_H1 + (int)(k % HIDDEN1));
    add_partial(is_first, scale * sum_products(pairs, rows, 0, 1), own + k / HIDDEN1 * W2_STRIDE + k % HIDDEN1);
  }
  for (uint k = lane; k < HEAD_ROWS * FEATURE_FLOATS; k += GROUP_ITEMS) {
    local const float *delta = delta_theta + k / FEATURE_FLOATS * TILE;
    local const float *x = feature + k % FEATURE_FLOATS * TILE;
    float sum = 0.0f;
#pragma unroll
    for (uint t = 0; t < TILE; ++t) sum = FMA(delta[t], x[t], sum);
    add_partial(is_first, scale * sum, own + PARAMETER_HEADS + k);
  }
  for (uint row = HEAD_ROWS + lane; row < THETA_ROWS; row += GROUP_ITEMS)
    add_partial(is_first, scale * sum_products(pairs, row_factors((int)row), 0, 1),
                own + PARAMETER_BASES + row - HEAD_ROWS);
  if (lane == 0)
    add_partial(is_first, scale * sum_products(pairs, (int2)(PAIR_LOSS, PAIR_ONE), 0, 1), own + PARAMETER_LOSS);
}

/* Gradients by the grid's feature rows of the tile's columns before `end`. */
void grid_rows_gradient(const uint lane, const uint columns, const float scale,
                        global const float *restrict parameters, local const float *delta_theta,
                        global float *restrict grid_gradient) {
  for (uint k = lane; k < columns * GRID_ROWS; k += GROUP_ITEMS) {
    global const float *restrict head = parameters + PARAMETER_HEADS + k % GRID_ROWS;
    float sum = 0.0f;
#pragma unroll 4
    for (uint row = 0; row < HEAD_ROWS; ++row)
      sum = FMA(head[row * FEATURE_FLOATS], delta_theta[row * TILE + k / GRID_ROWS], sum);
    grid_gradient[k] = sum * scale;
  }
}

kernel __attribute__((reqd_work_group_size(GROUP_ITEMS, 1, 1))) void gradients(
    global const uint *restrict plan, const uint stride, global const float *restrict features,
    global const float *restrict unit,
    global const uint *restrict corner, global const float *restrict table, global const float *restrict all_u,
    global const float *restrict all_v, global const float *restrict all_targets,
    global const float *restrict factor, global const float *restrict weights,
    global const float *restrict parameters, global float *restrict grid_gradient,
    global float *restrict partial) {
  local float feature[FEATURE_FLOATS * TILE];
  local float theta[LOCAL_ROWS * TILE];
  local float delta_theta[LOCAL_ROWS * TILE];
  local float pairs[PAIR_ROWS * PAIR_STRIDE];
  const uint lane = (uint)get_local_id(0), group = (uint)get_group_id(0), groups = (uint)get_num_groups(0);
  global const uint *restrict step = plan + get_global_offset(0) / GROUP_ITEMS * PLAN_WORDS;
  const uint sample = step[PLAN_SAMPLE], begin = step[PLAN_FIRST], count = step[PLAN_COUNT], end = begin + count;
  const float per_sample = 1.0f / ((float)count * SAMPLES_A_STEP * CHANNELS);

  for (uint tile = group; tile * TILE < count; tile += groups) {
    const uint first = begin + tile * TILE;
    tile_features(lane, first, end, stride, unit, features, corner, table, feature);
    barrier(CLK_LOCAL_MEM_FENCE);
    tile_theta(lane, parameters, feature, theta);
    barrier(CLK_LOCAL_MEM_FENCE);
    for (uint pair = lane; pair < PAIRS; pair += GROUP_ITEMS) {
      const uint column = first + pair % TILE;
      const uint place = min(column, end - 1);
      const ulong row = (sample + pair / TILE) * (ulong)stride;
      for (uint c = 0; c < CHANNELS; ++c) {
        const float scale = factor[c * (ulong)stride + place];
        const float inverse = scale > 0.0f ? 1.0f / scale : 0.0f;
        pairs[(PAIR_D3 + c) * PAIR_STRIDE + pair] =
            inverse * all_targets[row * CHANNELS + c * (ulong)stride + place];
      }
      pairs[PAIR_U * PAIR_STRIDE + pair] = all_u[row + place];
      pairs[PAIR_V * PAIR_STRIDE + pair] = all_v[row + place];
      pairs[PAIR_ONE * PAIR_STRIDE + pair] = 1.0f;
      pair_gradient(weights + place, stride, parameters, theta + pair % TILE, pairs + pair);
      /* Columns past the end count for nothing: all that they are multiplied by is zero. */
      if (column >= end)
        for (uint r = 0; r < PAIR_ROWS; ++r) pairs[r * PAIR_STRIDE + pair] = 0.0f;
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    for (uint k = lane; k < HEAD_ROWS * TILE; k += GROUP_ITEMS)
      delta_theta[k] = sum_products(pairs, row_factors((int)(k / TILE)), k % TILE, TILE);
    barrier(CLK_LOCAL_MEM_FENCE);
    parameter_gradients(lane, tile == group, per_sample, feature, delta_theta, pairs,
                        partial + group * (ulong)PARAMETER_FLOATS);
    grid_rows_gradient(lane, min((uint)TILE, end - first), per_sample, parameters, delta_theta,
                       grid_gradient + tile * (ulong)(TILE * GRID_ROWS));
    barrier(CLK_LOCAL_MEM_FENCE);
  }
}
