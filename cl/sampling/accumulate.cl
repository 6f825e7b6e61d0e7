/* Running mean and variance of f, and of the residual f - g, for every shading point.
 *
 * One group of LANES work-items a point (several points share a work-group); work-items take VEC samples
 * at a time, and their results are merged in a fixed order. Sums are of differences to a value near the
 * mean, so that a small variance beside a large mean keeps its digits; merging follows Chan, Golub and
 * LeVeque (1983). The running mean is kept in two floats, because one of thousands of passes changes it
 * by less than the last bit of one float.
 *
 * Memory layout: `state` is structure of arrays, row * total_points + point, with rows
 * (quantity * CHANNELS + channel) * STATE_FLOATS and on, a record of STATE in accumulate.py (mean, the
 * mean's low part, sum of squared deviations); quantity 0 is f, quantity 1 (WITH_NETWORK) is f - g.
 *
 * Work-group contract: one-dimensional, GROUP_POINTS * LANES work-items; local memory 3 floats a
 * work-item and a barrier after each step of the merge where LANES > 1, none of either where LANES is 1.
 * No work-item leaves early: those past the end repeat the last point and write nothing.
 * Batch point i is shading point order[first_point + i]. With WEIGHTED each sample counts by its `weight`, one
 * over the density that it was drawn with. Where paths are shared (share.cl) a sample is the mean of ENTRIES ones, all
 * weighted: ENTRIES runs of `stride` elements a point.
 */

#define QUANTITIES (1 + WITH_NETWORK)

typedef struct {
  float count;
  float mean;
  float deviations; /* sum of squared deviations from the mean */
} Moments;

Moments merge_moments(const Moments a, const Moments b) {
  Moments both;
  both.count = a.count + b.count;
  const float share = both.count > 0.0f ? b.count / both.count : 0.0f;
  const float distance = b.mean - a.mean;
  both.mean = a.mean + distance * share;
  both.deviations = a.deviations + b.deviations + distance * distance * a.count * share;
  return both;
}

void add_to_state(global float *restrict state, const ulong stride, const float previous_count,
                  const Moments fresh) {
  const float high = state[STATE_MEAN * stride];
  const float low = state[STATE_LOW * stride];
  const float count = previous_count + fresh.count;
  const float distance = (fresh.mean - high) - low;
  const float share = fresh.count / count;
  /* Two-sum: high + step, and exactly what rounding lost of it. */
  const float step = distance * share + low;
  const float sum = high + step;
  const float virtual_step = sum - high;
  state[STATE_MEAN * stride] = sum;
  state[STATE_LOW * stride] = (high - (sum - virtual_step)) + (step - virtual_step);
  state[STATE_DEVIATIONS * stride] += fresh.deviations + distance * distance * previous_count * share;
}

kernel __attribute__((reqd_work_group_size(GROUP_POINTS * LANES, 1, 1))) void accumulate(
    const uint first_point, const uint point_count, const uint total_points, const uint sample_count,
    const uint stride, const float previous_count, global const uint *restrict order,
    global const float *restrict value,
    global const uint *restrict slot, global const uchar *restrict visible,
#if WEIGHTED
    global const float *restrict weight,
#endif
#if WITH_NETWORK
    global const float *restrict u, global const float *restrict v, NETWORK_ARGUMENTS,
#endif
    global float *restrict state) {
#if LANES > 1
  local Moments shared[GROUP_POINTS * LANES];
#endif
  const uint lane = (uint)get_local_id(0) % LANES;
  const uint item = (uint)get_global_id(0) / LANES;
  const uint batch_point = min(item, point_count - 1);
  const uint point = order[first_point + batch_point];
  const ulong plane = (ulong)point_count * ENTRIES * stride;
#if WEIGHTED
  const float entry_share = 1.0f / (float)ENTRIES;
#endif

  real shift[QUANTITIES * CHANNELS];
  real sum[QUANTITIES * CHANNELS];
  real squares[QUANTITIES * CHANNELS];
#pragma unroll
  for (int q = 0; q < QUANTITIES * CHANNELS; ++q) shift[q] = sum[q] = squares[q] = (real)0.0f;
  float count = 0.0f;
#if WITH_NETWORK
  const PointNetwork network = NETWORK_OF(point);
  const bool skips_network = is_constant(&network);
#endif
  for (uint first = lane * VEC; first < sample_count; first += LANES * VEC) {
    const whole valid = LANE_NUMBER + first < sample_count;
    const float block_count = (float)min((uint)VEC, sample_count - first);
    real x[QUANTITIES * CHANNELS];
    for (uint entry = 0; entry < ENTRIES; ++entry) {
      const ulong at = ((ulong)batch_point * ENTRIES + entry) * stride + first;
      const real seen = load_visibility(slot, visible, at);
      real y[QUANTITIES * CHANNELS];
#pragma unroll
      for (uint c = 0; c < CHANNELS; ++c) y[c] = LOAD(value + c * plane + at) * seen;
#if WITH_NETWORK
      real g[CHANNELS];
      if (skips_network) {
#pragma unroll
        for (int c = 0; c < CHANNELS; ++c) g[c] = (real)network.b3[c];
      } else {
        network_value(&network, LOAD(u + at), LOAD(v + at), g);
      }
#pragma unroll
      for (int c = 0; c < CHANNELS; ++c) y[CHANNELS + c] = y[c] - g[c];
#endif
#if WEIGHTED
      const real inverse_density = LOAD(weight + at) * entry_share;
#pragma unroll
      for (int q = 0; q < QUANTITIES * CHANNELS; ++q) y[q] *= inverse_density;
#endif
#pragma unroll
      for (int q = 0; q < QUANTITIES * CHANNELS; ++q) x[q] = entry == 0 ? y[q] : x[q] + y[q];
    }
#pragma unroll
    for (int q = 0; q < QUANTITIES * CHANNELS; ++q) {
      if (count == 0.0f)
        shift[q] = (real)(sum_lanes(SELECT((real)0.0f, x[q], valid)) / block_count);
      const real distance = SELECT((real)0.0f, x[q] - shift[q], valid);
      sum[q] += distance;
      squares[q] = FMA(distance, distance, squares[q]);
    }
    count += block_count;
  }

#pragma unroll
  for (int q = 0; q < QUANTITIES * CHANNELS; ++q) {
    const float total = sum_lanes(sum[q]);
    const float inverse = count > 0.0f ? 1.0f / count : 0.0f;
    float shifts[VEC];
    STORE(shift[q], shifts);
    Moments own = {count, shifts[0] + total * inverse,
                   fmax(sum_lanes(squares[q]) - total * total * inverse, 0.0f)};
#if LANES > 1
    shared[get_local_id(0)] = own;
    for (uint half_width = LANES / 2; half_width > 0; half_width /= 2) {
      barrier(CLK_LOCAL_MEM_FENCE);
      if (lane < half_width)
        shared[get_local_id(0)] =
            merge_moments(shared[get_local_id(0)], shared[get_local_id(0) + half_width]);
    }
    own = shared[get_local_id(0)];
    barrier(CLK_LOCAL_MEM_FENCE);
#endif
    if (lane == 0 && item < point_count)
      add_to_state(state + (ulong)(q * STATE_FLOATS) * total_points + point, total_points,
                   previous_count, own);
  }
}
