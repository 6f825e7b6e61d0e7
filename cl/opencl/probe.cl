/* How many multiply-adds a second a device does: a chain of STEPS in each lane of `values`, x = a x + b.
 *
 * Two chains a lane hide some of what each waits for. The results tend to
 * b / (1 - a), which the host checks.
 *
 * Work-group contract: one-dimensional, any size, no local memory, no barriers; one work-item handles
 * VEC values.
 */

kernel void multiply_add(const float a, const float b, global float *restrict values) {
  const uint at = (uint)get_global_id(0) * VEC;
  real first = LOAD(values + at);
  real second = first + 1.0f;
  for (uint step = 0; step < STEPS / 2; ++step) {
    first = FMA((real)a, first, (real)b);
    second = FMA((real)a, second, (real)b);
  }
  STORE(0.5f * (first + second), values + at);
}
