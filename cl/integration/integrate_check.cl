/* Certification of a point's integral: one test of the subdivision, and one of the rounding.
 *
 * Subdivision. relu is convex. Where a face is cut too little, a neuron that changes sign in it is taken
 * to be linear between the face's vertices (decoupled, last arrangement), or to have one sign
 * (elsewhere). The first makes the neuron's integral too large, never too small, the second too small,
 * never too large. So the difference to the closed form over the cell that was subdivided,
 *
 *   D_i = | integral of neuron i over the faces - integral of neuron i over the cell |,
 *
 * is the L1 norm of the subdivision's error in this neuron, and the errors of different neurons and
 * cells cannot cancel each other. `excess` gathers D_i / terms_i, signed as the method has it, over all
 * neurons of all arrangements; it must stay within EXCESS_TOLERANCE, which is rounding. The sum of areas
 * alone says nothing of this: chords split faces by construction, so areas always add up.
 *
 * Rounding. terms_i is the mean over the square of the magnitudes that are added up on the way to neuron
 * i's value, as if all neurons were on (half the first weights, as u and v are one half on average). It
 * follows that
 *
 *   |G - exact| <= terms (EXCESS_TOLERANCE + ROUNDINGS * epsilon)
 *
 * to first order in epsilon, with the output channel's own terms; ROUNDINGS counts the operations on the
 * way (certificate.py). This bound is written where it is asked for. It is some hundred times too large
 * on ordinary networks, so a smaller number decides, the condition: the same sum, with each neuron's
 * terms only where it is on, divided by what remains after cancellation, Σ |w_j| M_j + |b|. If it
 * exceeds CONDITION_LIMIT, the point is done again in double precision. `open` is the share of the
 * square where a neuron is on.
 *
 * Work-group contract: functions named leader_* for lane 0 between barriers; the others for all lanes.
 * sum_terms and sum_on_terms hold barriers, the others do not.
 */

#if DOUBLE
#define EPSILON DBL_EPSILON
#else
#define EPSILON FLT_EPSILON
#endif

/* ---- rounding ------------------------------------------------------------------------------------ */

/* Without bounds, the decoupled method asks for the terms of what is arranged only. */
#if METHOD_FULL || WRITE_BOUND
#define TERM_LAYERS HIDDEN
#else
#define TERM_LAYERS (HIDDEN - 1)
#endif

/* `terms` of hidden neurons, and their inverse. */
void sum_terms(SPACE const Workspace *work, TABLES Tables *tables, const int lane) {
  for (int k = 0; k < TERM_LAYERS; ++k) {
    TABLES const number *before = tables->terms + (k > 0 ? BIAS_OFFSET[k - 1] : 0);
    for (int j = lane * VEC; j < STRIDE[k]; j += LANES * VEC) {
      TABLES const number *matrix = layer_matrix(work, tables, k) + j;
      numbers sum = fabs(LOAD(layer_bias(work, tables, k) + j));
      for (int i = 0; i < WIDTH[k]; ++i)
        sum = FMA(fabs(LOAD(matrix + i * STRIDE[k])), (numbers)(k > 0 ? before[i] : (number)0.5f), sum);
      sum *= (number)GREATEST_SLOPE;
      PUT(sum, TABLES, tables->terms + BIAS_OFFSET[k] + j);
      PUT(sum > 0 ? (number)1 / GREATER(sum, (numbers)TINY) : (numbers)0, TABLES,
          tables->inverse_terms + BIAS_OFFSET[k] + j);
    }
    BARRIER();
  }
}

/* The mean over the square of neurons' terms where they are on, in `on_terms`; of all hidden layers but
 * the last, the mean over where they are on. Where neurons of two layers are on together is not known;
 * their share is bounded by the smaller of the two. */
