/* Types and helpers that every kernel file builds on. Joined first.
 *
 * Two widths, one source. VEC is the number of samples a work-item holds: `real` is float (VEC 1) or
 * floatVEC, `whole` and `bits` are int and uint of the same width, and a comparison of reals yields a
 * `whole` that SELECT and ANY understand. CPU devices use VEC 16, 8 or 4, GPUs use VEC 1.
 *
 * FMA(a, b, c) is a * b + c with one rounding where the device does that fast (USE_FMA), else left to
 * the compiler's -cl-mad-enable.
 *
 * Functions carry no `inline` and no `static`: C99's inline leaves an undefined symbol where a compiler
 * does not inline, and an unused static one is a warning; OpenCL compilers inline plain functions
 * anyway.
 *
 * Work-group contract: none; these are pure functions of private values.
 */

/* Calls cost more than some functions' own arithmetic, and compilers count several kernels' calls of them. */
#ifndef INLINED
#define INLINED __attribute__((always_inline))
#endif

#define JOIN_(a, b) a##b
#define JOIN(a, b) JOIN_(a, b)

#if VEC == 1
typedef float real;
typedef int whole;
typedef uint bits;
#define LOAD(pointer) (*(pointer))
#define STORE(value, pointer) (*(pointer) = (value))
#define TO_REAL(x) convert_float(x)
#define TO_BITS(x) convert_uint(x)
#define TO_WHOLE(x) convert_int(x)
#define SELECT(if_false, if_true, condition) ((condition) ? (if_true) : (if_false))
#define ANY(condition) ((condition) != 0)
#define LANE_NUMBER ((bits)0)
#else
typedef JOIN(float, VEC) real;
typedef JOIN(int, VEC) whole;
typedef JOIN(uint, VEC) bits;
#define LOAD(pointer) JOIN(vload, VEC)(0, pointer)
#define STORE(value, pointer) JOIN(vstore, VEC)(value, 0, pointer)
#define TO_REAL(x) JOIN(convert_float, VEC)(x)
#define TO_BITS(x) JOIN(convert_uint, VEC)(x)
#define TO_WHOLE(x) JOIN(convert_int, VEC)(x)
#define SELECT(if_false, if_true, condition) select((if_false), (if_true), (condition))
#define ANY(condition) any_lane(condition)
#if VEC == 4
#define LANE_NUMBER ((bits)(0, 1, 2, 3))
#elif VEC == 8
#define LANE_NUMBER ((bits)(0, 1, 2, 3, 4, 5, 6, 7))
#else
#define LANE_NUMBER ((bits)(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15))
#endif
#endif

#if USE_FMA
#define FMA(a, b, c) fma(a, b, c)
#else
#define FMA(a, b, c) ((a) * (b) + (c))
#endif

#if VEC != 1
/* Whether a comparison holds in some lane; halves are joined, as any() may test lane after lane. */
bool any_lane(const whole condition) {
#if VEC == 16
  const int8 i8 = condition.lo | condition.hi;
  const int4 i4 = i8.lo | i8.hi;
#elif VEC == 8
  const int4 i4 = condition.lo | condition.hi;
#else
  const int4 i4 = condition;
#endif
  const int2 i2 = i4.lo | i4.hi;
  return (i2.x | i2.y) != 0;
}
#endif

/* A bit for each lane where a comparison holds. */
#if VEC == 1
uint lane_mask(const whole condition) { return condition != 0 ? 1u : 0u; }
#else
uint lane_mask(const whole condition) {
  const bits own = SELECT((bits)0u, (bits)1u << LANE_NUMBER, condition);
#if VEC == 16
  const uint8 b8 = own.lo | own.hi;
  const uint4 b4 = b8.lo | b8.hi;
#elif VEC == 8
  const uint4 b4 = own.lo | own.hi;
#else
  const uint4 b4 = own;
#endif
  const uint2 b2 = b4.lo | b4.hi;
  return b2.x | b2.y;
}
#endif

/* Takes the lowest bit out of `found`, and returns its number. */
uint take_lowest(uint *found) {
  const uint lowest = *found & (~*found + 1u);
  *found ^= lowest;
  return 31u - clz(lowest);
}

/* Sum over the VEC samples of a work-item, always in the same order. */
float sum_lanes(const real x) {
#if VEC == 1
  return x;
#elif VEC == 4
  const float2 s2 = x.lo + x.hi;
  return s2.x + s2.y;
#elif VEC == 8
  const float4 s4 = x.lo + x.hi;
  const float2 s2 = s4.lo + s4.hi;
  return s2.x + s2.y;
#else
  const float8 s8 = x.lo + x.hi;
  const float4 s4 = s8.lo + s8.hi;
  const float2 s2 = s4.lo + s4.hi;
  return s2.x + s2.y;
#endif
}

/* The largest and the least of the VEC samples of a work-item. */
float max_lanes(const real x) {
#if VEC == 1
  return x;
#else
#if VEC == 16
  const float8 m8 = max(x.lo, x.hi);
  const float4 m4 = max(m8.lo, m8.hi);
#elif VEC == 8
  const float4 m4 = max(x.lo, x.hi);
#else
  const float4 m4 = x;
#endif
  const float2 m2 = max(m4.lo, m4.hi);
  return max(m2.x, m2.y);
#endif
}

float min_lanes(const real x) { return -max_lanes(-x); }

/* Before a loop over a private array. A lane of a GPU keeps an array in registers only if all its indices are known when
 * it is compiled; on a CPU arrays are in its cache, and short loops are faster. */
#if VEC == 1
#define UNROLL_FOR_LANES _Pragma("unroll")
#define UNROLL_BY_FOUR _Pragma("unroll")
#else
#define UNROLL_FOR_LANES
#define UNROLL_BY_FOUR _Pragma("unroll 4")
#endif

/* The elements of an array at VEC places. Unrolled, they never go by way of memory. */
#if VEC == 1
real gather(global const float *restrict array, const whole at) { return array[at]; }
bits gather_bits(global const uint *restrict array, const bits at) { return array[at]; }
#else
real gather(global const float *restrict array, const whole at) {
  int index[VEC];
  float element[VEC];
  STORE(at, index);
#pragma unroll
  for (uint lane = 0; lane < VEC; ++lane) element[lane] = array[index[lane]];
  return LOAD(element);
}
bits gather_bits(global const uint *restrict array, const bits at) {
  uint index[VEC];
  uint element[VEC];
  STORE(at, index);
#pragma unroll
  for (uint lane = 0; lane < VEC; ++lane) element[lane] = array[index[lane]];
  return LOAD(element);
}
#endif
