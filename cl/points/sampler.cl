/* Points of the unit square as a pure function of (seed, stream, shading point, sample index).
 *
 * Nothing is carried from one sample to the next, so tiles, batch sizes, devices and resumed renders
 * draw the same points. Two samplers, chosen by SAMPLER:
 *
 *   SAMPLER_INDEPENDENT  Philox-4x32-10 (Salmon et al. 2011), counter (sample, point, stream, 0),
 *                        key = seed.
 *   SAMPLER_SOBOL        the first two Sobol dimensions, Owen-scrambled by hashing (Burley 2020, JCGT
 *                        9(4); constants of the permutation by Vegdahl), seeded by Philox per
 *                        (point, stream). A digital shift on top makes each point exactly uniform
 *                        whatever the quality of the hash, so estimates are exactly unbiased.
 *
 * Coordinates are multiples of 2^-24 in [0, 1).
 *
 * Paths need more dimensions: sample_nested gives two pairs a bounce. With Sobol points those of the bounces 1 and 2 are
 * the sequence's dimensions 2 to 9, well spread together with the square's own two. From then on each pair is the same
 * two-dimensional sequence again, drawn in an order that is scrambled on its own (padding, Burley 2020), so that pairs
 * are independent of each other. All are scrambled on their own. Philox's counter is then (bounce, point, stream, 1), and
 * (sample, point, stream, 4 * bounce + 2) for independent points.
 *
 * Slices of the hemisphere (slices.cl) are samples of one dimension, v. With Sobol points sample_azimuths gives it the
 * van der Corput sequence under one digital shift a (point, stream): 2^k samples from a multiple of 2^k on are
 * equidistant, in any order, which for a periodic function is better than a point at random in each of as many parts.
 *
 * Work-group contract: none; pure functions of private values, VEC samples at a time.
 */

/* Upper halves of products: of one number the processor has them, where mul_hi may be made of 16-bit parts. */
uint upper_half(const uint a, const uint b) { return (uint)(((ulong)a * b) >> 32); }

/* One text for the scalar and the VEC-wide generator. `state` is the counter and becomes the output. Unrolled, so that
 * compilers see that it is the same for all samples of a point. */
#define DEFINE_PHILOX(name, word, mul_hi)                           \
  void name(word state[4], const uint key_low, const uint key_high) { \
    uint key0 = key_low;                                            \
    uint key1 = key_high;                                           \
    _Pragma("unroll")                                               \
    for (int round = 0; round < 10; ++round) {                      \
      const word high0 = mul_hi(state[0], (word)0xD2511F53u);       \
      const word low0 = state[0] * (word)0xD2511F53u;               \
      const word high1 = mul_hi(state[2], (word)0xCD9E8D57u);       \
      const word low1 = state[2] * (word)0xCD9E8D57u;               \
      state[0] = high1 ^ state[1] ^ (word)key0;                     \
      state[1] = low1;                                              \
      state[2] = high0 ^ state[3] ^ (word)key1;                     \
      state[3] = low0;                                              \
      key0 += 0x9E3779B9u;                                          \
      key1 += 0xBB67AE85u;                                          \
    }                                                               \
  }

#if VEC == 1
DEFINE_PHILOX(philox, uint, upper_half)
#define philox_scalar philox
#else
DEFINE_PHILOX(philox, bits, mul_hi)
DEFINE_PHILOX(philox_scalar, uint, upper_half)
#endif

/* The upper 24 bits as a float in [0, 1). */
real to_unit_interval(const bits x) { return TO_REAL(x >> 8) * 0x1.0p-24f; }

bits reverse_bits(const bits word) {
  bits x = word;
  x = ((x >> 1) & 0x55555555u) | ((x & 0x55555555u) << 1);
  x = ((x >> 2) & 0x33333333u) | ((x & 0x33333333u) << 2);
  x = ((x >> 4) & 0x0F0F0F0Fu) | ((x & 0x0F0F0F0Fu) << 4);
  x = ((x >> 8) & 0x00FF00FFu) | ((x & 0x00FF00FFu) << 8);
  return (x >> 16) | (x << 16);
}

