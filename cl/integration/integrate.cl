/* Exact integrals over the unit square of ReLU networks g(u, v), one network per shading point.
 *
 * Depth first: one Dcel per arrangement, reused from face to face. Arrangement k consists of the lines
 * of hidden layer k inside one face of arrangement k - 1; inside one of its faces all neurons of the
 * layers up to k are affine, so the neurons of layer k + 1 are lines there. METHOD_FULL builds
 * arrangements for all hidden layers; in a face of the last one every last-layer neuron is affine and
 * keeps its sign, and its integral follows from the face's area and first moments. Otherwise (decoupled)
 * the last hidden layer is never cut: its neurons are affine on the triangles of the arrangement before,
 * where the integral of relu(z) has a closed form in the values at the three vertices
 * (triangle_integral). Both give M[j], the integral of last-layer neuron j, and G = b + W M.
 *
 * Certification (integrate_check.cl). Every line must pass the checks of dcel.cl, the absolute areas of
 * all triangles must sum to 1, the subdivision's error and the rounding must be small, and G must be
 * finite. Points that fail are appended to `retry`: in single precision the same kernel does them again
 * in double (-D SINGLE_ARRAYS, -D LISTED), then integrate_robust.
 *
 * Memory. One Workspace (SPACE: local on GPUs if it fits) and one Tables (global) for each LANES
 * work-items; both are private where -D LONE has a work-item to itself.
 * Network parameters are row-major (n_out, n_in), with a leading points axis where -D
 * PER_POINT_WEIGHTS_k or PER_POINT_BIASES_k is 1. In Tables matrices lie transposed, outputs padded with
 * zeros to whole vectors, so that VEC neurons are one load.
 *
 * Work-group contract: LANES work-items own one point at a time, and a group is one such team. Groups
 * are persistent: the leader pops a run of points from the queue (counters[0]), all read it after a
 * barrier, and all leave on the same condition; no group ever waits for another. Barriers stand only
 * under conditions that are uniform in the group. With -D LONE, of small networks on GPUs, LANES is 1
 * and groups are of GROUP_ITEMS such teams, which have nothing to do with each other; no barriers.
 */

/* ---- from face to face -------------------------------------------------------------------------- */

#if HIDDEN > 0
/* Makes the next face of arrangement k the cell of arrangement k + 1; returns whether one was left. */
bool leader_descend(SPACE Workspace *work, const int k) {
  SPACE Dcel *parent = &work->arrangement[k];
  SPACE Dcel *child = &work->arrangement[k + 1];
  if (parent->visited == parent->faces) return false;
  const int first = parent->face[parent->visited++];
  const number x0 = parent->x[parent->edge[first].origin];
  const number y0 = parent->y[parent->edge[first].origin];
  number x1 = 0;
  number y1 = 0;
  Face face = {0, 0, 0, 0, 0, 0};
  int corners = 0;
  int e = first;
  do {
    if (corners == CORNER_BOUND[k + 1]) {
      parent->failed = 1;
      return false;
    }
    const int v = parent->edge[e].origin;
    const number x = parent->x[v];
    const number y = parent->y[v];
    child->x[corners] = x;
    child->y[corners] = y;
    child->edge[corners].tag = (ushort)(parent->edge[e].tag & TAG_MASK);
    add_to_face(&face, cross_product(x1, y1, x - x0, y - y0), x1 + x - x0, y1 + y - y0);
    face.mean_x += x;
    face.mean_y += y;
    x1 = x - x0;
    y1 = y - y0;
    e = parent->edge[e].next;
    ++corners;
  } while (e != first);
  finish_face(&face, x0, y0, corners);
  work->face = face;
  leader_begin_cell(child, corners);
  return true;
}

/* Goes to the next cell, depth first, and leaves its arrangement in `level`: -1 after the last cell, or
 * where an arrangement failed. */
void leader_next_cell(SPACE Workspace *work) {
  int k = LESSER(work->level, LAST_ARRANGEMENT - 1);
  for (int i = 0; i < ARRANGEMENTS; ++i) k = work->arrangement[i].failed ? -1 : k;
  while (k >= 0 && !leader_descend(work, k)) --k;
  work->level = k < 0 ? -1 : k + 1;
}

