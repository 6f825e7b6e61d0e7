/* The network g(u, v | phi): two hidden ReLU layers, VEC samples of one shading point at a time.
 *
 *   h1 = relu(W1 (u, v) + b1)     h2 = relu(W2 h1 + b2)     g = W3 h2 + b3
 *
 * (u, v) enter as they are, so g is piecewise affine in them and its integral is exact (integrate.cl).
 * phi acts through linear heads: every group of weights but W2 may be `base + H features(phi)`. Heads
 * are evaluated once per shading point (fold.cl), and what remains is a small network of (u, v) alone.
 *
 * Memory layout: w1 (HIDDEN1, 2), b1, w2 (HIDDEN2, HIDDEN1), b2, w3 (CHANNELS, HIDDEN2), b3 are
 * row-major, each its own array. Point p's part of array X starts at p * STRIDE_X; a stride of 0 means
 * that all points share it. `parameters` is the trained vector that network.py describes: W2, then
 * HEAD_ROWS rows of FEATURES + 1 floats (the last multiplies the constant 1), then BASE_ROWS single
 * floats. Row ROW_X + i yields element i of group X; rows below HEAD_ROWS have features.
 *
 * Work-group contract: one-dimensional, any size, no local memory, no barriers.
 */

/* The arrays of one shading point. */
typedef struct {
  global const float *w1;
  global const float *b1;
  global const float *w2;
  global const float *b2;
  global const float *w3;
  global const float *b3;
} PointNetwork;

#define NETWORK_ARGUMENTS                                                                   \
  global const float *restrict w1, global const float *restrict b1, global const float *restrict w2, \
      global const float *restrict b2, global const float *restrict w3, global const float *restrict b3

#define NETWORK_OF(point)                                                                       \
  {                                                                                             \
    w1 + (ulong)(point) * STRIDE_W1, b1 + (ulong)(point) * STRIDE_B1, w2,                       \
        b2 + (ulong)(point) * STRIDE_B2, w3 + (ulong)(point) * STRIDE_W3, b3 + (ulong)(point) * STRIDE_B3 \
  }

/* Second-layer neurons computed side by side: independent sums hide the latency of FMA (eight take 0.81
 * of four's time at 32 x 32 neurons, PoCL 3.1). */
#if HIDDEN2 % 8 == 0
#define NEURON_BLOCK 8
#elif HIDDEN2 % 4 == 0
#define NEURON_BLOCK 4
#elif HIDDEN2 % 2 == 0
#define NEURON_BLOCK 2
#else
#define NEURON_BLOCK 1
#endif

/* Whether g is b3 everywhere, as where the control coefficient is zero (alpha.cl); most often the first
 * weight tells. */
bool is_constant(const PointNetwork *network) {
  for (int i = 0; i < CHANNELS * HIDDEN2; ++i)
    if (network->w3[i] != 0.0f) return false;
  return true;
}

/* g at VEC samples. Inner loops are unrolled so that activations can live in registers. */
INLINED void network_value(const PointNetwork *network, const real u, const real v, real value[CHANNELS]) {
  real h1[HIDDEN1];
#pragma unroll
  for (int j = 0; j < HIDDEN1; ++j) {
    const real z = FMA((real)network->w1[2 * j], u, FMA((real)network->w1[2 * j + 1], v, (real)network->b1[j]));
    h1[j] = max(z, (real)0.0f);
  }
#pragma unroll
  for (int c = 0; c < CHANNELS; ++c) value[c] = (real)network->b3[c];
  for (int j = 0; j < HIDDEN2; j += NEURON_BLOCK) {
    real z[NEURON_BLOCK];
#pragma unroll
    for (int k = 0; k < NEURON_BLOCK; ++k) z[k] = (real)network->b2[j + k];
    UNROLL_BY_FOUR
    for (int i = 0; i < HIDDEN1; ++i) {
#pragma unroll
      for (int k = 0; k < NEURON_BLOCK; ++k) z[k] = FMA((real)network->w2[(j + k) * HIDDEN1 + i], h1[i], z[k]);
    }
#pragma unroll
    for (int k = 0; k < NEURON_BLOCK; ++k) {
      const real h2 = max(z[k], (real)0.0f);
#pragma unroll
      for (int c = 0; c < CHANNELS; ++c)
        value[c] = FMA((real)network->w3[c * HIDDEN2 + j + k], h2, value[c]);
    }
  }
}

/* g at `stride` samples a point: values in one plane of point_count * stride a channel. */
kernel void evaluate(const uint first_point, const uint point_count, const uint stride,
                     global const float *restrict u, global const float *restrict v, NETWORK_ARGUMENTS,
                     global float *restrict value) {
  const uint blocks = stride / VEC;
  const uint item = (uint)get_global_id(0);
  if (item >= point_count * blocks) return;
  const uint point = item / blocks;
  const ulong at = (ulong)point * stride + (item % blocks) * VEC;
  const PointNetwork network = NETWORK_OF(first_point + point);
  real g[CHANNELS];
  network_value(&network, LOAD(u + at), LOAD(v + at), g);
  for (uint c = 0; c < CHANNELS; ++c) STORE(g[c], value + c * (ulong)point_count * stride + at);
}
