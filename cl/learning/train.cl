/* Training: loss gradients of a minibatch, reduced in a fixed order.
 *
 * A minibatch is a run of `count` columns of the shuffled training points with SAMPLES_A_STEP samples of
 * each, number `sample` on; sample s of column i is u, v [s * stride + i] and f in plane s * CHANNELS + c
 * of `all_targets`. These three stand in the step's row of `plan`, PLAN_WORDS words of which the global offset
 * tells the number (Kernel.repeat). `factor` (a plane a channel, by column) is what the network's output is multiplied
 * by; the loss is the mean over samples and channels of weight^2 (g - f / factor)^2, where weight, also by
 * column and channel, is the factor over its mean to a power that the host chose.
 *
 * Memory layout: `parameters` is the network's vector with every row padded to whole vectors: HIDDEN2 rows of
 * W2_STRIDE floats, HEAD_ROWS rows of FEATURE_FLOATS (feature FEATURES is the constant 1), BASE_ROWS
 * floats; the loss rides at PARAMETER_LOSS in the padding, PARAMETER_FLOATS in all (padded.py). `table` holds only the
 * grid's entries that training points touch, ENTRY_FLOATS each (adam.cl), the values first. `corner` names the entries around
 * a column, column after column, level after level.
 *
 * A group takes a tile of TILE columns at a time. Local memory holds, as rows of TILE floats: theta (a
 * column's weights but W2, which the heads give), the activations of samples forward and backward, and
 * the gradient by theta. Heads are evaluated once a column, not once a sample. Each work-item works on
 * VEC columns; after a barrier each computes some of the parameters' gradients as sums over the tile.
 * Every group owns one row of `partial`, and adam.cl adds the rows in order: no atomics, the same bits
 * every time. The first IDLE_GROUPS groups do nothing (train.py says why).
 *
 * Work-group contract: `gradients` runs in groups of exactly LANES work-items, TILE a multiple of VEC;
 * barriers between the phases of the tile loop, whose bounds are the same for the whole group. GPUs take
 * train_lanes.cl in its place.
 */

#define THETA_ROWS (HEAD_ROWS + BASE_ROWS)
#define TILE_BLOCKS (TILE / VEC)
#define FEATURE_BLOCKS (FEATURE_FLOATS / VEC)
/* Rows of theta that are computed together, so that one load of a feature serves all of them. */
#define ROW_BLOCK (HEAD_ROWS < 8 ? 1 : 8)
/* Rows of theta and vectors of features whose gradients are computed together over a tile's columns: as
 * many sums as registers hold, from few loads. On a GPU the work-items share the vectors. */
#if LANES > 1
#define GRADIENT_ROWS ROW_BLOCK
#define BLOCKS_AT_ONCE 1
#else
#define GRADIENT_ROWS 4
#if FEATURE_FLOATS / VEC % 5 == 0
#define BLOCKS_AT_ONCE 5
#elif FEATURE_FLOATS / VEC % 4 == 0
#define BLOCKS_AT_ONCE 4
#elif FEATURE_FLOATS / VEC % 3 == 0
#define BLOCKS_AT_ONCE 3
#elif FEATURE_FLOATS / VEC % 2 == 0
#define BLOCKS_AT_ONCE 2
#else
#define BLOCKS_AT_ONCE 1
#endif
#endif
/* Features whose gradients are computed together over the rows of theta. */
#define GRID_BLOCK (GRID_ROWS < 8 ? GRID_ROWS : 8)

/* theta rows of VEC columns: heads times features, and plain bases. */
void heads_forward(global const float *restrict parameters, local const real *restrict features,
                   local real *restrict theta) {
  for (int block = 0; block < HEAD_ROWS; block += ROW_BLOCK) {
    /* If the last block would be a part of one, it begins earlier. */
    const int row = min(block, HEAD_ROWS - ROW_BLOCK);
    global const float *restrict head = parameters + PARAMETER_HEADS + row * FEATURE_FLOATS;
    real sum[ROW_BLOCK];
#pragma unroll
    for (int r = 0; r < ROW_BLOCK; ++r) sum[r] = (real)head[r * FEATURE_FLOATS + FEATURES];
    for (int f = 0; f < FEATURES; ++f) {
      const real feature = features[f * TILE_BLOCKS];
#pragma unroll
      for (int r = 0; r < ROW_BLOCK; ++r) sum[r] = FMA((real)head[r * FEATURE_FLOATS + f], feature, sum[r]);
    }
#pragma unroll
    for (int r = 0; r < ROW_BLOCK; ++r) theta[(row + r) * TILE_BLOCKS] = sum[r];
  }
  for (int row = HEAD_ROWS; row < THETA_ROWS; ++row)
    theta[row * TILE_BLOCKS] = (real)parameters[PARAMETER_BASES + row - HEAD_ROWS];
}