/* The affine functions of layer k + 1 inside the current face of arrangement k. */
void next_lines(SPACE Workspace *work, TABLES const Tables *tables, const int k, const int lane) {
  SPACE const Lines *lines = &work->lines[k];
  SPACE Lines *next = &work->lines[k + 1];
  const int inputs = WIDTH[k + 1];
  const int stride = STRIDE[k + 1];
  TABLES const number *matrix = layer_matrix(work, tables, k + 1);
  TABLES const number *bias = layer_bias(work, tables, k + 1);
  const number mean_x = work->face.mean_x;
  const number mean_y = work->face.mean_y;
  for (int j = lane * VEC; j < stride; j += LANES * VEC) {
    numbers a = 0;
    numbers b = 0;
    numbers c = LOAD(bias + j);
    for (int i = 0; i < inputs; ++i) {
      const bool active = FMA(lines->a[i], mean_x, FMA(lines->b[i], mean_y, lines->c[i])) >= 0;
#if LEAKY
      const numbers weight =
          LOAD(matrix + i * stride + j) * (active ? (number)1 : (number)NEGATIVE_SLOPE);
#else
      if (!active) continue;
      const numbers weight = LOAD(matrix + i * stride + j);
#endif
      a = FMA(weight, (numbers)lines->a[i], a);
      b = FMA(weight, (numbers)lines->b[i], b);
      c = FMA(weight, (numbers)lines->c[i], c);
    }
    PUT(a, SPACE, next->a + j);
    PUT(b, SPACE, next->b + j);
    PUT(c, SPACE, next->c + j);
  }
}

/* Whether no last-layer neuron has a part in G: then there is nothing to integrate. Most often the first
 * weight tells. */
bool output_is_constant(SPACE const Workspace *work, TABLES const Tables *tables) {
#if WRITE_MOMENTS
  (void)work, (void)tables;
  return false;
#else
  TABLES const number *matrix = layer_matrix(work, tables, HIDDEN);
  for (int i = 0; i < WIDTH[HIDDEN] * STRIDE[HIDDEN]; ++i)
    if (matrix[i] != 0) return false;
  return true;
#endif
}

/* What certification looks at, of a point that is not integrated. */
void leader_skip_point(SPACE Workspace *work) {
  work->area = 1;
  work->faces = 0;
  for (int k = 0; k < ARRANGEMENTS; ++k) work->arrangement[k].failed = 0;
}

/* Clears the sums of a point and makes the unit square the first cell. */
void leader_begin_point(SPACE Workspace *work) {
  work->area = 0;
  work->area_error = 0;
  work->faces = 0;
  work->level = 0;
  for (int k = 0; k < ARRANGEMENTS; ++k) work->arrangement[k].failed = 0;
  leader_begin_unit_square(&work->arrangement[0]);
}

/* Walks all cells of one point's network and leaves the last hidden layer's integrals in `moment`. */
void integrate_network(SPACE Workspace *work, TABLES Tables *tables, const int lane) {
  clear_sums(tables, lane);
  if (output_is_constant(work, tables)) {
    if (lane == 0) leader_skip_point(work);
    BARRIER();
    return;
  }
  sum_terms(work, tables, lane);
  first_lines(work, tables, lane);
  if (lane == 0) leader_begin_point(work);
  BARRIER();
#if METHOD_FULL || HIDDEN > 1
  add_lines(&work->arrangement[0], &work->lines[0], work->crossing, WIDTH[1], 1, lane);
#endif
#if ARRANGEMENTS == 1
  integrate_cell(work, tables, lane);
  sum_on_terms(work, tables, lane);
#else
  add_cell(work, tables, 0, 1, lane);
  for (;;) {
    if (lane == 0) leader_next_cell(work);
    BARRIER();
    const int k = work->level;
    if (k < 0) break;
    subtract_face(work, tables, k - 1, lane);
    next_lines(work, tables, k - 1, lane);
    BARRIER();
    add_lines(&work->arrangement[k], &work->lines[k], work->crossing, WIDTH[k + 1], (ushort)(k + 1), lane);
    if (k == LAST_ARRANGEMENT)
      integrate_cell(work, tables, lane);
    else
      add_cell(work, tables, k, 1, lane);
  }
  sum_on_terms(work, tables, lane);
#endif
}

