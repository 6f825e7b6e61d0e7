/* Reading a batch of samples: the integrand's values with their traced visibility.
 *
 * Layout as in samples.cl: element point * stride + s, one plane of point_count * stride a channel.
 *
 * Work-group contract: none; pure functions of private values.
 */

/* 1 where the ray of a sample reached its end, or is known to (SEEN); 0 where it was blocked or never traced. */
real load_visibility(global const uint *restrict slot, global const uchar *restrict visible,
                     const ulong at) {
  float answer[VEC];
  for (uint lane = 0; lane < VEC; ++lane) {
    const uint own = slot[at + lane];
    answer[lane] = own == SEEN || (own != NO_RAY && visible[own] != 0) ? 1.0f : 0.0f;
  }
  return LOAD(answer);
}