/* Gradients by the grid's feature rows of VEC columns, times `scale`. */
void heads_backward(global const float *restrict parameters, local const real *restrict delta_theta,
                    const float scale, float *delta_feature) {
  for (int block = 0; block < GRID_ROWS; block += GRID_BLOCK) {
    const int f = min(block, GRID_ROWS - GRID_BLOCK);
    real sum[GRID_BLOCK];
#pragma unroll
    for (int k = 0; k < GRID_BLOCK; ++k) sum[k] = (real)0.0f;
    for (int row = 0; row < HEAD_ROWS; ++row) {
      global const float *restrict head = parameters + PARAMETER_HEADS + row * FEATURE_FLOATS + f;
      const real delta = delta_theta[row * TILE_BLOCKS];
#pragma unroll
      for (int k = 0; k < GRID_BLOCK; ++k) sum[k] = FMA((real)head[k], delta, sum[k]);
    }
#pragma unroll
    for (int k = 0; k < GRID_BLOCK; ++k) STORE(sum[k] * scale, delta_feature + (f + k) * VEC);
  }
}

/* One sample of VEC columns, forward and backward: adds to delta_theta, leaves h1 and delta2 for W2's
 * gradient, returns the loss. `theta`, `delta_theta` point at the columns, `h1`, `delta2` at the
 * sample. */
real sample_gradient(const real u, const real v, const real target[CHANNELS], const real weight[CHANNELS],
                     global const float *restrict w2, local const real *restrict theta,
                     local real *restrict delta_theta, local real *restrict h1_rows,
                     local real *restrict delta2_rows) {
  real h1[HIDDEN1];
  real h2[HIDDEN2];
  real delta3[CHANNELS];
  for (int j = 0; j < HIDDEN1; ++j) {
    const real z = FMA(theta[(ROW_W1 + 2 * j) * TILE_BLOCKS], u,
                       FMA(theta[(ROW_W1 + 2 * j + 1) * TILE_BLOCKS], v, theta[(ROW_B1 + j) * TILE_BLOCKS]));
    h1[j] = max(z, (real)0.0f);
    h1_rows[j * TILE_BLOCKS] = h1[j];
  }
  for (int c = 0; c < CHANNELS; ++c) delta3[c] = theta[(ROW_B3 + c) * TILE_BLOCKS];
  for (int j = 0; j < HIDDEN2; j += NEURON_BLOCK) {
    real z[NEURON_BLOCK];
#pragma unroll
    for (int k = 0; k < NEURON_BLOCK; ++k) z[k] = theta[(ROW_B2 + j + k) * TILE_BLOCKS];
#pragma unroll 4
    for (int i = 0; i < HIDDEN1; ++i) {
#pragma unroll
      for (int k = 0; k < NEURON_BLOCK; ++k) z[k] = FMA((real)w2[(j + k) * W2_STRIDE + i], h1[i], z[k]);
    }
#pragma unroll
    for (int k = 0; k < NEURON_BLOCK; ++k) {
      h2[j + k] = max(z[k], (real)0.0f);
#pragma unroll
      for (int c = 0; c < CHANNELS; ++c)
        delta3[c] = FMA(theta[(ROW_W3 + c * HIDDEN2 + j + k) * TILE_BLOCKS], h2[j + k], delta3[c]);
    }
  }
  real loss = (real)0.0f;
  for (int c = 0; c < CHANNELS; ++c) {
    const real error = weight[c] * (delta3[c] - target[c]);
    loss = FMA(error, error, loss);
    delta3[c] = 2.0f * weight[c] * error;
    delta_theta[(ROW_B3 + c) * TILE_BLOCKS] += delta3[c];
  }
  real delta1[HIDDEN1];
  for (int i = 0; i < HIDDEN1; ++i) delta1[i] = (real)0.0f;
  for (int j = 0; j < HIDDEN2; j += NEURON_BLOCK) {
    real delta[NEURON_BLOCK];
#pragma unroll
    for (int k = 0; k < NEURON_BLOCK; ++k) {
      delta[k] = (real)0.0f;
#pragma unroll
      for (int c = 0; c < CHANNELS; ++c) {
        const int row = ROW_W3 + c * HIDDEN2 + j + k;
        delta[k] = FMA(theta[row * TILE_BLOCKS], delta3[c], delta[k]);
        delta_theta[row * TILE_BLOCKS] += delta3[c] * h2[j + k];
      }
      delta[k] = SELECT((real)0.0f, delta[k], h2[j + k] > 0.0f);
      delta2_rows[(j + k) * TILE_BLOCKS] = delta[k];
      delta_theta[(ROW_B2 + j + k) * TILE_BLOCKS] += delta[k];
    }
#pragma unroll 4
    for (int i = 0; i < HIDDEN1; ++i) {
#pragma unroll
      for (int k = 0; k < NEURON_BLOCK; ++k) delta1[i] = FMA((real)w2[(j + k) * W2_STRIDE + i], delta[k], delta1[i]);
    }
  }
  for (int i = 0; i < HIDDEN1; ++i) {
    const real delta = SELECT((real)0.0f, delta1[i], h1[i] > 0.0f);
    delta_theta[(ROW_B1 + i) * TILE_BLOCKS] += delta;
    delta_theta[(ROW_W1 + 2 * i) * TILE_BLOCKS] += delta * u;
    delta_theta[(ROW_W1 + 2 * i + 1) * TILE_BLOCKS] += delta * v;
  }
  return loss;
}

