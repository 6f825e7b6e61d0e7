/* Records of warp_triangles.cl: the first hidden layer's lines cut the square of every shading point into faces,
 * the faces into fans of triangles, and the residual's magnitude e is made linear on each triangle.
 *
 * e at a vertex is read off the point's table (warp.cl's record), bilinear between the centres of its cells.
 * On a triangle of corners e0, e1, e2 and centroid m the integral of e over the area is taken as
 *
 *   (e0 + e1 + e2) / 12 + 3/4 e(m)          exact for quadratic functions
 *
 * and the corners' values are scaled to it. This rule only decides which density is used; the density is
 * then linear, and its integrals are exact. With a share of UNIFORM_SHARE of it uniform, the values at
 * the corners are scale * e + UNIFORM_SHARE.
 *
 * Triangles are listed along a Hilbert curve through their centroids, by a counting sort over BUCKETS cells of it.
 *
 * Certification as in integrate.cl: the areas must sum to 1. And a triangle of less probability than cumulative
 * sums can tell apart may never be chosen, though f - g counts there: the areas of all such triangles of a point must
 * sum to MISSED_AREA at most, which bounds the bias. A point that fails (slivers that rounding turned over, or
 * too many of them, lines that are not finite) gets the undivided square, two triangles.
 *
 * Joined after dcel.cl and warp.cl. LINES and their arrays are those of the folded network.
 *
 * Work-group contract: groups of exactly LANES work-items, one point at a time, each group every n-th point of the
 * batch, with a Workspace of its own in global memory; no local memory. Functions named leader_* are for lane 0
 * between barriers; conditions around barriers are uniform in the group.
 */

#define CELLS (DENSITY_BINS * DENSITY_BINS)
#define HILBERT_SIDE 16
#define BUCKETS (HILBERT_SIDE * HILBERT_SIDE)
/* Two roundings of a sum below 1: one of the sum, one of its normalisation. */
#define LEAST_PROBABILITY 0x1.0p-23f

typedef struct {
  Dcel arrangement;
  Lines lines;
  int crossing[LINE_STRIDE + 1];
  float cell[CELLS];            /* e, of which the mean over the square is about 1 - UNIFORM_SHARE */
  float value[MAX_VERTICES];    /* e at the vertices */
  uint corners[MAX_TRIANGLES];  /* packed as in the record */
  float area[MAX_TRIANGLES];
  float scale[MAX_TRIANGLES];   /* what the corners' values are multiplied by */
  float mean[MAX_TRIANGLES];    /* mean of the corners' values */
  ushort bucket[MAX_TRIANGLES]; /* cell of the centroid, then its place on the curve */
  ushort order[MAX_TRIANGLES];
  ushort start[BUCKETS];
  int triangles;
  int certified;
  float normalisation;
} __attribute__((aligned(64))) Workspace;

/* e between the centres of the table's cells, which are constant beyond the outermost ones. */
float magnitude_at(global const float *cell, const float u, const float v) {
  const float s = clamp(u * (float)DENSITY_BINS - 0.5f, 0.0f, (float)(DENSITY_BINS - 1));
  const float t = clamp(v * (float)DENSITY_BINS - 0.5f, 0.0f, (float)(DENSITY_BINS - 1));
  const int strip = min((int)s, DENSITY_BINS - 2);
  const int bin = min((int)t, DENSITY_BINS - 2);
  global const float *corner = cell + strip * DENSITY_BINS + bin;
  const float across = s - (float)strip;
  const float along = t - (float)bin;
  const float low = FMA(along, corner[1] - corner[0], corner[0]);
  const float high = FMA(along, corner[DENSITY_BINS + 1] - corner[DENSITY_BINS], corner[DENSITY_BINS]);
  return FMA(across, high - low, low);
}

/* The place along Hilbert's curve of the cell (x, y), both below HILBERT_SIDE (Warren, Hacker's Delight, 2nd
 * edition, chapter 16). */
uint hilbert_index(uint x, uint y) {
  uint index = 0;
  for (uint side = HILBERT_SIDE / 2; side > 0; side /= 2) {
    const uint right = (x & side) != 0 ? 1u : 0u;
    const uint upper = (y & side) != 0 ? 1u : 0u;
    index += side * side * ((3u * right) ^ upper);
    if (upper == 0) {
      if (right != 0) {
        x = HILBERT_SIDE - 1 - x;
        y = HILBERT_SIDE - 1 - y;
      }
      const uint swapped = x;
      x = y;
      y = swapped;
    }
  }
  return index;
}

