/* Reading a batch of samples: the integrand's values with their traced visibility.
 *
 * Layout as in samples.cl: element point * stride + s, one plane of point_count * stride a channel.
 *
 * Work-group contract: none; pure functions of private values.
 */

/* 1 where a sample's ray reached its end, or is known to (slot SEEN); 0 where it was blocked, or the
 * sample has no ray. */
real load_visibility(global const uint *restrict slot, global const uchar *restrict visible,
                     const ulong at) {
  const bits own = LOAD(slot + at);
  const whole seen = own == (bits)SEEN;
  const whole asked = (own != (bits)SEEN) && (own != (bits)NO_RAY);
  /* None of these samples has a traced ray. */
  if (!ANY(asked)) return SELECT((real)0.0f, (real)1.0f, seen);
  uint slots[VEC];
  float answer[VEC];
  STORE(own, slots);
  for (uint lane = 0; lane < VEC; ++lane)
    answer[lane] = slots[lane] == SEEN || (slots[lane] != NO_RAY && visible[slots[lane]] != 0) ? 1.0f : 0.0f;
  return LOAD(answer);
}