/* Columns past the end of the minibatch are loaded as zero, and their weights are zero. */
real load_columns(global const float *restrict row, const uint column, const uint end) {
  if (column + VEC <= end) return LOAD(row + column);
  float padded[VEC];
  for (uint lane = 0; lane < VEC; ++lane) padded[lane] = column + lane < end ? row[column + lane] : 0.0f;
  return LOAD(padded);
}

/* Features of the columns column .. column + VEC (the last before `end` repeated): grid rows from the
 * present table, the rest as encoded once. As rows of columns, and transposed as columns of features. */
void load_features(const uint column, const uint end, const uint stride, global const float *restrict unit,
                   global const float *restrict fixed_rows, global const uint *restrict corner,
                   global const float *restrict table, local float *restrict rows,
                   local float *restrict columns) {
  float features[FEATURES * VEC];
  real position[3];
  for (uint axis = 0; axis < 3; ++axis) position[axis] = load_columns(unit + axis * (ulong)stride, column, end);
  for (uint level = 0; level < GRID_LEVELS; ++level) {
    bits unused[8];
    real cell_weight[8];
    grid_cell(level, position, unused, cell_weight);
    float weight[8 * VEC];
#pragma unroll
    for (uint k = 0; k < 8; ++k) STORE(cell_weight[k], weight + k * VEC);
    for (uint lane = 0; lane < VEC; ++lane) {
      global const uint *restrict slot = corner + (min(column + lane, end - 1) * GRID_LEVELS + level) * 8;
      entry_features sum = (entry_features)0.0f;
#pragma unroll
      for (uint k = 0; k < 8; ++k)
        sum += weight[k * VEC + lane] * LOAD_ENTRY(table + slot[k] * (ulong)ENTRY_FLOATS);
      float each[GRID_FEATURES];
      STORE_ENTRY(sum, each);
#pragma unroll
      for (uint f = 0; f < GRID_FEATURES; ++f) features[(level * GRID_FEATURES + f) * VEC + lane] = each[f];
    }
  }
  for (uint f = GRID_ROWS; f < FEATURES; ++f)
    STORE(load_columns(fixed_rows + f * (ulong)stride, column, end), features + f * VEC);
  for (uint f = 0; f < FEATURES; ++f) STORE(LOAD(features + f * VEC), rows + f * TILE);
  for (uint k = 0; k < VEC; ++k) {
    for (uint f = 0; f < FEATURES; ++f) columns[k * FEATURE_FLOATS + f] = features[f * VEC + k];
    for (uint f = FEATURES; f < FEATURE_FLOATS; ++f) columns[k * FEATURE_FLOATS + f] = f == FEATURES ? 1.0f : 0.0f;
  }
}

/* Adds to a group's own sums, or begins them. */
void add_partial(const int is_first, const real value, global float *restrict own) {
  STORE(is_first ? value : value + LOAD(own), own);
}

