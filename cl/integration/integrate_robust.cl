/* The robust path: the same integrals for the few points whose arrangement was not certified in any
 * precision.
 *
 * There is no shared topology that rounding could break: only a stack of convex polygons, each cut by
 * one line after the other (Sutherland and Hodgman 1974). Both parts of a cut have its two new corners,
 * so areas always add up. A line that comes closer than rounding to leaving a polygon on one side does
 * not cut it. Everything is done in double precision where the device has it (-D ROBUST_DOUBLE), else in
 * float. Many times slower than the arrangement, and its result does not depend on the method.
 *
 * A polygon on the stack knows the layer and the neuron whose line cuts it next. Lines of a layer are
 * valid for all polygons on the stack that still need them, since the traversal is depth first. After
 * the last hidden layer but one the closed form of integrate_decoupled.cl integrates the last one.
 *
 * Memory: one Robust per work-item, global. Work-group contract: work-items are independent (groups of
 * one), no barriers; each pops points from `retry`.
 */

#if ROBUST_DOUBLE
#pragma OPENCL EXTENSION cl_khr_fp64 : enable
typedef double precise;
#define PRECISE_EPSILON DBL_EPSILON
#else
typedef float precise;
#define PRECISE_EPSILON FLT_EPSILON
#endif

/* Below every exponent of a number, and far from overflow when a few are added. */
#define LOWEST_EXPONENT (-100000)

typedef struct {
  int start;
  int corners;
  int layer;
  int neuron;
} Polygon;

/* a, b, c of a x + b y + c, and what rounding left of them. */
typedef struct {
  precise value[3];
  precise low[3];
} Line;

typedef struct {
  precise matrix[ROBUST_MATRIX_NUMBERS];
  precise bias[ROBUST_BIAS_NUMBERS];
  int exponent[ROBUST_BIAS_NUMBERS];
  Line line[HIDDEN * ROBUST_WIDTH];
  precise moment[ROBUST_WIDTH];
  precise terms[2 * ROBUST_WIDTH];
  /* The polygon in hand, its values for the current line, and its part on the positive side. */
  precise x[ROBUST_CORNERS];
  precise y[ROBUST_CORNERS];
  precise side[ROBUST_CORNERS];
  precise kept_x[ROBUST_CORNERS];
  precise kept_y[ROBUST_CORNERS];
  precise area;
  int failed;
  Polygon stack[ROBUST_POLYGONS];
  precise stack_x[ROBUST_POLYGONS * ROBUST_CORNERS];
  precise stack_y[ROBUST_POLYGONS * ROBUST_CORNERS];
} __attribute__((aligned(64))) Robust;

__constant int ROBUST_WIDTHS[] = {WIDTHS};
__constant int ROBUST_MATRIX_OFFSET[] = {ROBUST_MATRIX_OFFSETS};
__constant int ROBUST_BIAS_OFFSET[] = {ROBUST_BIAS_OFFSETS};

__kernel void robust_memory(__global int *bytes) { bytes[0] = (int)sizeof(Robust); }

int precise_exponent(const precise x) { return x == 0 ? LOWEST_EXPONENT : ilogb(x); }

/* Copies layer k, each neuron scaled by a power of two so that its largest parameter lies in [1, 2). */
void robust_load(__global Robust *r, const int k, __global const stored *weights,
                 __global const stored *biases) {
  const int inputs = ROBUST_WIDTHS[k];
  __global const int *before = r->exponent + (k > 0 ? ROBUST_BIAS_OFFSET[k - 1] : 0);
  for (int j = 0; j < ROBUST_WIDTHS[k + 1]; ++j) {
    int largest = precise_exponent((precise)biases[j]);
    for (int i = 0; i < inputs; ++i)
      largest = max(largest, precise_exponent((precise)weights[j * inputs + i]) + (k > 0 ? before[i] : 0));
    for (int i = 0; i < inputs; ++i)
      r->matrix[ROBUST_MATRIX_OFFSET[k] + j * inputs + i] =
          ldexp((precise)weights[j * inputs + i], (k > 0 ? before[i] : 0) - largest);
    r->bias[ROBUST_BIAS_OFFSET[k] + j] = ldexp((precise)biases[j], -largest);
    r->exponent[ROBUST_BIAS_OFFSET[k] + j] = largest;
  }
}