#if WRITE_MOMENTS
/* M with its powers of two put back. */
void unscale_moments(SPACE const Workspace *work, TABLES Tables *tables, const int lane) {
  for (int j = lane * VEC; j < MOMENT_STRIDE; j += LANES * VEC)
    PUT(unscale(work, tables, HIDDEN - 1, j, LOAD(tables->moment + j)), TABLES, tables->moment_error + j);
}
#endif

#endif

/* G = b + W M for all channels, through the scaled output layer; its condition, and its bound where that
 * is asked for. */
void compute_outputs(SPACE Workspace *work, TABLES Tables *tables, const int lane) {
  TABLES const number *matrix = layer_matrix(work, tables, HIDDEN);
  TABLES const number *bias = layer_bias(work, tables, HIDDEN);
  for (int j = lane * VEC; j < OUTPUT_STRIDE; j += LANES * VEC) {
    numbers sum = LOAD(bias + j);
    numbers scale = fabs(sum);
    numbers terms = scale;
#if WRITE_BOUND
    numbers all_terms = scale;
#endif
    for (int i = 0; i < WIDTH[HIDDEN]; ++i) {
#if HIDDEN > 0
      const number moment = tables->moment[i];
      const number on_terms = tables->on_terms[BIAS_OFFSET[HIDDEN - 1] + i];
#else
      const number moment = (number)0.5f;
      const number on_terms = (number)0.5f;
#endif
      const numbers weight = LOAD(matrix + i * STRIDE[HIDDEN] + j);
      sum = FMA(weight, (numbers)moment, sum);
      scale = FMA(fabs(weight), (numbers)fabs(moment), scale);
      terms = FMA(fabs(weight), (numbers)on_terms, terms);
#if WRITE_BOUND && HIDDEN > 0
      all_terms = FMA(fabs(weight), (numbers)tables->terms[BIAS_OFFSET[HIDDEN - 1] + i], all_terms);
#endif
    }
    const numbers output = unscale(work, tables, HIDDEN, j, sum);
    PUT(output, TABLES, tables->output + j);
    if (any_of(terms > (number)CONDITION_LIMIT * scale)) RAISE(&work->ill_conditioned);
#if WRITE_BOUND && HIDDEN == 0
    all_terms = terms;
#endif
#if WRITE_BOUND
    const numbers bound = ((number)EXCESS_TOLERANCE + (number)ROUNDINGS * (number)EPSILON) * all_terms;
    PUT(unscale(work, tables, HIDDEN, j, bound) + (number)STORED_EPSILON * fabs(output), TABLES,
        tables->bound + j);
#endif
  }
}

void copy_numbers(__global stored *to, TABLES const number *from, const int count, const int lane) {
  for (int j = lane; j < count; j += LANES) to[j] = (stored)from[j];
}

/* Zeroes what vector loads touch beyond the numbers in use. */
void clear_padding(SPACE Workspace *work, TABLES Tables *tables, const int lane) {
  for (int i = lane; i < MATRIX_NUMBERS; i += LANES) tables->matrix[i] = 0;
  for (int i = lane; i < BIAS_NUMBERS; i += LANES) tables->bias[i] = tables->terms[i] = tables->on_terms[i] = 0;
#if !METHOD_FULL
  for (int i = lane; i < MAX_VERTICES; i += LANES) tables->vertex_weight[i] = 0;
#endif
#if HIDDEN > 0
  for (int k = 0; k < ARRANGEMENTS; ++k) {
    for (int i = lane; i < MAX_VERTICES; i += LANES) {
      work->arrangement[k].x[i] = 0;
      work->arrangement[k].y[i] = 0;
    }
  }
#else
  (void)work;
#endif
}

/* ---- kernels ------------------------------------------------------------------------------------- */

__kernel void integrate_memory(__global int *bytes) {
  bytes[0] = (int)sizeof(Workspace);
  bytes[1] = (int)sizeof(Tables);
}

