/* Training: loss gradients of a minibatch, fixed-order reduction, Adam with moving averages.
 *
 * A minibatch is a run of `count` columns of the shuffled training points, sample number `sample` of each;
 * column i has features[f * stride + i], u and v in row `sample` of stride columns, and f in plane
 * sample * CHANNELS + c of `all_targets`. The loss is the mean over columns and
 * channels of (g - scale * f)^2.
 *
 * gradients: a group takes a tile of TILE columns at a time. Its work-items run VEC columns each forward
 * and backward and leave activations and deltas in local memory, neuron after neuron; after a barrier
 * the same work-items each compute some of the parameters' gradients as dot products over the tile.
 * Every group owns one row of `partial`, adam_network adds the rows in order: no atomics, the same bits
 * every time.
 *
 * adam_grid: one work-item a table entry that the minibatch touches gathers the entry's gradient from an
 * inverted index (columns and weights, entry after entry), so again no atomics. Entries that a minibatch
 * does not touch keep value and moments.
 *
 * Work-group contract: `gradients` runs in groups of exactly LANES work-items, TILE a multiple of
 * LANES * VEC, local memory (2 * HIDDEN1 + 2 * HIDDEN2 + CHANNELS + 1) * TILE floats, barriers at the end
 * of both phases of the tile loop, whose bounds are the same for the whole group. The others: any size,
 * no local memory, no barriers.
 */

/* Sum over the tile of one gradient entry. */
float tile_dot(local const float *restrict a, local const float *restrict b) {
  real sum = (real)0.0f;
  for (int t = 0; t < TILE; t += VEC) sum = FMA(LOAD(a + t), LOAD(b + t), sum);
  return sum_lanes(sum);
}

float tile_sum(local const float *restrict a) {
  real sum = (real)0.0f;
  for (int t = 0; t < TILE; t += VEC) sum += LOAD(a + t);
  return sum_lanes(sum);
}

/* Columns past the end of the minibatch are loaded as zero, and their deltas are zero. */
real load_columns(global const float *restrict row, const uint column, const uint end) {
  if (column + VEC <= end) return LOAD(row + column);
  float padded[VEC];
  for (uint lane = 0; lane < VEC; ++lane) padded[lane] = column + lane < end ? row[column + lane] : 0.0f;
  return LOAD(padded);
}

