/* Numbers of the geometric integration: float, or double with -D DOUBLE=1; one (`number`) or VEC of them
 * (`numbers`), their exponents, sums that keep their rounding errors, and the arguments of a network of
 * HIDDEN hidden layers. Arrays hold `stored` numbers: floats where -D SINGLE_ARRAYS has points of single
 * precision computed in double.
 *
 * BARRIER separates what lane 0 wrote from what all lanes read, and RAISE sets a flag that lanes share;
 * with one lane there is nothing to wait for.
 *
 * Work-group contract: none; functions of private values.
 */

#if DOUBLE
#pragma OPENCL EXTENSION cl_khr_fp64 : enable
typedef double number;
typedef long exponent_bits;
#define MANTISSA_BITS 52
#define EXPONENT_MASK 2047
#define EXPONENT_BIAS 1023
#define NUMBER_NAME double
#define EXPONENT_NAME long
#else
typedef float number;
typedef int exponent_bits;
#define MANTISSA_BITS 23
#define EXPONENT_MASK 255
#define EXPONENT_BIAS 127
#define NUMBER_NAME float
#define EXPONENT_NAME int
#endif
#if DOUBLE && !SINGLE_ARRAYS
typedef double stored;
#define STORED_EPSILON DBL_EPSILON
#else
typedef float stored;
#define STORED_EPSILON FLT_EPSILON
#endif
/* Four layers of 128 such weights stay within 2^80 even in single precision. */
#define MODERATE_EXPONENT 12

/* `numbers` and `exponents`: VEC at a time. */
#if VEC == 1
typedef number numbers;
typedef exponent_bits exponents;
#define AS_EXPONENTS(x) JOIN(as_, EXPONENT_NAME)(x)
#define AS_NUMBERS(x) JOIN(as_, NUMBER_NAME)(x)
#else
typedef JOIN(NUMBER_NAME, VEC) numbers;
typedef JOIN(EXPONENT_NAME, VEC) exponents;
#define AS_EXPONENTS(x) JOIN(JOIN(as_, EXPONENT_NAME), VEC)(x)
#define AS_NUMBERS(x) JOIN(JOIN(as_, NUMBER_NAME), VEC)(x)
#endif

/* PoCL 3 makes four stores of vstore16, and a load of the whole vector soon after waits for the last of
 * them. PUT is one store to `memory`, with the same alignment as vstore. */
typedef numbers loose_numbers __attribute__((aligned(sizeof(number))));
#define PUT(value, memory, pointer) (*(memory loose_numbers *)(pointer) = (value))

/* Not fmin and fmax, whose rule for NaN costs two more instructions; there are no NaNs here. */
#define LESSER(a, b) ((a) < (b) ? (a) : (b))
#define GREATER(a, b) ((a) > (b) ? (a) : (b))

#if LANES == 1
#define BARRIER() ((void)0)
#define RAISE(flag) (*(flag) = 1)
#else
#define BARRIER() barrier(CLK_LOCAL_MEM_FENCE | CLK_GLOBAL_MEM_FENCE)
#define RAISE(flag) atomic_or(flag, 1)
#endif

/* x * 2^k for any k, exact unless the result is subnormal. */
numbers times_power_of_two(const numbers x, const exponents k) {
  const exponents low = 1 - EXPONENT_BIAS;
  const exponents high = EXPONENT_BIAS;
  const exponents half_k = k >> 1;
  const exponents k1 = half_k < low ? low : half_k > high ? high : half_k;
  const exponents rest = k - half_k;
  const exponents k2 = rest < low ? low : rest > high ? high : rest;
  return x * AS_NUMBERS((k1 + EXPONENT_BIAS) << MANTISSA_BITS) *
         AS_NUMBERS((k2 + EXPONENT_BIAS) << MANTISSA_BITS);
}

/* The exponent e of 2^e <= |x| < 2^(e + 1); the lowest one for zeros and subnormals. */
exponents exponent_of(const numbers x) {
  return ((AS_EXPONENTS(x) >> MANTISSA_BITS) & EXPONENT_MASK) - EXPONENT_BIAS;
}