/* sum + low += x * (y + y_low), to twice the precision: the rounding of product and sum goes to `low`
 * (Ogita, Rump, Oishi 2005, Accurate sum and dot product, algorithms 3.1 and 3.5). */
void add_product(precise *sum, precise *low, const precise x, const precise y, const precise y_low) {
  const precise product = x * y;
  const precise total = *sum + product;
  const precise before = total - *sum;
  *low += (*sum - (total - before)) + (product - before) + fma(x, y, -product) + x * y_low;
  *sum = total;
}

/* The affine functions of layer k inside the polygon in hand, where those of layer k - 1 keep their
 * signs. Where hidden neurons cancel, little is left of large terms, so that sums are carried to twice
 * the precision. */
void robust_lines(__global Robust *r, const int k, const int corners) {
  const int outputs = ROBUST_WIDTHS[k + 1];
  const int inputs = ROBUST_WIDTHS[k];
  __global const precise *matrix = r->matrix + ROBUST_MATRIX_OFFSET[k];
  __global const precise *bias = r->bias + ROBUST_BIAS_OFFSET[k];
  if (k == 0) {
    for (int j = 0; j < outputs; ++j) {
      r->line[j] = (Line){{matrix[2 * j], matrix[2 * j + 1], bias[j]}, {0, 0, 0}};
    }
    return;
  }
  precise mean_x = 0;
  precise mean_y = 0;
  for (int i = 0; i < corners; ++i) {
    mean_x += r->x[i] / (precise)corners;
    mean_y += r->y[i] / (precise)corners;
  }
  for (int j = 0; j < outputs; ++j) {
    Line line = {{0, 0, bias[j]}, {0, 0, 0}};
    for (int i = 0; i < inputs; ++i) {
      const Line before = r->line[(k - 1) * ROBUST_WIDTH + i];
      const bool active = before.value[0] * mean_x + before.value[1] * mean_y + before.value[2] >= 0;
      const precise weight = active ? matrix[j * inputs + i] : matrix[j * inputs + i] * (precise)NEGATIVE_SLOPE;
      for (int m = 0; m < 3; ++m) add_product(&line.value[m], &line.low[m], weight, before.value[m], before.low[m]);
    }
    for (int m = 0; m < 3; ++m) {
      const precise rounded = line.value[m] + line.low[m];
      line.low[m] -= rounded - line.value[m];
      line.value[m] = rounded;
    }
    r->line[k * ROBUST_WIDTH + j] = line;
  }
}

/* Cuts the polygon in hand by the line of neuron i of layer k. The positive part stays in hand, the
 * negative one goes to the top of the stack, to go on with the next neuron. Returns the corners in
 * hand. */
int robust_cut(__global Robust *r, int *height, const int k, const int i, const int corners) {
  const Line line = r->line[k * ROBUST_WIDTH + i];
  const precise a = line.value[0];
  const precise b = line.value[1];
  const precise c = line.value[2];
  precise low = 0;
  precise high = 0;
  for (int v = 0; v < corners; ++v) {
    r->side[v] = a * r->x[v] + b * r->y[v] + c;
    low = fmin(low, r->side[v]);
    high = fmax(high, r->side[v]);
  }
  const precise rounding = 8 * PRECISE_EPSILON * (fabs(a) + fabs(b) + fabs(c));
  if (-low <= rounding || high <= rounding) return corners;
  if (*height == ROBUST_POLYGONS) {
    r->failed = 1;
    return corners;
  }
  const int start = *height * ROBUST_CORNERS;
  int above = 0;
  int below = 0;
  for (int v = 0; v < corners; ++v) {
    const int w = v + 1 < corners ? v + 1 : 0;
    if (above + 2 > ROBUST_CORNERS || below + 2 > ROBUST_CORNERS) {
      r->failed = 1;
      return corners;
    }
    if (r->side[v] >= 0) {
      r->kept_x[above] = r->x[v];
      r->kept_y[above++] = r->y[v];
    } else {
      r->stack_x[start + below] = r->x[v];
      r->stack_y[start + below++] = r->y[v];
    }
    if ((r->side[v] < 0) != (r->side[w] < 0)) {
      /* From the end nearer to the line, as in dcel.cl. */
      const int near = fabs(r->side[v]) <= fabs(r->side[w]) ? v : w;
      const int far = near == v ? w : v;
      const precise t = r->side[near] / (r->side[near] - r->side[far]);
      const precise x = r->x[near] + t * (r->x[far] - r->x[near]);
      const precise y = r->y[near] + t * (r->y[far] - r->y[near]);
      r->kept_x[above] = x;
      r->kept_y[above++] = y;
      r->stack_x[start + below] = x;
      r->stack_y[start + below++] = y;
    }
  }
  for (int v = 0; v < above; ++v) {
    r->x[v] = r->kept_x[v];
    r->y[v] = r->kept_y[v];
  }
  const Polygon cut = {start, below, k, i + 1};
  r->stack[(*height)++] = cut;
  return above;
}