/* The point's lines, and its table's cells without their uniform share. */
void load_point(global Workspace *work, global const float *w1, global const float *b1, global const uint *table,
                const int lane) {
  for (int j = lane; j < LINES; j += LANES) {
    work->lines.a[j] = w1[2 * j];
    work->lines.b[j] = w1[2 * j + 1];
    work->lines.c[j] = b1[j];
  }
  for (int k = lane; k < CELLS; k += LANES) {
    const int strip = k / DENSITY_BINS;
    const float probability = bin_probability(table + DENSITY_STRIPS, strip) *
                              bin_probability(table + DENSITY_CELLS + DENSITY_ROW * strip, k % DENSITY_BINS);
    work->cell[k] = fmax(probability * (float)CELLS - UNIFORM_SHARE, 0.0f);
  }
}

/* All faces as fans of triangles, corner 0 of each the one of least value. */
void leader_list_fans(global Workspace *work) {
  global const Dcel *d = &work->arrangement;
  int triangles = 0;
  for (int f = 0; f < d->faces; ++f) {
    const int first = d->face[f];
    HalfEdge edge = d->edge[first];
    const uint apex = edge.origin;
    edge = d->edge[edge.next];
    uint before = edge.origin;
    while (edge.next != first) {
      edge = d->edge[edge.next];
      const uint after = edge.origin;
      uint corner[3] = {apex, before, after};
      for (int k = 1; k < 3; ++k)
        if (work->value[corner[k]] < work->value[corner[0]]) {
          const uint least = corner[k];
          corner[k] = corner[0];
          corner[0] = least;
        }
      work->corners[triangles++] = corner[0] | corner[1] << VERTEX_BITS | corner[2] << (2 * VERTEX_BITS);
      before = after;
    }
  }
  work->triangles = triangles;
}

/* Area, mean of e, scale and cell of every triangle. */
void measure_triangles(global Workspace *work, const int lane) {
  global const Dcel *d = &work->arrangement;
  for (int t = lane; t < work->triangles; t += LANES) {
    const uint corners = work->corners[t];
    const uint i = corners & VERTEX_MASK;
    const uint j = corners >> VERTEX_BITS & VERTEX_MASK;
    const uint k = corners >> (2 * VERTEX_BITS) & VERTEX_MASK;
    const float x = d->x[i];
    const float y = d->y[i];
    work->area[t] = 0.5f * fabs(cross_product(d->x[j] - x, d->y[j] - y, d->x[k] - x, d->y[k] - y));
    const float centre_x = (x + d->x[j] + d->x[k]) * (1.0f / 3.0f);
    const float centre_y = (y + d->y[j] + d->y[k]) * (1.0f / 3.0f);
    const float mean = (work->value[i] + work->value[j] + work->value[k]) * (1.0f / 3.0f);
    const float quadrature = FMA(0.75f, magnitude_at(work->cell, centre_x, centre_y), 0.25f * mean);
    work->mean[t] = mean;
    /* Where all corners are zero there is nothing to scale. */
    work->scale[t] = mean > 0.0f ? quadrature / mean : 0.0f;
    const int column = clamp((int)(centre_x * (float)HILBERT_SIDE), 0, HILBERT_SIDE - 1);
    const int row = clamp((int)(centre_y * (float)HILBERT_SIDE), 0, HILBERT_SIDE - 1);
    work->bucket[t] = (ushort)(row * HILBERT_SIDE + column);
  }
}

/* The triangles' order along the curve: a counting sort, which keeps the order within a bucket. */
void leader_sort(global Workspace *work) {
  for (int b = 0; b < BUCKETS; ++b) work->start[b] = 0;
  for (int t = 0; t < work->triangles; ++t) {
    const uint cell = work->bucket[t];
    work->bucket[t] = (ushort)hilbert_index(cell % HILBERT_SIDE, cell / HILBERT_SIDE);
    ++work->start[work->bucket[t]];
  }
  ushort start = 0;
  for (int b = 0; b < BUCKETS; ++b) {
    const ushort own = work->start[b];
    work->start[b] = start;
    start = (ushort)(start + own);
  }
  for (int t = 0; t < work->triangles; ++t) work->order[work->start[work->bucket[t]]++] = (ushort)t;
}

/* The integral of a triangle's density, before rounding errors of the whole are divided out. */
float probability_of(global const Workspace *work, const int t) {
  return work->area[t] * FMA(work->scale[t] * work->normalisation, work->mean[t], UNIFORM_SHARE);
}

/* Whether the triangles cover the square, and what their scales are to be multiplied by so that e integrates to
 * what is not uniform. */
void leader_certify(global Workspace *work) {
  float area = 0.0f;
  float error = 0.0f;
  float integral = 0.0f;
  for (int t = 0; t < work->triangles; ++t) {
    COMPENSATED_ADD(float, area, error, work->area[t]);
    integral = FMA(work->area[t], work->scale[t] * work->mean[t], integral);
  }
  work->normalisation = integral > 0.0f ? (1.0f - UNIFORM_SHARE) / integral : 0.0f;
  float missed = 0.0f;
  for (int t = 0; t < work->triangles; ++t)
    if (probability_of(work, t) < LEAST_PROBABILITY) missed += work->area[t];
  work->certified =
      !work->arrangement.failed && fabs(area - 1.0f) <= AREA_TOLERANCE && missed <= MISSED_AREA;
}