kernel __attribute__((reqd_work_group_size(LANES, 1, 1))) void gradients(
    const uint sample, const uint first, const uint count, const uint stride, const float scale,
    global const float *restrict features, global const float *restrict all_u,
    global const float *restrict all_v, global const float *restrict all_targets,
    global const float *restrict parameters, global float *restrict grid_gradient,
    global float *restrict partial) {
  local float h1[HIDDEN1 * TILE];
  local float h2[HIDDEN2 * TILE];
  local float delta1[HIDDEN1 * TILE];
  local float delta2[HIDDEN2 * TILE];
  local float delta3[CHANNELS * TILE];
  local float loss[TILE];
  global const float *restrict u = all_u + sample * (ulong)stride;
  global const float *restrict v = all_v + sample * (ulong)stride;
  global const float *restrict target = all_targets + sample * (ulong)CHANNELS * stride;
  const int lane = (int)get_local_id(0);
  const uint end = first + count;
  const uint tiles = (count + TILE - 1) / TILE;
  global float *restrict own = partial + get_group_id(0) * (ulong)PARTIAL_FLOATS;
  for (int p = lane; p < PARTIAL_FLOATS; p += LANES) own[p] = 0.0f;

  for (uint tile = (uint)get_group_id(0); tile < tiles; tile += (uint)get_num_groups(0)) {
    for (int t = lane * VEC; t < TILE; t += LANES * VEC) {
      const uint column = first + tile * TILE + (uint)t;
      const real valid = SELECT((real)0.0f, (real)1.0f, LANE_NUMBER + column < end);
      const real sample_u = load_columns(u, column, end);
      const real sample_v = load_columns(v, column, end);

      real z1[HIDDEN1];
      for (int j = 0; j < HIDDEN1; ++j) {
        global const float *restrict row = parameters + AT_W1 + j * FIRST_INPUTS;
        z1[j] = FMA((real)row[0], sample_u, FMA((real)row[1], sample_v, (real)parameters[AT_B1 + j]));
      }
      for (int f = 0; f < FEATURES; ++f) {
        const real x = load_columns(features + (ulong)f * stride, column, end);
        for (int j = 0; j < HIDDEN1; ++j)
          z1[j] = FMA((real)parameters[AT_W1 + j * FIRST_INPUTS + 2 + f], x, z1[j]);
      }
      for (int j = 0; j < HIDDEN1; ++j) {
        z1[j] = max(z1[j], (real)0.0f);
        STORE(z1[j], h1 + j * TILE + t);
      }
      real value[CHANNELS];
      for (int c = 0; c < CHANNELS; ++c) value[c] = (real)parameters[AT_B3 + c];
      for (int j = 0; j < HIDDEN2; ++j) {
        real z = (real)parameters[AT_B2 + j];
        for (int i = 0; i < HIDDEN1; ++i) z = FMA((real)parameters[AT_W2 + j * HIDDEN1 + i], z1[i], z);
        z = max(z, (real)0.0f);
        STORE(z, h2 + j * TILE + t);
        for (int c = 0; c < CHANNELS; ++c)
          value[c] = FMA((real)parameters[AT_W3 + c * HIDDEN2 + j], z, value[c]);
      }

      real squared = (real)0.0f;
      for (int c = 0; c < CHANNELS; ++c) {
        const real f = load_columns(target + (ulong)c * stride, column, end);
        const real error = valid * (value[c] - scale * f);
        squared = FMA(error, error, squared);
        value[c] = error * (2.0f / ((float)count * CHANNELS));
        STORE(value[c], delta3 + c * TILE + t);
      }
      STORE(squared * (1.0f / ((float)count * CHANNELS)), loss + t);

      real back[HIDDEN1];
      for (int i = 0; i < HIDDEN1; ++i) back[i] = (real)0.0f;
      for (int j = 0; j < HIDDEN2; ++j) {
        real delta = (real)0.0f;
        for (int c = 0; c < CHANNELS; ++c)
          delta = FMA((real)parameters[AT_W3 + c * HIDDEN2 + j], value[c], delta);
        delta = SELECT((real)0.0f, delta, LOAD(h2 + j * TILE + t) > 0.0f);
        STORE(delta, delta2 + j * TILE + t);
        for (int i = 0; i < HIDDEN1; ++i)
          back[i] = FMA((real)parameters[AT_W2 + j * HIDDEN1 + i], delta, back[i]);
      }
      for (int i = 0; i < HIDDEN1; ++i) {
        back[i] = SELECT((real)0.0f, back[i], z1[i] > 0.0f);
        STORE(back[i], delta1 + i * TILE + t);
      }
      for (int f = 0; f < GRID_LEVELS * GRID_FEATURES; ++f) {
        real sum = (real)0.0f;
        for (int i = 0; i < HIDDEN1; ++i)
          sum = FMA((real)parameters[AT_W1 + i * FIRST_INPUTS + 2 + f], back[i], sum);
        float columns[VEC];
        STORE(sum, columns);
        for (uint k = 0; k < VEC && column + k < end; ++k)
          grid_gradient[(ulong)f * stride + column + k] = columns[k];
      }
    }
    /* Global too: a work-item adds to what another one set to zero. */
    barrier(CLK_LOCAL_MEM_FENCE | CLK_GLOBAL_MEM_FENCE);

    for (int p = lane; p < HIDDEN2 * HIDDEN1; p += LANES)
      own[AT_W2 + p] += tile_dot(delta2 + (p / HIDDEN1) * TILE, h1 + (p % HIDDEN1) * TILE);
    for (int p = lane; p < CHANNELS * HIDDEN2; p += LANES)
      own[AT_W3 + p] += tile_dot(delta3 + (p / HIDDEN2) * TILE, h2 + (p % HIDDEN2) * TILE);
    for (int j = lane; j < HIDDEN1; j += LANES) own[AT_B1 + j] += tile_sum(delta1 + j * TILE);
    for (int j = lane; j < HIDDEN2; j += LANES) own[AT_B2 + j] += tile_sum(delta2 + j * TILE);
    for (int c = lane; c < CHANNELS; c += LANES) own[AT_B3 + c] += tile_sum(delta3 + c * TILE);
    if (lane == 0) own[AT_LOSS] += tile_sum(loss);
    for (int j = lane; j < HIDDEN1; j += LANES) {
      for (int k = 0; k < FIRST_INPUTS; ++k) {
        global const float *restrict input = k == 0   ? u
                                             : k == 1 ? v
                                                      : features + (ulong)(k - 2) * stride;
        real sum = (real)0.0f;
        for (int t = 0; t < TILE; t += VEC)
          sum = FMA(load_columns(input, first + tile * TILE + (uint)t, end), LOAD(delta1 + j * TILE + t),
                    sum);
        own[AT_W1 + j * FIRST_INPUTS + k] += sum_lanes(sum);
      }
    }
    barrier(CLK_LOCAL_MEM_FENCE);
  }
}