/* The integral of relu(z) over a triangle, divided by a third of its area, from the values at its
 * corners. */
precise robust_relu_integral(const precise p, const precise q, const precise s) {
  const precise z0 = fmin(fmin(p, q), s);
  const precise z2 = fmax(fmax(p, q), s);
  const precise z1 = fmax(fmin(p, q), fmin(fmax(p, q), s));
  if (z2 <= 0) return 0;
  if (z0 >= 0) return z0 + z1 + z2;
  if (z1 <= 0) return z2 * (z2 / (z2 - z1)) * (z2 / (z2 - z0));
  return (z1 + z2) * (z2 / (z2 - z0)) + z1 * (z1 / (z1 - z0)) * (-z0 / (z2 - z0));
}

/* Adds the polygon in hand, in which the neurons of the last hidden layer are affine. */
void robust_leaf(__global Robust *r, const int corners) {
  const int first = (HIDDEN - 1) * ROBUST_WIDTH;
  for (int v = 2; v < corners; ++v) {
    const precise doubled = (r->x[v - 1] - r->x[0]) * (r->y[v] - r->y[0]) -
                            (r->x[v] - r->x[0]) * (r->y[v - 1] - r->y[0]);
    r->area += fabs(doubled) / 2;
    for (int j = 0; j < ROBUST_WIDTHS[HIDDEN]; ++j) {
      const Line line = r->line[first + j];
      const precise a = line.value[0];
      const precise b = line.value[1];
      const precise c = line.value[2];
      const precise z0 = a * r->x[0] + b * r->y[0] + c;
      const precise z1 = a * r->x[v - 1] + b * r->y[v - 1] + c;
      const precise z2 = a * r->x[v] + b * r->y[v] + c;
      const precise positive = robust_relu_integral(z0, z1, z2);
      const precise negative = z0 + z1 + z2 - positive;
      r->moment[j] += doubled / 6 * (positive + (LEAKY ? (precise)NEGATIVE_SLOPE * negative : 0));
    }
  }
}

/* Visits all cells of the point in hand. */
void robust_network(__global Robust *r) {
  for (int j = 0; j < ROBUST_WIDTH; ++j) r->moment[j] = 0;
  r->area = 0;
  r->failed = 0;
  for (int i = 0; i < 4; ++i) {
    r->x[i] = (precise)(i == 1 || i == 2);
    r->y[i] = (precise)(i >= 2);
  }
  robust_lines(r, 0, 4);
  int corners = 4;
  int height = 0;
  int k = 0;
  int i = 0;
  for (;;) {
    while (k < HIDDEN - 1 && !r->failed) {
      for (; i < ROBUST_WIDTHS[k + 1]; ++i) corners = robust_cut(r, &height, k, i, corners);
      robust_lines(r, ++k, corners);
      i = 0;
    }
    robust_leaf(r, corners);
    if (height == 0 || r->failed) break;
    const Polygon next = r->stack[--height];
    corners = next.corners;
    k = next.layer;
    i = next.neuron;
    for (int v = 0; v < corners; ++v) {
      r->x[v] = r->stack_x[next.start + v];
      r->y[v] = r->stack_y[next.start + v];
    }
  }
}