/* W2's gradient as sums over the tile, VEC neighbouring weights of a row at a time. */
void w2_gradient(const int lane, const int is_first, const float scale, local const real *restrict h1,
                 local const real *restrict delta2, global float *restrict own) {
  for (int p = lane * VEC; p < HIDDEN2 * W2_STRIDE; p += LANES * VEC) {
    local const real *restrict deltas = delta2 + p / W2_STRIDE * TILE_BLOCKS;
    const int i = p % W2_STRIDE;
    real sum[VEC];
#pragma unroll
    for (int k = 0; k < VEC; ++k) sum[k] = (real)0.0f;
    for (int s = 0; s < SAMPLES_A_STEP; ++s) {
      for (int t = 0; t < TILE_BLOCKS; ++t) {
        const real delta = deltas[s * HIDDEN2 * TILE_BLOCKS + t];
        /* Beyond the row's end its last weight is repeated; nothing reads the padding. */
#pragma unroll
        for (int k = 0; k < VEC; ++k)
          sum[k] = FMA(delta, h1[(s * HIDDEN1 + min(i + k, HIDDEN1 - 1)) * TILE_BLOCKS + t], sum[k]);
      }
    }
    float sums[VEC];
#pragma unroll
    for (int k = 0; k < VEC; ++k) sums[k] = scale * sum_lanes(sum[k]);
    add_partial(is_first, LOAD(sums), own + p);
  }
}

/* The heads' gradient, GRADIENT_ROWS rows by BLOCKS_AT_ONCE vectors of features at a time. */
void heads_gradient(const int lane, const int is_first, const float scale,
                    local const real *restrict feature_columns, local const float *restrict delta_theta,
                    global float *restrict own) {
  const int blocks = FEATURE_BLOCKS / BLOCKS_AT_ONCE;
  for (int p = lane; p < (HEAD_ROWS + GRADIENT_ROWS - 1) / GRADIENT_ROWS * blocks; p += LANES) {
    const int row = p / blocks * GRADIENT_ROWS;
    const int block = p % blocks * BLOCKS_AT_ONCE;
    real sum[GRADIENT_ROWS][BLOCKS_AT_ONCE];
#pragma unroll
    for (int r = 0; r < GRADIENT_ROWS; ++r) {
#pragma unroll
      for (int k = 0; k < BLOCKS_AT_ONCE; ++k) sum[r][k] = (real)0.0f;
    }
    for (int t = 0; t < TILE; ++t) {
      real feature[BLOCKS_AT_ONCE];
#pragma unroll
      for (int k = 0; k < BLOCKS_AT_ONCE; ++k) feature[k] = feature_columns[t * FEATURE_BLOCKS + block + k];
#pragma unroll
      for (int r = 0; r < GRADIENT_ROWS; ++r) {
        const real delta = (real)delta_theta[min(row + r, HEAD_ROWS - 1) * TILE + t];
#pragma unroll
        for (int k = 0; k < BLOCKS_AT_ONCE; ++k) sum[r][k] = FMA(delta, feature[k], sum[r][k]);
      }
    }
    global float *restrict head = own + PARAMETER_HEADS + row * FEATURE_FLOATS + block * VEC;
#pragma unroll
    for (int r = 0; r < GRADIENT_ROWS; ++r) {
      if (row + r < HEAD_ROWS) {
#pragma unroll
        for (int k = 0; k < BLOCKS_AT_ONCE; ++k)
          add_partial(is_first, sum[r][k] * scale, head + r * FEATURE_FLOATS + k * VEC);
      }
    }
  }
}

/* Gradients by the bases, and the loss. */
void base_gradient(const int lane, const int is_first, const float scale,
                   local const real *restrict delta_theta, local const real *restrict losses,
                   global float *restrict own) {
  for (int row = HEAD_ROWS + lane; row < THETA_ROWS; row += LANES) {
    real sum = (real)0.0f;
    for (int t = 0; t < TILE_BLOCKS; ++t) sum += delta_theta[row * TILE_BLOCKS + t];
    global float *restrict base = own + PARAMETER_BASES + row - HEAD_ROWS;
    *base = (is_first ? 0.0f : *base) + scale * sum_lanes(sum);
  }
  if (lane == 0) {
    real sum = (real)0.0f;
    for (int t = 0; t < TILE_BLOCKS; ++t) sum += losses[t];
    own[PARAMETER_LOSS] = (is_first ? 0.0f : own[PARAMETER_LOSS]) + scale * sum_lanes(sum);
  }
}

