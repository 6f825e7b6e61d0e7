/* The complete subdivision of one network: every cell of the last hidden layer's arrangement, written
 * out.
 *
 * The traversal is that of method `full` in integrate.cl, which integrates on the way: so the
 * subdivision certifies itself as an integral does. For each leaf cell: its corners, for each of its
 * sides the layer whose line it lies on (0: border of the square), its area and the affine function of
 * every output channel, for which the output layer is treated as one more layer of lines.
 *
 * What does not fit the capacities is counted but not written, so that a first launch with none sizes
 * the arrays. counts: [0] cells, [1] corners, [2] why the subdivision is not to be trusted
 * (leader_verdict; 0: it is).
 *
 * Work-group contract: one group of one work-item; no barriers.
 */

__kernel __attribute__((reqd_work_group_size(1, 1, 1)))
void subdivide(__global int *counts, const int cell_capacity, const int corner_capacity,
               __global int *first_corner, __global number *areas, __global number *affine,
               __global number *corners, __global int *layers, __global Workspace *work,
               __global Tables *tables, NETWORK_ARGUMENTS) {
  const bool first = true;
  const int lane = 0;
  const size_t p = 0;
  clear_padding(work, tables, lane);
  FOR_EACH_LAYER(LOAD_LAYER)
  work->scaled = 1;
  work->ill_conditioned = 0;
  scale_layers(tables, lane);
  clear_sums(tables, lane);
  sum_terms(work, tables, lane);
  first_lines(work, tables, lane);
  leader_begin_point(work);
  add_lines(&work->arrangement[0], &work->lines[0], work->crossing, WIDTH[1], 1, lane);

  __global Dcel *last = &work->arrangement[LAST_ARRANGEMENT];
  __global const Lines *outputs = &work->lines[HIDDEN];
  __global const exponent_bits *exponent = tables->exponent + BIAS_OFFSET[HIDDEN];
  const int channels = WIDTH[HIDDEN + 1];
  int cells = 0;
  int written = 0;
  for (;;) {
    const int level = work->level;
    if (level < LAST_ARRANGEMENT) add_cell(work, tables, level, 1, lane);
    if (level == LAST_ARRANGEMENT) {
      integrate_cell(work, tables, lane);
      for (int f = 0; f < last->faces; ++f) {
        const int start = written;
        int e = last->face[f];
        work->face = tables->face[f];
        next_lines(work, tables, HIDDEN - 1, lane);
        do {
          if (written < corner_capacity) {
            corners[2 * written] = last->x[last->edge[e].origin];
            corners[2 * written + 1] = last->y[last->edge[e].origin];
            layers[written] = last->edge[e].tag & TAG_MASK;
          }
          e = last->edge[e].next;
          ++written;
        } while (e != last->face[f]);
        if (cells < cell_capacity) {
          first_corner[cells] = start;
          areas[cells] = work->face.area;
          for (int j = 0; j < channels; ++j) {
            __global number *function = affine + (cells * channels + j) * 3;
            function[0] = ldexp(outputs->a[j], (int)exponent[j]);
            function[1] = ldexp(outputs->b[j], (int)exponent[j]);
            function[2] = ldexp(outputs->c[j], (int)exponent[j]);
          }
        }
        ++cells;
      }
    }
    leader_next_cell(work);
    const int k = work->level;
    if (k < 0) break;
    subtract_face(work, tables, k - 1, lane);
    next_lines(work, tables, k - 1, lane);
    add_lines(&work->arrangement[k], &work->lines[k], work->crossing, WIDTH[k + 1], (ushort)(k + 1), lane);
  }
  counts[0] = cells;
  counts[1] = written;
  sum_on_terms(work, tables, lane);
  compute_outputs(work, tables, lane);
  counts[2] = leader_verdict(work, tables);
}