void evaluate_vertices(global Workspace *work, const int lane) {
  global const Dcel *d = &work->arrangement;
  for (int v = lane; v < d->vertices; v += LANES) work->value[v] = magnitude_at(work->cell, d->x[v], d->y[v]);
}

/* From the arrangement to measured triangles; ends with a barrier. */
void triangulate_faces(global Workspace *work, const int lane) {
  evaluate_vertices(work, lane);
  BARRIER();
  if (lane == 0) leader_list_fans(work);
  BARRIER();
  measure_triangles(work, lane);
  BARRIER();
  if (lane == 0) leader_certify(work);
  BARRIER();
}

/* Sorts the triangles and writes them with their cumulative probabilities. */
void leader_write_triangles(global Workspace *work, global float *record) {
  leader_sort(work);
  float total = 0.0f;
  for (int k = 0; k < work->triangles; ++k) {
    const int t = work->order[k];
    record[RECORD_CUMULATIVE + k] = total;
    record[RECORD_SCALES + k] = work->scale[t] * work->normalisation;
    ((global uint *)record)[RECORD_CORNERS + k] = work->corners[t];
    total += probability_of(work, t);
  }
  const float inverse = 1.0f / total;
  for (int k = 0; k < work->triangles; ++k)
    record[RECORD_CUMULATIVE + k] = fmin(record[RECORD_CUMULATIVE + k] * inverse, 1.0f);
  record[RECORD_CUMULATIVE + work->triangles] = 1.0f;
  ((global uint *)record)[RECORD_COUNT] = (uint)work->triangles;
}

void write_vertices(global const Workspace *work, global float *record, const int lane) {
  global const Dcel *d = &work->arrangement;
  for (int v = lane; v < d->vertices; v += LANES) {
    record[RECORD_X + v] = d->x[v];
    record[RECORD_Y + v] = d->y[v];
    record[RECORD_VALUES + v] = work->value[v];
  }
}

void leader_begin(global Workspace *work) {
  work->arrangement.failed = 0;
  leader_begin_unit_square(&work->arrangement);
}

/* Begins again without lines. */
void leader_give_up(global Workspace *work, volatile global int *counts) {
  leader_begin(work);
  atomic_inc(counts);
}

/* Zeroes what vector loads touch beyond the numbers in use. */
void clear_padding(global Workspace *work, const int lane) {
  for (int i = lane; i < MAX_VERTICES; i += LANES) work->arrangement.x[i] = work->arrangement.y[i] = 0.0f;
  for (int j = lane; j < LINE_STRIDE; j += LANES)
    work->lines.a[j] = work->lines.b[j] = work->lines.c[j] = 0.0f;
}

kernel void triangulate_memory(global int *bytes) { bytes[0] = (int)sizeof(Workspace); }

/* Record i of `records` for point order[first_point + i], i < count. counts: [0] points that got the undivided square,
 * [1] points that were finished, [2] groups that came to their last point: a runtime that stops loops after some turns
 * leaves one of these short. */
kernel __attribute__((reqd_work_group_size(LANES, 1, 1))) void triangulate(
    const uint first_point, const uint count, global const uint *restrict order, global const float *restrict w1,
    global const float *restrict b1, global const uint *restrict tables, global Workspace *all_work,
    global uint *restrict records, volatile global int *counts) {
  const int lane = (int)get_local_id(0);
  global Workspace *work = all_work + get_group_id(0);
  clear_padding(work, lane);
  int finished = 0;
  uint i = (uint)get_group_id(0);
  for (; i < count; i += (uint)get_num_groups(0)) {
    const ulong point = order[first_point + i];
    BARRIER();
    load_point(work, w1 + point * STRIDE_W1, b1 + point * STRIDE_B1, tables + point * DENSITY_WORDS, lane);
    BARRIER();
    if (lane == 0) leader_begin(work);
    BARRIER();
    add_lines(&work->arrangement, &work->lines, work->crossing, LINES, 1, lane);
    triangulate_faces(work, lane);
    if (!work->certified) {
      if (lane == 0) leader_give_up(work, counts);
      BARRIER();
      triangulate_faces(work, lane);
    }
    global float *record = (global float *)(records + i * (ulong)RECORD_WORDS);
    if (lane == 0) leader_write_triangles(work, record);
    BARRIER();
    write_vertices(work, record, lane);
    ++finished;
  }
  if (lane == 0) {
    atomic_add(counts + 1, finished);
    atomic_add(counts + 2, i >= count ? 1 : 0);
  }
}