kernel __attribute__((reqd_work_group_size(LANES, 1, 1))) void gradients(
    global const uint *restrict plan, const uint stride, global const float *restrict features,
    global const float *restrict unit,
    global const uint *restrict corner, global const float *restrict table, global const float *restrict all_u,
    global const float *restrict all_v, global const float *restrict all_targets,
    global const float *restrict factor, global const float *restrict weights,
    global const float *restrict parameters, global float *restrict grid_gradient,
    global float *restrict partial) {
  local real feature_rows[FEATURES * TILE_BLOCKS];
  local real feature_columns[TILE * FEATURE_BLOCKS];
  local real theta[THETA_ROWS * TILE_BLOCKS];
  local real delta_theta[THETA_ROWS * TILE_BLOCKS];
  local real h1[SAMPLES_A_STEP * HIDDEN1 * TILE_BLOCKS];
  local real delta2[SAMPLES_A_STEP * HIDDEN2 * TILE_BLOCKS];
  local real losses[TILE_BLOCKS];
  if (get_group_id(0) < IDLE_GROUPS) return;
  const uint group = (uint)get_group_id(0) - IDLE_GROUPS, groups = (uint)get_num_groups(0) - IDLE_GROUPS;
  const int lane = (int)get_local_id(0);
  global const uint *restrict step = plan + get_global_offset(0) / LANES * PLAN_WORDS;
  const uint sample = step[PLAN_SAMPLE], first = step[PLAN_FIRST], count = step[PLAN_COUNT], end = first + count;
  const uint tiles = (count + TILE - 1) / TILE;
  const float per_sample = 1.0f / ((float)count * SAMPLES_A_STEP * CHANNELS);
  global float *restrict own = partial + group * (ulong)PARAMETER_FLOATS;

  for (uint tile = group; tile < tiles; tile += groups) {
    /* A parameter is summed by the same work-item in every tile, so the first tile can simply set it. */
    const int is_first = tile == group;
    for (int t = lane; t < TILE_BLOCKS; t += LANES) {
      const uint column = first + tile * TILE + (uint)t * VEC;
      load_features(column, end, stride, unit, features, corner, table, (local float *)feature_rows + t * VEC,
                    (local float *)feature_columns + t * VEC * FEATURE_FLOATS);
      heads_forward(parameters, feature_rows + t, theta + t);
      for (int row = 0; row < THETA_ROWS; ++row) delta_theta[row * TILE_BLOCKS + t] = (real)0.0f;

      real inverse[CHANNELS];
      real weight[CHANNELS];
      for (uint c = 0; c < CHANNELS; ++c) {
        const real scale = load_columns(factor + c * (ulong)stride, column, end);
        inverse[c] = SELECT((real)0.0f, 1.0f / scale, scale > 0.0f);
        weight[c] = load_columns(weights + c * (ulong)stride, column, end);
      }
      real loss = (real)0.0f;
      for (uint s = 0; s < SAMPLES_A_STEP; ++s) {
        const ulong row = (sample + s) * (ulong)stride;
        real target[CHANNELS];
        for (uint c = 0; c < CHANNELS; ++c)
          target[c] = inverse[c] * load_columns(all_targets + row * CHANNELS + c * (ulong)stride, column, end);
        loss += sample_gradient(load_columns(all_u + row, column, end), load_columns(all_v + row, column, end),
                                target, weight, parameters, theta + t, delta_theta + t,
                                h1 + s * HIDDEN1 * TILE_BLOCKS + t, delta2 + s * HIDDEN2 * TILE_BLOCKS + t);
      }
      losses[t] = loss;

      float delta_feature[GRID_ROWS * VEC];
      heads_backward(parameters, delta_theta + t, per_sample, delta_feature);
      for (uint k = 0; k < VEC && column + k < end; ++k)
        for (uint f = 0; f < GRID_ROWS; ++f)
          grid_gradient[(column + k - first) * GRID_ROWS + f] = delta_feature[f * VEC + k];
    }
    barrier(CLK_LOCAL_MEM_FENCE);

    w2_gradient(lane, is_first, per_sample, h1, delta2, own);
    heads_gradient(lane, is_first, per_sample, feature_columns, (local const float *)delta_theta, own);
    base_gradient(lane, is_first, per_sample, delta_theta, losses, own);
    barrier(CLK_LOCAL_MEM_FENCE);
  }
}
