/* The network g(u, v | phi): two hidden ReLU layers, VEC samples of one shading point at a time.
 *
 *   z1 = W_uv (u, v) + c(phi)     h1 = relu(z1)     c(phi) = W_phi features(phi) + b1
 *   z2 = W2 h1 + b2               h2 = relu(z2)
 *   g  = W3 h2 + b3
 *
 * (u, v) enter as they are, so g is piecewise affine in them and its integral is exact (integrate.cl).
 * Everything that depends on phi alone is folded once per shading point into c(phi) (kernel `fold`).
 *
 * Memory layout: `parameters` is one float vector, matrices row-major: W1 (HIDDEN1 rows of 2 + FEATURES:
 * u, v, features), b1, W2, b2, W3, b3, starting at the AT_* constants of network.py. `folded` holds
 * HIDDEN1 floats a point, point after point. `features` is structure of arrays: feature f of point i at
 * features[f * stride + i].
 *
 * Work-group contract: one-dimensional, any size, no local memory, no barriers.
 */

#define FIRST_INPUTS (2 + FEATURES)

/* g at VEC samples of the point whose folded biases are given. */
void network_value(const real u, const real v, global const float *restrict folded,
                   global const float *restrict parameters, real value[CHANNELS]) {
  real h1[HIDDEN1];
  for (int j = 0; j < HIDDEN1; ++j) {
    global const float *restrict row = parameters + AT_W1 + j * FIRST_INPUTS;
    h1[j] = max(FMA((real)row[0], u, FMA((real)row[1], v, (real)folded[j])), (real)0.0f);
  }
  for (int c = 0; c < CHANNELS; ++c) value[c] = (real)parameters[AT_B3 + c];
  for (int j = 0; j < HIDDEN2; ++j) {
    real z = (real)parameters[AT_B2 + j];
    for (int i = 0; i < HIDDEN1; ++i)
      z = FMA((real)parameters[AT_W2 + j * HIDDEN1 + i], h1[i], z);
    const real h2 = max(z, (real)0.0f);
    for (int c = 0; c < CHANNELS; ++c)
      value[c] = FMA((real)parameters[AT_W3 + c * HIDDEN2 + j], h2, value[c]);
  }
}

/* Folded biases c(phi) of VEC points a work-item, from their features. */
kernel void fold(const uint count, const uint stride, global const float *restrict features,
                 global const float *restrict parameters, global float *restrict folded) {
  const uint first = (uint)get_global_id(0) * VEC;
  if (first >= count) return;
  for (uint j = 0; j < HIDDEN1; ++j) {
    real sum = (real)parameters[AT_B1 + j];
    for (uint f = 0; f < FEATURES; ++f)
      sum = FMA((real)parameters[AT_W1 + j * FIRST_INPUTS + 2 + f], LOAD(features + f * (ulong)stride + first),
                sum);
    float bias[VEC];
    STORE(sum, bias);
    for (uint lane = 0; lane < VEC && first + lane < count; ++lane)
      folded[(ulong)(first + lane) * HIDDEN1 + j] = bias[lane];
  }
}

/* g at `stride` samples a point: values in one plane of point_count * stride a channel. */
kernel void evaluate(const uint point_count, const uint stride, global const float *restrict u,
                     global const float *restrict v, global const float *restrict folded,
                     global const float *restrict parameters, global float *restrict value) {
  const uint blocks = stride / VEC;
  const uint item = (uint)get_global_id(0);
  if (item >= point_count * blocks) return;
  const uint point = item / blocks;
  const ulong at = (ulong)point * stride + (item % blocks) * VEC;
  real g[CHANNELS];
  network_value(LOAD(u + at), LOAD(v + at), folded + (ulong)point * HIDDEN1, parameters, g);
  for (uint c = 0; c < CHANNELS; ++c) STORE(g[c], value + c * (ulong)point_count * stride + at);
}
