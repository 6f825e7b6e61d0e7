/* Neurons of the folded network's first layer that some points do not need, for a render's statistics.
 *
 * A neuron is affine in (u, v), so its values at the square's four corners decide: it is zero in the whole
 * square where none is positive, and has no line in it where none is of the other sign.
 *
 * Memory layout: w1 [point][neuron][2] and b1 [point][neuron], or without points where the strides are 0;
 * `idle` two counts a neuron, of chosen points where it is zero and where it has no line, zero at first.
 *
 * Work-group contract: none. Work-item (neuron, part) looks at every PARTS-th of the chosen points, and adds
 * what it counted once. Counts are integers: their order does not matter.
 */

kernel void count_idle(const uint chosen_count, const uint w1_stride, const uint b1_stride,
                       global const uint *restrict chosen, global const float *restrict w1,
                       global const float *restrict b1, volatile global uint *restrict idle) {
  const uint neuron = (uint)get_global_id(0);
  if (neuron >= HIDDEN1) return;
  uint zero = 0, without_line = 0;
  for (uint i = (uint)get_global_id(1); i < chosen_count; i += PARTS) {
    const ulong point = chosen[i];
    const global float *weights = w1 + point * w1_stride + 2 * neuron;
    const float along_u = weights[0];
    const float along_v = weights[1];
    const float bias = b1[point * b1_stride + neuron];
    const float4 values = (float4)(0.0f, along_u, along_v, along_u + along_v) + bias;
    const bool is_zero = all(values <= 0.0f);
    zero += is_zero ? 1u : 0u;
    without_line += is_zero || all(values >= 0.0f) ? 1u : 0u;
  }
  if (without_line == 0) return;
  atomic_add(idle + 2 * neuron, zero);
  atomic_add(idle + 2 * neuron + 1, without_line);
}