/* Owen scrambling of a bit-reversed word: every bit is flipped by a hash of the bits below it. */
bits owen_hash(const bits word, const bits seed) {
  bits x = word;
  x ^= x * 0x3D20ADEAu;
  x += seed;
  x *= (seed >> 16) | 1u;
  x ^= x * 0x05526C56u;
  x ^= x * 0x53A22864u;
  return x;
}

/* The second Sobol dimension, bit-reversed: the index times Pascal's triangle modulo 2, which is the
 * fifth Kronecker power of ((1, 1), (0, 1)) and so factors into five masked shifts. */
bits sobol_second_reversed(const bits index) {
  bits x = index;
  x ^= (x >> 1) & 0x55555555u;
  x ^= (x >> 2) & 0x33333333u;
  x ^= (x >> 4) & 0x0F0F0F0Fu;
  x ^= (x >> 8) & 0x00FF00FFu;
  x ^= (x >> 16) & 0x0000FFFFu;
  return x;
}

/* Dimensions 2 to SOBOL_DIMENSIONS - 1 of the Sobol sequence, by Joe and Kuo (2008): the degree of each one's polynomial,
 * its inner coefficients as bits, and the first direction numbers. */
#define SOBOL_DIMENSIONS 10
constant uint SOBOL_DEGREE[SOBOL_DIMENSIONS - 2] = {2, 3, 3, 4, 4, 5, 5, 5};
constant uint SOBOL_POLYNOMIAL[SOBOL_DIMENSIONS - 2] = {1, 1, 2, 1, 4, 2, 4, 7};
constant uint SOBOL_FIRST[SOBOL_DIMENSIONS - 2][5] = {{1, 3}, {1, 3, 1}, {1, 1, 1}, {1, 1, 3, 3}, {1, 3, 5, 13},
                                                      {1, 1, 5, 5, 17}, {1, 1, 5, 5, 5}, {1, 1, 7, 11, 19}};

/* One of them, bit-reversed. Unrolled, so that compilers find the direction numbers where they know the dimension. */
bits sobol_reversed(const bits index, const uint dimension) {
  const uint degree = SOBOL_DEGREE[dimension - 2];
  const uint polynomial = SOBOL_POLYNOMIAL[dimension - 2];
  uint direction[32];
  bits x = (bits)0u;
#pragma unroll
  for (uint k = 0; k < 32; ++k) {
    /* No index has higher bits. */
    if (k % 8 == 0 && !ANY((index >> k) != 0u)) break;
    if (k < degree) {
      direction[k] = SOBOL_FIRST[dimension - 2][k] << (31 - k);
    } else {
      direction[k] = direction[k - degree] ^ (direction[k - degree] >> degree);
      for (uint j = 1; j < degree; ++j)
        if ((polynomial >> (degree - 1 - j) & 1u) != 0) direction[k] ^= direction[k - j];
    }
    x = SELECT(x, x ^ (bits)direction[k], (index >> k & 1u) != 0u);
  }
  return reverse_bits(x);
}

/* Samples `index` (VEC of them) of shading point `point` in the unit square. */
void sample_square(const uint point, const bits index, const uint stream, const uint seed_low,
                   const uint seed_high, real *u, real *v) {
#if SAMPLER == SAMPLER_SOBOL
  /* 1 in the last word keeps these counters apart from the independent sampler's. */
  uint scramble[4] = {0u, point, stream, 1u};
  philox_scalar(scramble, seed_low, seed_high);
  /* The first dimension is the bit-reversed index, so its bit-reversed form is the index itself. */
  *u = to_unit_interval(reverse_bits(owen_hash(index, (bits)scramble[0])) ^ scramble[2]);
  *v = to_unit_interval(reverse_bits(owen_hash(sobol_second_reversed(index), (bits)scramble[1])) ^ scramble[3]);
#else
  bits state[4] = {index, (bits)point, (bits)stream, (bits)0u};
  philox(state, seed_low, seed_high);
  *u = to_unit_interval(state[0]);
  *v = to_unit_interval(state[1]);
#endif
}

