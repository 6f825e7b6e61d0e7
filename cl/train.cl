/* Training: loss gradients of a minibatch, fixed-order reduction, Adam with moving averages.
 *
 * A minibatch is a run of `count` columns of the shuffled training points with SAMPLES_A_STEP samples of
 * each, number `sample` on; sample s of column i is u, v [s * stride + i] and f in plane s * CHANNELS + c
 * of `all_targets`. `factor` (a plane a channel, by column) is what the network's output is multiplied by;
 * the loss is the mean over samples and channels of weight^2 (g - f / factor)^2, where weight, also by
 * column and channel, is the factor over its mean to a power that the host chose.
 *
 * gradients: a group takes a tile of TILE columns at a time. Rows of theta (what the heads say for a
 * column: all weights but W2), samples forward and backward, and rows of the gradient by theta stay in local
 * memory, row after row of TILE floats. Heads are paid once a column, not once a sample. Each work-item
 * works on VEC columns; after a barrier each computes some of the parameters' gradients as sums over the
 * tile. Every group owns one row of `partial`, adam adds the rows in order: no atomics, the same
 * bits every time.
 *
 * adam: the first PARTIAL_FLOATS / VEC work-items update VEC network parameters each (the vector is
 * padded, the loss rides at AT_LOSS in the padding), each further one a table entry that the
 * minibatch touches; it gathers the entry's gradient from an inverted index (columns and weights, entry
 * after entry), so again no atomics. Entries that a minibatch does not touch keep value and moments.
 *
 * Work-group contract: `gradients` runs in groups of exactly LANES work-items, TILE a multiple of VEC;
 * local memory LOCAL_FLOATS floats; barriers between the phases of the tile loop, whose bounds are the same
 * for the whole group. The others: any size, no local memory, no barriers.
 */

#define FEATURES_AND_ONE (FEATURES + 1)
#define THETA_ROWS (HEAD_ROWS + BASE_ROWS)
#define TILE_BLOCKS (TILE / VEC)
#define FEATURE_FLOATS (FEATURE_BLOCKS * VEC)
#define GRID_ROWS (GRID_LEVELS * GRID_FEATURES)
/* Rows of theta that one pass over the features computes, so that a loaded feature serves several. */
#define ROW_BLOCK 8

/* theta rows of VEC columns: heads times features, and plain bases. */
void heads_forward(global const float *restrict parameters, local const real *restrict features,
                   local real *restrict theta) {
  for (int row = 0; row < HEAD_ROWS; row += ROW_BLOCK) {
    const int rows = min(ROW_BLOCK, HEAD_ROWS - row);
    global const float *restrict head = parameters + AT_HEADS + row * FEATURES_AND_ONE;
    real sum[ROW_BLOCK];
    if (rows == ROW_BLOCK) {
#pragma unroll
      for (int r = 0; r < ROW_BLOCK; ++r) sum[r] = (real)head[r * FEATURES_AND_ONE + FEATURES];
      for (int f = 0; f < FEATURES; ++f) {
        const real feature = features[f * TILE_BLOCKS];
#pragma unroll
        for (int r = 0; r < ROW_BLOCK; ++r) sum[r] = FMA((real)head[r * FEATURES_AND_ONE + f], feature, sum[r]);
      }
#pragma unroll
      for (int r = 0; r < ROW_BLOCK; ++r) theta[(row + r) * TILE_BLOCKS] = sum[r];
    } else {
      for (int r = 0; r < rows; ++r) {
        sum[0] = (real)head[r * FEATURES_AND_ONE + FEATURES];
        for (int f = 0; f < FEATURES; ++f)
          sum[0] = FMA((real)head[r * FEATURES_AND_ONE + f], features[f * TILE_BLOCKS], sum[0]);
        theta[(row + r) * TILE_BLOCKS] = sum[0];
      }
    }
  }
  for (int row = HEAD_ROWS; row < THETA_ROWS; ++row)
    theta[row * TILE_BLOCKS] = (real)parameters[AT_BASES + row - HEAD_ROWS];
}