/* What all points share is loaded for the group's first point only. */
#define LOAD_LAYER(k)                                                                        \
  if (first || PER_POINT_WEIGHTS_##k)                                                        \
    load_weights(tables, k, weights_##k + PER_POINT_WEIGHTS_##k * p * MATRIX_SIZE(k), lane); \
  if (first || PER_POINT_BIASES_##k)                                                         \
    load_biases(tables, k, biases_##k + PER_POINT_BIASES_##k * p * BIAS_SIZE(k), lane);
/* So is their range. */
#define CHECK_LAYER(k)                                                                    \
  if (PER_POINT_WEIGHTS_##k || PER_POINT_BIASES_##k)                                      \
    check_range(&work->scaled, tables, k, lane);                                          \
  else if (first)                                                                         \
    check_range(&work->shared_scaled, tables, k, lane);
#define MATRIX_SIZE(k) ((size_t)WIDTH[k] * (size_t)WIDTH[(k) + 1])
#define BIAS_SIZE(k) ((size_t)WIDTH[(k) + 1])

/* Points [begin, end), or with -D LISTED those in list[begin, end), `run` at a time. counters:
 * COUNT_HEAD is the queue's head, COUNT_RETRY the length of `retry`, COUNT_FINISHED how many points were
 * integrated, certified or not, COUNT_TEAMS how many teams found the queue empty, and one for each reason why a point
 * is in `retry`. A runtime that stops loops after some turns leaves the first of these two short, or where it
 * ended a team's last point early, the second. */
__kernel __attribute__((reqd_work_group_size(GROUP_ITEMS, 1, 1)))
void integrate(const int begin, const int end, const int run, __global int *counters,
#if LISTED
               __global const int *list,
#endif
               __global int *retry, __global ulong *team_faces, __global stored *G,
#if WRITE_MOMENTS
               __global stored *moments,
#endif
#if WRITE_BOUND
               __global stored *bounds,
#endif
               __global Workspace *all_work, __global Tables *all_tables,
               NETWORK_ARGUMENTS) {
  const int lane = LANES == 1 ? 0 : (int)get_local_id(0);
  const size_t team = get_global_id(0) / LANES;
#if LONE
  Workspace own_work;
  Tables own_tables;
  Workspace *work = &own_work;
  Tables *tables = &own_tables;
  (void)all_work, (void)all_tables;
#else
  __global Tables *tables = all_tables + team;
#if WORK_IS_LOCAL
  __local Workspace local_work;
  __local Workspace *work = &local_work;
  (void)all_work;
#else
  __global Workspace *work = all_work + team;
#endif
#endif
  clear_padding(work, tables, lane);
  bool first = true;
  ulong faces = 0;
  int finished = 0;
  int is_empty = 0;
  for (;;) {
    BARRIER();
    if (lane == 0) work->first_point = begin + atomic_add(&counters[COUNT_HEAD], run);
    BARRIER();
    const int start = work->first_point;
    is_empty = start >= end;
    if (is_empty) break;
    const int stop = LESSER(end, start + run);
    for (int next = start; next < stop; ++next) {
#if LISTED
      const int point = list[next];
#else
      const int point = next;
#endif
      const size_t p = (size_t)point;
      FOR_EACH_LAYER(LOAD_LAYER)
      if (lane == 0) {
        work->scaled = work->ill_conditioned = 0;
        work->shared_scaled = first ? 0 : work->shared_scaled;
      }
      BARRIER();
      FOR_EACH_LAYER(CHECK_LAYER)
      first = false;
      BARRIER();
      if (lane == 0) work->scaled |= work->shared_scaled;
      BARRIER();
      if (work->scaled) scale_layers(tables, lane);
#if HIDDEN > 0
      integrate_network(work, tables, lane);
#endif
      compute_outputs(work, tables, lane);
      BARRIER();
      copy_numbers(G + p * BIAS_SIZE(HIDDEN), tables->output, WIDTH[HIDDEN + 1], lane);
#if WRITE_BOUND
      copy_numbers(bounds + p * BIAS_SIZE(HIDDEN), tables->bound, WIDTH[HIDDEN + 1], lane);
#endif
#if WRITE_MOMENTS
      unscale_moments(work, tables, lane);
      BARRIER();
      copy_numbers(moments + p * BIAS_SIZE(HIDDEN - 1), tables->moment_error, WIDTH[HIDDEN], lane);
#endif
      if (lane == 0) {
#if HIDDEN > 0
        faces += (ulong)work->faces;
#endif
        ++finished;
        const int reason = leader_verdict(work, tables);
        if (reason != 0) {
          atomic_inc(&counters[reason]);
          retry[atomic_inc(&counters[COUNT_RETRY])] = point;
        }
      }
      BARRIER();
    }
  }
  if (lane == 0) {
    team_faces[team] += faces;
    atomic_add(&counters[COUNT_FINISHED], finished);
    atomic_add(&counters[COUNT_TEAMS], is_empty);
  }
}
