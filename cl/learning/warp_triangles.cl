/* Points of the unit square warped to a density that is linear on each triangle of a triangulation.
 *
 * A record (triangulate.cl) lists triangles so that neighbours in the list are neighbours in the square,
 * with cumulative probabilities; u picks the triangle, and the place of u between its two probabilities
 * and v pick the point in it. So an interval of u is a patch of the square, and points that are well
 * spread in u are well spread over the patches. How they lie across patches is not kept, as warp.cl
 * keeps it.
 *
 * Record, 32-bit words: RECORD_COUNT (uint, triangles), RECORD_CUMULATIVE (float, one more than
 * triangles, from 0 to 1), RECORD_CORNERS (uint, three vertices of VERTEX_BITS each), RECORD_SCALES
 * (float, one a triangle), RECORD_X, RECORD_Y and RECORD_VALUES (float, one a vertex). On triangle t, of
 * area A and probability P, the density is proportional to the linear function that is
 * c = scale * value + UNIFORM_SHARE at the corners:
 *
 *   p(x) = P / A * c(x) / ((c0 + c1 + c2) / 3)
 *
 * Its inverse: r runs from corner 0 to the opposite side and has the distribution function 3 k
 * r^2 + (1 - 3 k) r^3 with k = c0 / (c0 + c1 + c2), q runs along that side with a density that is linear
 * from its value on one edge to that on the other. Corner 0 has the least value, so k <= 1/3 and the
 * cubic is convex: Newton's method from above falls to the root, and INVERSION_STEPS leave rounding
 * only.
 *
 * Probabilities are differences of stored numbers, so the density integrates to one whatever was
 * rounded.
 *
 * Work-group contract: none; pure functions of private values, VEC samples at a time.
 */

#define DENSITY_WORDS RECORD_WORDS
/* Records are those of the batch. */
#define RECORD_NUMBER(point, in_batch) (in_batch)
/* The largest number below 1. */
#define BELOW_ONE 0x1.fffffep-1f
#define INVERSION_STEPS 4

typedef struct {
  real x;
  real y;
  real value;
} Corner;

Corner load_corner(global const float *restrict record, const bits corners, const uint number, const real scale) {
  const whole at = TO_WHOLE((corners >> (number * VERTEX_BITS)) & VERTEX_MASK);
  Corner corner;
  corner.x = gather(record + RECORD_X, at);
  corner.y = gather(record + RECORD_Y, at);
  corner.value = FMA(scale, gather(record + RECORD_VALUES, at), (real)UNIFORM_SHARE);
  return corner;
}

/* The last triangle whose cumulative probability does not exceed u: never one of probability zero. */
whole find_triangle(global const float *restrict record, const real u) {
  const int count = (int)((global const uint *)record)[RECORD_COUNT];
  int step = 1;
  while (2 * step < count) step *= 2;
  whole triangle = (whole)0;
  for (; step > 0; step /= 2) {
    const whole next = min(triangle + step, (whole)(count - 1));
    triangle = SELECT(triangle, next, u >= gather(record + RECORD_CUMULATIVE, next));
  }
  return triangle;
}

/* The r for which 3 k r^2 + (1 - 3 k) r^3 = x. */
real invert_cubic(const real k, const real x) {
  const real square = 3.0f * k;
  const real cube = 1.0f - square;
  /* Each term alone is at most x. */
  real r = min(sqrt(x / square), exp2(log2(x) * (1.0f / 3.0f)));
  for (int step = 0; step < INVERSION_STEPS; ++step) {
    const real excess = FMA(r * r, FMA(cube, r, square), -x);
    const real slope = r * FMA(3.0f * cube, r, 2.0f * square);
    r -= excess / max(slope, (real)1e-20f);
  }
  return clamp(r, (real)0.0f, (real)1.0f);
}

/* Warps (u, v); returns one over the density there. */
real warp_square(global const uint *restrict words, real *u, real *v) {
  global const float *restrict record = (global const float *)words;
  const whole triangle = find_triangle(record, *u);
  const real lower = gather(record + RECORD_CUMULATIVE, triangle);
  const real probability = gather(record + RECORD_CUMULATIVE, triangle + 1) - lower;
  const bits corners = gather_bits(words + RECORD_CORNERS, TO_BITS(triangle));
  const real scale = gather(record + RECORD_SCALES, triangle);
  const Corner c0 = load_corner(record, corners, 0, scale);
  const Corner c1 = load_corner(record, corners, 1, scale);
  const Corner c2 = load_corner(record, corners, 2, scale);
  const real sum = c0.value + c1.value + c2.value;

  const real r = invert_cubic(c0.value / sum, clamp((*u - lower) / probability, (real)0.0f, (real)1.0f));
  const real first = FMA(r, c1.value - c0.value, c0.value);
  const real last = FMA(r, c2.value - c0.value, c0.value);
  const real root = sqrt(FMA(*v, FMA(last, last, -first * first), first * first));
  const real q = min(*v * (first + last) / (first + root), (real)1.0f);

  *u = clamp(FMA(r, FMA(q, c2.x - c1.x, c1.x - c0.x), c0.x), (real)0.0f, (real)BELOW_ONE);
  *v = clamp(FMA(r, FMA(q, c2.y - c1.y, c1.y - c0.y), c0.y), (real)0.0f, (real)BELOW_ONE);
  const real area = 0.5f * fabs(FMA(c1.x - c0.x, c2.y - c0.y, -(c1.y - c0.y) * (c2.x - c0.x)));
  return area * sum / (3.0f * probability * FMA(q, last - first, first));
}