void sum_on_terms(SPACE const Workspace *work, TABLES Tables *tables, const int lane) {
  for (int k = 0; k < HIDDEN; ++k) {
    const int before = k > 0 ? BIAS_OFFSET[k - 1] : 0;
    for (int j = lane * VEC; j < STRIDE[k]; j += LANES * VEC) {
      TABLES const number *matrix = layer_matrix(work, tables, k) + j;
      numbers share = LOAD(tables->open + BIAS_OFFSET[k] + j);
#if LEAKY
      share = FMA((numbers)fabs((number)NEGATIVE_SLOPE), (number)1 - share, share);
#endif
      numbers sum = share * fabs(LOAD(layer_bias(work, tables, k) + j));
      for (int i = 0; i < WIDTH[k]; ++i) {
        const numbers both = k > 0 ? LESSER(share, (numbers)tables->open[before + i]) : share;
        const number terms = k > 0 ? tables->on_terms[before + i] : (number)0.5f;
        sum = FMA(fabs(LOAD(matrix + i * STRIDE[k])), both * terms, sum);
      }
      if (k < HIDDEN - 1) sum = share > 0 ? sum / GREATER(share, (numbers)TINY) : (numbers)0;
      PUT(sum, TABLES, tables->on_terms + BIAS_OFFSET[k] + j);
    }
    BARRIER();
  }
}

/* ---- subdivision --------------------------------------------------------------------------------- */

#if HIDDEN > 0

/* The integral of the activation of z over a triangle, divided by a third of the triangle's area; z0,
 * z1, z2 are the values at its vertices.
 *
 * With values sorted low <= middle <= high, the integral of relu over the area / 3 is
 *   low >= 0           low + middle + high
 *   high <= 0          0
 *   middle <= 0 < high high * high / (high - middle) * high / (high - low)
 *   low < 0 < middle   (middle + high) * high / (high - low)
 *                      + middle * middle / (middle - low) * -low / (high - low)
 * The last is the sum of all less the negative corner, low + middle + high - low^3 / ((middle - low)
 * (high - low)), multiplied out: so all terms are positive and all ratios at most 1, and nothing
 * cancels, however much the negative value outweighs the others. TINY keeps 0 / 0 and overflow out.
 * `open` is the share of the triangle where z is positive. */
numbers triangle_integral(const numbers z0, const numbers z1, const numbers z2, numbers *open) {
  const numbers lesser = LESSER(z0, z1);
  const numbers greater = GREATER(z0, z1);
  const numbers low = LESSER(lesser, z2);
  const numbers high = GREATER(GREATER(greater, z2), (numbers)0);
  const numbers middle = GREATER(lesser, LESSER(greater, z2));
  const numbers below = LESSER(low, (numbers)0);
  const numbers inverse = (number)1 / GREATER(high - below, (numbers)TINY);
  const numbers share = high * inverse;
  /* The positive value whose edge to the other side is cut, and the length of that edge. */
  const numbers cut = middle > 0 ? middle : high;
  const numbers edge = middle > 0 ? middle - below : high - middle;
  const numbers ratio = cut / GREATER(edge, (numbers)TINY);
  const numbers part = cut * ratio;
  *open = middle > 0 ? FMA(ratio, (number)1 - share, share) : ratio * share;
  const numbers two_above = FMA(middle + high, share, FMA(part, -below * inverse, low - below));
  const numbers positive = middle > 0 ? two_above : part * share;
#if LEAKY
  return FMA((numbers)(number)NEGATIVE_SLOPE, z0 + z1 + z2 - positive, positive);
#else
  return positive;
#endif
}

/* The integrals of neurons [j, j + VEC) of layer k over the cell that arrangement k subdivides, in
 * closed form; and a third of the area where they are on. */