/* Gradients by the grid's feature rows of VEC columns. */
void heads_backward(global const float *restrict parameters, local const real *restrict delta_theta,
                    real delta_feature[GRID_ROWS]) {
  for (int f = 0; f < GRID_ROWS; ++f) delta_feature[f] = (real)0.0f;
  for (int row = 0; row < HEAD_ROWS; ++row) {
    global const float *restrict head = parameters + AT_HEADS + row * FEATURES_AND_ONE;
    const real delta = delta_theta[row * TILE_BLOCKS];
    for (int f = 0; f < GRID_ROWS; ++f) delta_feature[f] = FMA((real)head[f], delta, delta_feature[f]);
  }
}

/* One sample of VEC columns, forward and backward: adds to delta_theta, leaves h1 and delta2 for W2's
 * gradient, returns the loss. `theta`, `delta_theta` point at the columns, `h1`, `delta2` at the sample. */
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
      for (int k = 0; k < NEURON_BLOCK; ++k) z[k] = FMA((real)w2[(j + k) * HIDDEN1 + i], h1[i], z[k]);
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
      for (int k = 0; k < NEURON_BLOCK; ++k) delta1[i] = FMA((real)w2[(j + k) * HIDDEN1 + i], delta[k], delta1[i]);
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

kernel __attribute__((reqd_work_group_size(LANES, 1, 1))) void gradients(
    const uint sample, const uint first, const uint count, const uint stride,
    global const float *restrict features, global const uint *restrict corner,
    global const float *restrict corner_weight, global const float *restrict table,
    global const float *restrict all_u, global const float *restrict all_v, global const float *restrict all_targets,
    global const float *restrict factor, global const float *restrict weights,
    global const float *restrict parameters, global float *restrict grid_gradient,
    global float *restrict partial) {
  /* Features as rows of columns for the heads, and transposed as rows of features for their gradient. */
  local real feature_rows[FEATURES * TILE_BLOCKS];
  local real feature_columns[TILE * FEATURE_BLOCKS];
  local real theta[THETA_ROWS * TILE_BLOCKS];
  local real delta_theta[THETA_ROWS * TILE_BLOCKS];
  local real h1[SAMPLES_A_STEP * HIDDEN1 * TILE_BLOCKS];
  local real delta2[SAMPLES_A_STEP * HIDDEN2 * TILE_BLOCKS];
  local real losses[TILE_BLOCKS];
  const int lane = (int)get_local_id(0);
  const uint end = first + count;
  const uint tiles = (count + TILE - 1) / TILE;
  const float per_sample = 1.0f / ((float)count * SAMPLES_A_STEP * CHANNELS);
  global float *restrict own = partial + get_group_id(0) * (ulong)PARTIAL_FLOATS;

  for (uint tile = (uint)get_group_id(0); tile < tiles; tile += (uint)get_num_groups(0)) {
    /* A parameter is summed by the same work-item in every tile, so the first tile can simply set it. */
    const int is_first = tile == get_group_id(0);
    for (int t = lane; t < TILE_BLOCKS; t += LANES) {
      const uint column = first + tile * TILE + (uint)t * VEC;
      /* Grid rows from the present table, the rest as encoded once; both as rows of columns and
       * transposed, column after column. */
      local float *restrict rows = (local float *)feature_rows + t * VEC;
      local float *restrict transposed = (local float *)feature_columns + t * VEC * FEATURE_FLOATS;
      for (uint k = 0; k < VEC; ++k, transposed += FEATURE_FLOATS) {
        const uint own_column = min(column + k, end - 1);
        for (uint level = 0; level < GRID_LEVELS; ++level) {
          float sum[GRID_FEATURES];
          STORE_ENTRY(grid_features(level, own_column, stride, corner, corner_weight, table), sum);
          for (uint f = 0; f < GRID_FEATURES; ++f)
            transposed[level * GRID_FEATURES + f] = rows[(level * GRID_FEATURES + f) * TILE + k] = sum[f];
        }
        for (uint f = GRID_ROWS; f < FEATURES; ++f)
          transposed[f] = rows[f * TILE + k] = features[f * (ulong)stride + own_column];
        transposed[FEATURES] = 1.0f;
        for (int f = FEATURES + 1; f < FEATURE_FLOATS; ++f) transposed[f] = 0.0f;
      }
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

      real delta_feature[GRID_ROWS];
      heads_backward(parameters, delta_theta + t, delta_feature);
      for (uint f = 0; f < GRID_ROWS; ++f) {
        float columns[VEC];
        STORE(delta_feature[f] * per_sample, columns);
        for (uint k = 0; k < VEC && column + k < end; ++k)
          grid_gradient[(ulong)(column + k) * GRID_ROWS + f] = columns[k];
      }
    }
    barrier(CLK_LOCAL_MEM_FENCE);

    for (int p = lane; p < HIDDEN2 * HIDDEN1; p += LANES) {
      local const real *restrict deltas = delta2 + p / HIDDEN1 * TILE_BLOCKS;
      local const real *restrict inputs = h1 + p % HIDDEN1 * TILE_BLOCKS;
      real sum = (real)0.0f;
      for (int s = 0; s < SAMPLES_A_STEP; ++s)
        for (int t = 0; t < TILE_BLOCKS; ++t)
          sum = FMA(deltas[s * HIDDEN2 * TILE_BLOCKS + t], inputs[s * HIDDEN1 * TILE_BLOCKS + t], sum);
      own[p] = (is_first ? 0.0f : own[p]) + per_sample * sum_lanes(sum);
    }
    /* Heads: ROW_BLOCK rows by VEC features at a time, lanes of the vector along the features. */
    local const float *restrict deltas = (local const float *)delta_theta;
    for (int p = lane; p < (HEAD_ROWS + ROW_BLOCK - 1) / ROW_BLOCK * FEATURE_BLOCKS; p += LANES) {
      const int row = p / FEATURE_BLOCKS * ROW_BLOCK;
      const int block = p % FEATURE_BLOCKS;
      const int f = block * VEC;
      const int rows = min(ROW_BLOCK, HEAD_ROWS - row);
      real sum[ROW_BLOCK];
#pragma unroll
      for (int r = 0; r < ROW_BLOCK; ++r) sum[r] = (real)0.0f;
      for (int t = 0; t < TILE; ++t) {
        const real feature = feature_columns[t * FEATURE_BLOCKS + block];
#pragma unroll
        for (int r = 0; r < ROW_BLOCK; ++r)
          sum[r] = FMA((real)deltas[(row + min(r, rows - 1)) * TILE + t], feature, sum[r]);
      }
      for (int r = 0; r < rows; ++r) {
        float each[VEC];
        STORE(sum[r] * per_sample, each);
        global float *restrict head = own + AT_HEADS + (row + r) * FEATURES_AND_ONE;
        for (int k = 0; k < VEC && f + k < FEATURES_AND_ONE; ++k) 
          head[f + k] = (is_first ? 0.0f : head[f + k]) + each[k];
      }
    }
    for (int row = HEAD_ROWS + lane; row < THETA_ROWS; row += LANES) {
      real sum = (real)0.0f;
      for (int t = 0; t < TILE_BLOCKS; ++t) sum += delta_theta[row * TILE_BLOCKS + t];
      global float *restrict base = own + AT_BASES + row - HEAD_ROWS;
      *base = (is_first ? 0.0f : *base) + per_sample * sum_lanes(sum);
    }
    if (lane == 0) {
      real sum = (real)0.0f;
      for (int t = 0; t < TILE_BLOCKS; ++t) sum += losses[t];
      own[AT_LOSS] = (is_first ? 0.0f : own[AT_LOSS]) + per_sample * sum_lanes(sum);
    }
    barrier(CLK_LOCAL_MEM_FENCE);
  }
}