/* The same for functions that hardly depend on u. */
void sample_azimuths(const uint point, const bits index, const uint stream, const uint seed_low,
                     const uint seed_high, real *u, real *v) {
#if SAMPLER == SAMPLER_SOBOL
  uint scramble[4] = {0u, point, stream, 1u};
  philox_scalar(scramble, seed_low, seed_high);
  *v = to_unit_interval(reverse_bits(index) ^ scramble[2]);
  *u = to_unit_interval(reverse_bits(owen_hash(sobol_second_reversed(index), (bits)scramble[1])) ^ scramble[3]);
#else
  sample_square(point, index, stream, seed_low, seed_high, u, v);
#endif
}

/* An integer hash (MurmurHash3's finaliser). */
bits mix_bits(const bits word) {
  bits x = word;
  x ^= x >> 16;
  x *= 0x85EBCA6Bu;
  x ^= x >> 13;
  x *= 0xC2B2AE35u;
  return x ^ (x >> 16);
}

/* Coordinates for a bounce (1, 2, ...) of the paths behind samples `index` of shading points `point`: two pairs, and
 * one more from the bits that these leave over. */
void sample_nested(const bits point, const bits index, const uint stream, const uint bounce, const uint seed_low,
                   const uint seed_high, real coordinates[5]) {
#if SAMPLER == SAMPLER_SOBOL
  bits words[4] = {(bits)bounce, point, (bits)stream, (bits)1u};
  philox(words, seed_low, seed_high);
  /* The shifts, which are Philox's, make each point uniform whatever these are. */
  bits seed = mix_bits(point * 0x9E3779B1u + ((seed_low ^ (seed_high << 16)) + bounce * 0x27D4EB2Fu + stream));
#pragma unroll
  for (uint pair = 0; pair < 4; pair += 2) {
    const bits order_seed = seed;
    const bits first_seed = mix_bits(seed + 0x9E3779B9u);
    const bits second_seed = mix_bits(first_seed + 0x9E3779B9u);
    seed = mix_bits(second_seed + 0x9E3779B9u);
    bits first, second;
    /* The direction goes before the point on a light: earlier dimensions are better spread. */
    if (bounce == 1) {
      first = sobol_reversed(index, 4 - pair);
      second = sobol_reversed(index, 5 - pair);
    } else if (bounce == 2) {
      first = sobol_reversed(index, 8 - pair);
      second = sobol_reversed(index, 9 - pair);
    } else {
      first = reverse_bits(owen_hash(reverse_bits(index), order_seed));
      second = sobol_second_reversed(first);
    }
    words[pair] ^= reverse_bits(owen_hash(first, first_seed));
    words[pair + 1] ^= reverse_bits(owen_hash(second, second_seed));
  }
#else
  bits words[4] = {index, point, (bits)stream, (bits)(4u * bounce + 2u)};
  philox(words, seed_low, seed_high);
#endif
  for (uint number = 0; number < 4; ++number) coordinates[number] = to_unit_interval(words[number]);
  coordinates[4] = to_unit_interval((words[0] << 24) | ((words[1] & 255u) << 16) | ((words[2] & 255u) << 8));
}

/* The sampler alone, for tests. */
kernel void square_samples(const uint first_point, const uint point_count, const uint first_sample,
                           const uint stride, const uint stream, const uint seed_low,
                           const uint seed_high, global float *restrict u, global float *restrict v) {
  const uint blocks = stride / VEC;
  const uint item = (uint)get_global_id(0);
  if (item >= point_count * blocks) return;
  const uint at = (item / blocks) * stride + (item % blocks) * VEC;
  real sample_u, sample_v;
  sample_square(first_point + item / blocks, LANE_NUMBER + (first_sample + (item % blocks) * VEC), stream,
                seed_low, seed_high, &sample_u, &sample_v);
  STORE(sample_u, u + at);
  STORE(sample_v, v + at);
}