/* Whether a comparison of `numbers` holds for one of them; halves are joined, as any() may test one by
 * one. */
bool any_of(const exponents condition) {
#if VEC == 16
  const JOIN(EXPONENT_NAME, 8) c8 = condition.lo | condition.hi;
#elif VEC == 8
  const exponents c8 = condition;
#endif
#if VEC >= 8
  const JOIN(EXPONENT_NAME, 4) c4 = c8.lo | c8.hi;
#elif VEC == 4
  const exponents c4 = condition;
#endif
#if VEC >= 4
  const JOIN(EXPONENT_NAME, 2) c2 = c4.lo | c4.hi;
  return (c2.x | c2.y) != 0;
#else
  return condition != 0;
#endif
}

/* Whether all x are 0 or moderate: no product or sum of a few numbers of that size overflows or
 * vanishes. */
bool all_moderate(const numbers x) {
  const exponents e = exponent_of(x);
  return !any_of((x != 0) & ((e < -MODERATE_EXPONENT) | (e >= MODERATE_EXPONENT)));
}

/* Sum of VEC numbers, always in the same order. */
number sum_numbers(const numbers x) {
#if VEC == 16
  const JOIN(NUMBER_NAME, 8) x8 = x.lo + x.hi;
#elif VEC == 8
  const numbers x8 = x;
#endif
#if VEC >= 8
  const JOIN(NUMBER_NAME, 4) x4 = x8.lo + x8.hi;
#elif VEC == 4
  const numbers x4 = x;
#endif
#if VEC >= 4
  const JOIN(NUMBER_NAME, 2) x2 = x4.lo + x4.hi;
  return x2.x + x2.y;
#else
  return x;
#endif
}

/* sum += term, with the rounding error carried along (Kahan). */
#define COMPENSATED_ADD(type, sum, error, term) \
  do {                                          \
    const type corrected = (term) - (error);    \
    const type total = (sum) + corrected;       \
    (error) = (total - (sum)) - corrected;      \
    (sum) = total;                              \
  } while (0)

/* Twice the signed area of a triangle from two of its sides; with fma the rounding of the second
 * product is returned to the difference (Kahan), so that slivers keep their relative precision. */
number cross_product(const number ax, const number ay, const number bx, const number by) {
#if USE_FMA
  const number product = ay * bx;
  return fma(ax, by, -product) + fma(-ay, bx, product);
#else
  return ax * by - ay * bx;
#endif
}

/* The network's arrays as kernel arguments, two a layer. */
#define LAYER_ARGUMENTS(k) __global const stored *weights_##k, __global const stored *biases_##k
#if HIDDEN == 0
#define NETWORK_ARGUMENTS LAYER_ARGUMENTS(0)
#elif HIDDEN == 1
#define NETWORK_ARGUMENTS LAYER_ARGUMENTS(0), LAYER_ARGUMENTS(1)
#elif HIDDEN == 2
#define NETWORK_ARGUMENTS LAYER_ARGUMENTS(0), LAYER_ARGUMENTS(1), LAYER_ARGUMENTS(2)
#elif HIDDEN == 3
#define NETWORK_ARGUMENTS \
  LAYER_ARGUMENTS(0), LAYER_ARGUMENTS(1), LAYER_ARGUMENTS(2), LAYER_ARGUMENTS(3)
#else
#define NETWORK_ARGUMENTS \
  LAYER_ARGUMENTS(0), LAYER_ARGUMENTS(1), LAYER_ARGUMENTS(2), LAYER_ARGUMENTS(3), LAYER_ARGUMENTS(4)
#endif

/* A statement for each layer. */
#if HIDDEN == 0
#define FOR_EACH_LAYER(statement) statement(0)
#elif HIDDEN == 1
#define FOR_EACH_LAYER(statement) statement(0) statement(1)
#elif HIDDEN == 2
#define FOR_EACH_LAYER(statement) statement(0) statement(1) statement(2)
#elif HIDDEN == 3
#define FOR_EACH_LAYER(statement) statement(0) statement(1) statement(2) statement(3)
#else
#define FOR_EACH_LAYER(statement) statement(0) statement(1) statement(2) statement(3) statement(4)
#endif