/* One Adam step (Kingma and Ba 2015, algorithm 1) and the moving average of the value. */
#define DEFINE_ADAM_STEP(name, numbers, load, store)                                                    \
  void name(const numbers gradient, const float rate, const float correction1, const float correction2, \
            const float average_decay, global float *value, global float *moment1, global float *moment2, \
            global float *average) {                                                                    \
    const numbers m1 = ADAM_BETA1 * load(moment1) + (1.0f - ADAM_BETA1) * gradient;                     \
    const numbers m2 = ADAM_BETA2 * load(moment2) + (1.0f - ADAM_BETA2) * gradient * gradient;          \
    const numbers step = rate * (m1 * correction1) / (sqrt(m2 * correction2) + ADAM_EPSILON);           \
    const numbers updated = load(value) - step;                                                         \
    store(updated + average_decay * (load(average) - updated), average);                                \
    store(m1, moment1);                                                                                 \
    store(m2, moment2);                                                                                 \
    store(updated, value);                                                                              \
  }

DEFINE_ADAM_STEP(adam_step_network, real, LOAD, STORE)
DEFINE_ADAM_STEP(adam_step_entry, entry_features, LOAD_ENTRY, STORE_ENTRY)

kernel void adam(const uint groups, const uint first_entry, const uint entry_count, const float rate,
                 const float correction1, const float correction2, const float average_decay,
                 global const float *restrict partial, global float *restrict parameters,
                 global float *restrict moment1, global float *restrict moment2,
                 global float *restrict average, global float *restrict loss,
                 global const uint *restrict entries, global const uint *restrict starts,
                 global const uint *restrict columns, global const float *restrict weights,
                 global const float *restrict grid_gradient, global float *restrict table,
                 global float *restrict table_moment1, global float *restrict table_moment2,
                 global float *restrict table_average) {
  const uint work_item = (uint)get_global_id(0);
  if (work_item < PARTIAL_FLOATS / VEC) {
    const uint p = work_item * VEC;
    real gradient = (real)0.0f;
    for (uint g = 0; g < groups; ++g) gradient += LOAD(partial + g * (ulong)PARTIAL_FLOATS + p);
    adam_step_network(gradient, rate, correction1, correction2, average_decay, parameters + p, moment1 + p,
                      moment2 + p, average + p);
    if (work_item == 0) {
      float sum = 0.0f;
      for (uint g = 0; g < groups; ++g) sum += partial[g * (ulong)PARTIAL_FLOATS + AT_LOSS];
      *loss = sum;
    }
  } else if (work_item - PARTIAL_FLOATS / VEC < entry_count) {
    const uint item = first_entry + work_item - PARTIAL_FLOATS / VEC;
    const uint entry = entries[item];
    global const float *restrict level = grid_gradient + entry / GRID_ENTRIES * GRID_FEATURES;
    entry_features gradient = (entry_features)0.0f;
    for (uint k = starts[item]; k < starts[item + 1]; ++k)
      gradient += weights[k] * LOAD_ENTRY(level + columns[k] * (ulong)GRID_ROWS);
    const ulong at = (ulong)entry * GRID_FEATURES;
    adam_step_entry(gradient, rate, correction1, correction2, average_decay, table + at, table_moment1 + at,
                    table_moment2 + at, table_average + at);
  }
}