numbers cell_integral(SPACE const Workspace *work, const int k, const int j, numbers *open) {
  SPACE const Dcel *d = &work->arrangement[k];
  const numbers a = LOAD(work->lines[k].a + j);
  const numbers b = LOAD(work->lines[k].b + j);
  const numbers c = LOAD(work->lines[k].c + j);
  const number x0 = d->x[0];
  const number y0 = d->y[0];
  number x1 = d->x[1];
  number y1 = d->y[1];
  const numbers z0 = FMA(a, (numbers)x0, FMA(b, (numbers)y0, c));
  numbers z1 = FMA(a, (numbers)x1, FMA(b, (numbers)y1, c));
  numbers sum = 0;
  numbers open_sum = 0;
  for (int v = 2; v < d->corners; ++v) {
    const number x2 = d->x[v];
    const number y2 = d->y[v];
    const numbers z2 = FMA(a, (numbers)x2, FMA(b, (numbers)y2, c));
    const number third_area = cross_product(x2 - x1, y2 - y1, x0 - x1, y0 - y1) * ((number)1 / (number)6);
    numbers share;
    sum = FMA((numbers)third_area, triangle_integral(z0, z1, z2, &share), sum);
    open_sum = FMA((numbers)third_area, share, open_sum);
    x1 = x2;
    y1 = y2;
    z1 = z2;
  }
  *open = open_sum;
  return sum;
}

/* excess += (integrals of neurons [j, j + VEC) of layer k) / terms. */
void add_excess(TABLES Tables *tables, const int k, const int j, const numbers integral, const int lane) {
  const numbers share = LOAD(tables->inverse_terms + BIAS_OFFSET[k] + j);
  TABLES number *excess = tables->excess + lane * VEC;
  PUT(FMA(integral, share, LOAD(excess)), TABLES, excess);
}

/* Adds the closed forms over the cell of arrangement k to `excess`, or takes them off, and its part to
 * `open`. */
void add_cell(SPACE const Workspace *work, TABLES Tables *tables, const int k, const number sign, const int lane) {
  for (int j = lane * VEC; j < STRIDE[k]; j += LANES * VEC) {
    numbers share;
    add_excess(tables, k, j, sign * cell_integral(work, k, j, &share), lane);
    TABLES number *open = tables->open + BIAS_OFFSET[k] + j;
    PUT(FMA((numbers)3, share, LOAD(open)), TABLES, open);
  }
}

/* The integrals of neurons [j, j + VEC) of layer k over a face, in which each has the sign that it has
 * at the mean of the corners. */
numbers face_integral(SPACE const Lines *lines, const int j, const Face face) {
  const numbers a = LOAD(lines->a + j);
  const numbers b = LOAD(lines->b + j);
  const numbers c = LOAD(lines->c + j);
  const numbers mean = FMA(a, (numbers)face.mean_x, FMA(b, (numbers)face.mean_y, c));
  const numbers integral = FMA(a, (numbers)face.x, FMA(b, (numbers)face.y, c * (numbers)face.area));
#if LEAKY
  return mean < 0 ? (number)NEGATIVE_SLOPE * integral : integral;
#else
  return mean < 0 ? (numbers)0 : integral;
#endif
}

/* Takes off what the current face of arrangement k makes of its neurons. */
void subtract_face(SPACE const Workspace *work, TABLES Tables *tables, const int k, const int lane) {
  for (int j = lane * VEC; j < STRIDE[k]; j += LANES * VEC)
    add_excess(tables, k, j, -face_integral(&work->lines[k], j, work->face), lane);
}

#endif

/* ---- verdict ------------------------------------------------------------------------------------- */

/* The reason for which a point has to be done again: which of `counters` counts it; 0: none, it is
 * certified. */
int leader_verdict(SPACE const Workspace *work, TABLES const Tables *tables) {
  bool finite = true;
  for (int j = 0; j < WIDTH[HIDDEN + 1]; ++j) finite = finite && isfinite((stored)tables->output[j]);
#if HIDDEN > 0
  bool failed = false;
  for (int k = 0; k < ARRANGEMENTS; ++k) failed = failed || work->arrangement[k].failed;
  numbers excess = LOAD(tables->excess);
  for (int i = 1; i < LANES; ++i) excess += LOAD(tables->excess + i * VEC);
  if (failed) return COUNT_WALK;
  if (!(fabs(work->area - 1) <= (number)AREA_TOLERANCE)) return COUNT_AREA;
  if (!(fabs(sum_numbers(excess)) <= (number)EXCESS_TOLERANCE)) return COUNT_EXCESS;
#endif
  if (!finite) return COUNT_OVERFLOW;
  return work->ill_conditioned ? COUNT_CONDITION : 0;
}