/* Writes G of a point; returns whether it is certified. */
bool robust_write(__global const Robust *r, __global stored *G) {
  const int inputs = ROBUST_WIDTHS[HIDDEN];
  bool certified = !r->failed && fabs(r->area - 1) <= (precise)ROBUST_AREA_TOLERANCE;
  for (int j = 0; j < ROBUST_WIDTHS[HIDDEN + 1]; ++j) {
    precise sum = r->bias[ROBUST_BIAS_OFFSET[HIDDEN] + j];
    for (int i = 0; i < inputs; ++i)
      sum += r->matrix[ROBUST_MATRIX_OFFSET[HIDDEN] + j * inputs + i] * r->moment[i];
    G[j] = (stored)ldexp(sum, r->exponent[ROBUST_BIAS_OFFSET[HIDDEN] + j]);
    certified = certified && isfinite(G[j]);
  }
  return certified;
}

#if WRITE_MOMENTS
void robust_write_moments(__global const Robust *r, __global stored *moments) {
  for (int j = 0; j < ROBUST_WIDTHS[HIDDEN]; ++j)
    moments[j] = (stored)ldexp(r->moment[j], r->exponent[ROBUST_BIAS_OFFSET[HIDDEN - 1] + j]);
}
#endif

#if WRITE_BOUND
/* The rounding bound of integrate_check.cl, in this path's precision. There is no subdivision to be
 * wrong. */
void robust_write_bound(__global Robust *r, __global const stored *G, __global stored *bound) {
  for (int k = 0; k <= HIDDEN; ++k) {
    const int inputs = ROBUST_WIDTHS[k];
    __global const precise *before = r->terms + (k + 1) % 2 * ROBUST_WIDTH;
    for (int j = 0; j < ROBUST_WIDTHS[k + 1]; ++j) {
      precise sum = fabs(r->bias[ROBUST_BIAS_OFFSET[k] + j]);
      for (int i = 0; i < inputs; ++i)
        sum += fabs(r->matrix[ROBUST_MATRIX_OFFSET[k] + j * inputs + i]) *
               (k > 0 ? before[i] : (precise)0.5f);
      if (k < HIDDEN)
        r->terms[k % 2 * ROBUST_WIDTH + j] = sum * (precise)GREATEST_SLOPE;
      else
        bound[j] = (stored)ldexp(ROUNDINGS * PRECISE_EPSILON * sum, r->exponent[ROBUST_BIAS_OFFSET[k] + j]) +
                   STORED_EPSILON * fabs(G[j]);
    }
  }
}
#endif

#define ROBUST_LOAD(k)                                                                               \
  robust_load(r, k,                                                                                  \
              weights_##k + PER_POINT_WEIGHTS_##k * p * (size_t)(ROBUST_WIDTHS[k] * ROBUST_WIDTHS[(k) + 1]), \
              biases_##k + PER_POINT_BIASES_##k * p * (size_t)ROBUST_WIDTHS[(k) + 1]);

/* The points list[0, count). counters as for integrate.cl; points that fail here too are appended to
 * `failed`. */
__kernel __attribute__((reqd_work_group_size(1, 1, 1)))
void integrate_robust(const int count, __global int *counters, __global const int *list, __global int *failed,
                      __global stored *G,
#if WRITE_MOMENTS
                      __global stored *moments,
#endif
#if WRITE_BOUND
                      __global stored *bounds,
#endif
                      __global Robust *all_work,
                      NETWORK_ARGUMENTS) {
  __global Robust *r = all_work + get_group_id(0);
  int next = atomic_inc(&counters[COUNT_HEAD]);
  for (; next < count; next = atomic_inc(&counters[COUNT_HEAD])) {
    const int point = list[next];
    const size_t p = (size_t)point;
    __global stored *result = G + p * (size_t)ROBUST_WIDTHS[HIDDEN + 1];
    FOR_EACH_LAYER(ROBUST_LOAD)
    robust_network(r);
#if WRITE_MOMENTS
    robust_write_moments(r, moments + p * (size_t)ROBUST_WIDTHS[HIDDEN]);
#endif
    if (!robust_write(r, result)) failed[atomic_inc(&counters[COUNT_RETRY])] = point;
#if WRITE_BOUND
    robust_write_bound(r, result, bounds + p * (size_t)ROBUST_WIDTHS[HIDDEN + 1]);
#endif
    atomic_inc(&counters[COUNT_FINISHED]);
  }
  if (next >= count) atomic_inc(&counters[COUNT_TEAMS]);
}