/* Samples of a batch into training order: row s of `u`, `v`, plane (s * CHANNELS + c) of `target`, all
 * with `stride` columns; position[p] is the column of shading point p. One work-item VEC samples. */
kernel void store_samples(const uint first_point, const uint point_count, const uint sample_count,
                          const uint batch_stride, const uint stride, const uint first_row,
                          global const uint *restrict position, global const float *restrict batch_u,
                          global const float *restrict batch_v, global const float *restrict value,
                          global const uint *restrict slot, global const uchar *restrict visible,
                          global float *restrict u, global float *restrict v,
                          global float *restrict target) {
  const uint blocks = batch_stride / VEC;
  const uint item = (uint)get_global_id(0);
  if (item >= point_count * blocks) return;
  const uint point = item / blocks;
  const uint first = (item % blocks) * VEC;
  const ulong at = (ulong)point * batch_stride + first;
  const ulong plane = (ulong)point_count * batch_stride;
  const uint column = position[first_point + point];
  float seen[VEC];
  STORE(load_visibility(slot, visible, at), seen);
  for (uint lane = 0; lane < VEC && first + lane < sample_count; ++lane) {
    const ulong row = first_row + first + lane;
    u[row * stride + column] = batch_u[at + lane];
    v[row * stride + column] = batch_v[at + lane];
    for (uint c = 0; c < CHANNELS; ++c)
      target[(row * CHANNELS + c) * stride + column] = value[c * plane + at + lane] * seen[lane];
  }
}