/* One Adam step (Kingma and Ba 2015, algorithm 1) and the moving average of the value. */
void adam_step(const float gradient, const float rate, const float correction1, const float correction2,
               const float average_decay, global float *restrict value, global float *restrict moment1,
               global float *restrict moment2, global float *restrict average) {
  const float m1 = ADAM_BETA1 * *moment1 + (1.0f - ADAM_BETA1) * gradient;
  const float m2 = ADAM_BETA2 * *moment2 + (1.0f - ADAM_BETA2) * gradient * gradient;
  const float updated = *value - rate * (m1 * correction1) / (sqrt(m2 * correction2) + ADAM_EPSILON);
  *moment1 = m1;
  *moment2 = m2;
  *value = updated;
  *average = updated + average_decay * (*average - updated);
}

kernel void adam_network(const uint groups, const float rate, const float correction1,
                         const float correction2, const float average_decay,
                         global const float *restrict partial, global float *restrict parameters,
                         global float *restrict moment1, global float *restrict moment2,
                         global float *restrict average, global float *restrict loss) {
  const uint p = (uint)get_global_id(0);
  if (p >= PARTIAL_FLOATS) return;
  float gradient = 0.0f;
  for (uint g = 0; g < groups; ++g) gradient += partial[g * (ulong)PARTIAL_FLOATS + p];
  if (p == AT_LOSS)
    *loss = gradient;
  else
    adam_step(gradient, rate, correction1, correction2, average_decay, parameters + p, moment1 + p,
              moment2 + p, average + p);
}

kernel void adam_grid(const uint first_entry, const uint entry_count, const uint stride, const float rate,
                      const float correction1, const float correction2, const float average_decay,
                      global const uint *restrict entries, global const uint *restrict starts,
                      global const uint *restrict columns, global const float *restrict weights,
                      global const float *restrict grid_gradient, global float *restrict table,
                      global float *restrict moment1, global float *restrict moment2,
                      global float *restrict average) {
  if ((uint)get_global_id(0) >= entry_count) return;
  const uint item = first_entry + (uint)get_global_id(0);
  const uint entry = entries[item];
  const uint level = entry / GRID_ENTRIES;
  for (uint f = 0; f < GRID_FEATURES; ++f) {
    global const float *restrict row = grid_gradient + (level * GRID_FEATURES + f) * (ulong)stride;
    float gradient = 0.0f;
    for (uint k = starts[item]; k < starts[item + 1]; ++k)
      gradient = fma(weights[k], row[columns[k]], gradient);
    const ulong at = (ulong)entry * GRID_FEATURES + f;
    adam_step(gradient, rate, correction1, correction2, average_decay, table + at, moment1 + at,
              moment2 + at, average + at);
  }
}

/* Samples of a batch into training order: row s of `u`, `v`, plane (s * CHANNELS + c) of `target`, all
 * with `stride` columns; position[p] is the column of shading point p. One work-item VEC samples. */
kernel void store_samples(const uint first_point, const uint point_count, const uint sample_count,
                          const uint batch_stride, const uint stride,
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
    const ulong row = first + lane;
    u[row * stride + column] = batch_u[at + lane];
    v[row * stride + column] = batch_v[at + lane];
    for (uint c = 0; c < CHANNELS; ++c)
      target[(row * CHANNELS + c) * stride + column] = value[c * plane + at + lane] * seen[lane];
  }
}
