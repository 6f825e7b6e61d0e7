/* Arrangement of lines in a convex cell, as half-edges (de Berg et al., Computational Geometry, ch. 8).
 *
 * A cell is a convex polygon. Lines are inserted one after the other. Each line is evaluated once at all
 * vertices (`side`); from there on only the stored signs decide: zero counts as positive, a half-edge is
 * crossed if its two ends lie on different sides. Every line that enters a face therefore leaves it,
 * each insertion splits faces by chords, and the result is a planar subdivision whatever the rounding.
 *
 * It may still be a wrong subdivision. Where lines meet in a corner of the cell, the ends of earlier
 * lines lie within rounding of the new one, and a wrong sign would lead the walk out of the cell beside
 * its own corner. So a value within LINE_ROUNDING of zero is zero. And every line is checked: its signs
 * must change twice round the cell's corners or not at all; it must leave through the side whose corners
 * differ; and it may cross each earlier line once. A line that fails a check makes the arrangement
 * `failed`, and the point is done again in another way.
 *
 * Layout. Half-edges bound their face counter-clockwise. `next` follows the face's boundary, `twin` is
 * the same edge seen from the neighbouring face, or OUTSIDE + i on side i of the cell (there are no
 * half-edges outside the cell). A half-edge keeps its origin for ever: splitting it shortens it, and
 * what is cut off becomes a new half-edge. So nobody's `next` has to be searched for, `prev` is not
 * needed, and half-edge i always starts at corner i of the cell. Vertices lie as structure of arrays,
 * padded to whole vectors. `tag` holds the layer whose line the edge lies on (0: border of the unit
 * square). Each face has exactly one half-edge with the flag REPRESENTATIVE, listed in `face`.
 *
 * Tried and dropped: where all points share the lines' directions, the determinants of pairs of them
 * could be kept, and leader_place_vertex would multiply where it now divides. Insertion then took 25.4
 * ns a face, not 26.6 (32 lines, one core), which is one hundredth of a point's time.
 *
 * Constants. MAX_VERTICES, MAX_HALF_EDGES, MAX_FACES: exact bounds from the host (arrangement.py), the
 * largest of all arrangements. They are checked at every append all the same. SPACE: where a Dcel lies
 * (__local on GPUs if it fits, else __global).
 *
 * Work-group contract: LANES work-items share one Dcel. `add_lines` is called by all of them and holds
 * barriers under uniform conditions; functions named leader_* are for lane 0 alone, between barriers.
 * Between two barriers stands one call, or one under `if (lane == 0)` alone: PoCL 3 miscompiles compound
 * conditions there.
 */

#define OUTSIDE 0xfe00
#define REPRESENTATIVE 0x8000
#define TAG_MASK 0x7fff

/* What a x + b y + c can be off by at a vertex that lies on the line, over the sum of its terms'
 * magnitudes: its own rounding and the vertex's. */
#if DOUBLE
#define LINE_ROUNDING (2 * DBL_EPSILON)
#else
#define LINE_ROUNDING (2 * FLT_EPSILON)
#endif

typedef struct {
  ushort next;
  ushort twin;
  ushort origin;
  ushort tag;
} __attribute__((aligned(8))) HalfEdge;

typedef struct {
  number x[MAX_VERTICES] __attribute__((aligned(64)));
  number y[MAX_VERTICES] __attribute__((aligned(64)));
  number side[MAX_VERTICES] __attribute__((aligned(64)));
  HalfEdge edge[MAX_HALF_EDGES];
  ushort face[MAX_FACES];
  int corners;
  int vertices;
  int edges;
  int faces;
  int lines; /* lines inserted so far */
  int visited; /* faces that the depth-first walk has entered */
  int failed; /* sticky: a line failed a check, the point must be done again */
} __attribute__((aligned(64))) Dcel;

/* VEC affine functions a x + b y + c at a time: structure of arrays, padded by zeros to whole
 * vectors. */
typedef struct {
  number a[LINE_STRIDE] __attribute__((aligned(64)));
  number b[LINE_STRIDE] __attribute__((aligned(64)));
  number c[LINE_STRIDE] __attribute__((aligned(64)));
} Lines;

/* Makes the polygon in x, y and edge[].tag the cell: one face, no lines yet. */
void leader_begin_cell(SPACE Dcel *d, const int corners) {
  for (int i = 0; i < corners; ++i) {
    d->edge[i].next = (ushort)(i + 1 < corners ? i + 1 : 0);
    d->edge[i].twin = (ushort)(OUTSIDE + i);
    d->edge[i].origin = (ushort)i;
  }
  d->corners = corners;
  d->vertices = corners;
  d->edges = corners;
  d->faces = 1;
  d->lines = 0;
  d->visited = 0;
  d->face[0] = 0;
  d->edge[0].tag |= REPRESENTATIVE;
}

void leader_begin_unit_square(SPACE Dcel *d) {
  for (int i = 0; i < 4; ++i) {
    d->x[i] = (number)(i == 1 || i == 2);
    d->y[i] = (number)(i >= 2);
    d->edge[i].tag = 0;
  }
  leader_begin_cell(d, 4);
}

/* A vertex where the current line crosses the edge between two vertices on different sides. It is
 * reached from the end that is nearer to the line: the step is then at most half the edge, and a vertex
 * close to one end keeps its relative distance from it. */
void leader_place_vertex(SPACE Dcel *d, const int vertex, const int from, const int to) {
  const int near = fabs(d->side[from]) <= fabs(d->side[to]) ? from : to;
  const int far = near == from ? to : from;
  const number t = d->side[near] / (d->side[near] - d->side[far]);
  d->x[vertex] = FMA(t, d->x[far] - d->x[near], d->x[near]);
  d->y[vertex] = FMA(t, d->y[far] - d->y[near], d->y[near]);
  d->side[vertex] = 0;
}

bool leader_below(SPACE const Dcel *d, const int vertex) { return d->side[vertex] < 0; }

/* Where a line enters and leaves the cell: the half-edge on its border that is crossed, or -1, and the
 * side. */
typedef struct {
  int half_edge;
  int leaving_side;
} Passage;

Passage leader_find_passage(SPACE Dcel *d) {
  Passage passage = {-1, -1};
  /* Sides of the cell with corners on different sides of the line: the first, the second, and no
   * more. */
  int side = 0;
  const bool below = leader_below(d, 0);
  while (side + 1 < d->corners && leader_below(d, side + 1) == below) ++side;
  if (side + 1 == d->corners) return passage;
  int e = side++;
  while (side + 1 < d->corners && leader_below(d, side + 1) != below) ++side;
  passage.leaving_side = side;
  while (++side < d->corners)
    if (leader_below(d, side) != below) {
      d->failed = 1;
      return passage;
    }
  /* The piece of the entering side that is crossed. */
  int next = d->edge[e].next;
  while (leader_below(d, d->edge[next].origin) == below) {
    /* A vertex on the border ends exactly one line: go round it to the next piece of the side. */
    e = d->edge[d->edge[next].twin].next;
    next = d->edge[e].next;
  }
  passage.half_edge = e;
  return passage;
}

/* Inserts the line whose values at the vertices are in `side` by a walk from face to face. */
void leader_insert_line(SPACE Dcel *d, const ushort tag) {
  if (d->failed) return;
  const Passage passage = leader_find_passage(d);
  int behind = passage.half_edge;
  if (behind < 0) return;
  if (d->vertices == MAX_VERTICES || d->edges == MAX_HALF_EDGES) {
    d->failed = 1;
    return;
  }
  int vertices = d->vertices;
  int edges = d->edges;
  int faces = d->faces;

  /* The line stands at vertex `from` on the boundary of a face, between half-edges `behind` and
   * `ahead`. */
  int from = vertices++;
  int ahead = edges++;
  int ahead_next = d->edge[behind].next;
  leader_place_vertex(d, from, d->edge[behind].origin, d->edge[ahead_next].origin);
  d->edge[ahead] = (HalfEdge){(ushort)ahead_next, d->edge[behind].twin, (ushort)from,
                              (ushort)(d->edge[behind].tag & TAG_MASK)};
  for (;;) {
    /* Each earlier line is crossed once at most, which bounds all arrays; the rest guards the memory. */
    if (faces > d->faces + d->lines || vertices == MAX_VERTICES || edges + 4 > MAX_HALF_EDGES ||
        faces == MAX_FACES) {
      d->failed = 1;
      break;
    }
    /* Follow the face's boundary to the half-edge `leaving` that leads to the line's other side. */
    int leaving = ahead_next;
    HalfEdge edge = d->edge[leaving];
    HalfEdge next = d->edge[edge.next];
    int seen = edge.tag;
    const bool below = leader_below(d, edge.origin);
    while (leader_below(d, next.origin) == below) {
      leaving = edge.next;
      edge = next;
      next = d->edge[edge.next];
      seen |= edge.tag;
    }

    /* A vertex there, and a chord to it. `leaving` ends at the vertex, `rest` continues it. */
    const int to = vertices++;
    const int rest = edges++;
    const int chord = edges++;
    const int chord_twin = edges++;
    const ushort edge_tag = (ushort)(edge.tag & TAG_MASK);
    leader_place_vertex(d, to, edge.origin, next.origin);
    d->edge[rest] = (HalfEdge){edge.next, edge.twin, (ushort)to, edge_tag};
    d->edge[behind].next = (ushort)chord;
    d->edge[leaving].next = (ushort)chord_twin;

    /* The face's representative lies on one side of the chord; the other side is a new face. */
    const bool old_is_ahead = (seen & REPRESENTATIVE) != 0;
    const ushort chord_tag = (ushort)(tag | (old_is_ahead ? REPRESENTATIVE : 0));
    const ushort twin_tag = (ushort)(tag | (old_is_ahead ? 0 : REPRESENTATIVE));
    d->edge[chord] = (HalfEdge){(ushort)rest, (ushort)chord_twin, (ushort)from, chord_tag};
    d->edge[chord_twin] = (HalfEdge){(ushort)ahead, (ushort)chord, (ushort)to, twin_tag};
    d->face[faces++] = (ushort)(old_is_ahead ? chord : chord_twin);
    if (edge.twin >= OUTSIDE) {
      if (edge.twin - OUTSIDE != passage.leaving_side) d->failed = 1;
      break;
    }

    /* The same vertex on the twin, which bounds the next face. */
    behind = edge.twin;
    ahead = edges++;
    ahead_next = d->edge[behind].next;
    d->edge[ahead] = (HalfEdge){(ushort)ahead_next, (ushort)leaving, (ushort)to, edge_tag};
    d->edge[leaving].twin = (ushort)ahead;
    d->edge[behind].twin = (ushort)rest;
    from = to;
  }
  d->vertices = vertices;
  d->edges = edges;
  d->faces = faces;
  ++d->lines;
}

/* crossing[j] = whether line j has corners of the cell on both sides, VEC lines at a time. */
void mark_crossing_lines(SPACE const Dcel *d, SPACE const Lines *lines, SPACE int *crossing,
                         const int count, const int lane) {
  const int padded = (count + LANES * VEC - 1) / (LANES * VEC) * (LANES * VEC);
  for (int j = lane * VEC; j < padded; j += LANES * VEC) {
    const numbers a = LOAD(lines->a + j);
    const numbers b = LOAD(lines->b + j);
    const numbers c = LOAD(lines->c + j);
    numbers low = FMA(a, (numbers)(d->x[0]), FMA(b, (numbers)(d->y[0]), c));
    numbers high = low;
    for (int i = 1; i < d->corners; ++i) {
      const numbers value = FMA(a, (numbers)(d->x[i]), FMA(b, (numbers)(d->y[i]), c));
      low = LESSER(low, value);
      high = GREATER(high, value);
    }
    /* A comparison that holds is -1 in vectors and 1 in scalars. */
#if VEC == 1
    crossing[j] = low < 0 && high >= 0;
#else
    STORE(-JOIN(convert_int, VEC)((low < 0) & (high >= 0)), crossing + j);
#endif
  }
}

/* Turns the marks into a list; crossing[LINE_STRIDE] is its length. */
void leader_list_crossing_lines(SPACE int *crossing, const int count) {
  int found = 0;
  for (int j = 0; j < count; ++j) {
    const int meets = crossing[j];
    crossing[found] = j;
    found += meets;
  }
  crossing[LINE_STRIDE] = found;
}

/* a x + b y + c, or 0 where the value is within rounding of 0. */
numbers snapped_value(const numbers a, const numbers b, const numbers c, const numbers x, const numbers y) {
  const numbers z = FMA(a, x, FMA(b, y, c));
  const numbers terms = FMA(fabs(a), x, FMA(fabs(b), y, fabs(c)));
  return fabs(z) <= (number)LINE_ROUNDING * terms ? (numbers)0 : z;
}

/* Evaluates line j at all vertices; a vertex within rounding of it lies on it. */
void take_sides(SPACE Dcel *d, SPACE const Lines *lines, const int j, const int lane) {
  const numbers a = lines->a[j];
  const numbers b = lines->b[j];
  const numbers c = lines->c[j];
  const int vertices = d->vertices;
  for (int v = lane * VEC; v < vertices; v += LANES * VEC) {
    const numbers x = LOAD(d->x + v);
    const numbers y = LOAD(d->y + v);
    PUT(snapped_value(a, b, c, x, y), SPACE, d->side + v);
  }
}

/* Inserts those of `count` lines that meet the cell. `crossing` has room for LINE_STRIDE + 1 indices.
 * All lanes call it; on return the arrangement is visible to all of them. */
void add_lines(SPACE Dcel *d, SPACE const Lines *lines, SPACE int *crossing, const int count,
               const ushort tag, const int lane) {
  mark_crossing_lines(d, lines, crossing, count, lane);
  BARRIER();
  if (lane == 0) leader_list_crossing_lines(crossing, count);
  BARRIER();
  const int found = crossing[LINE_STRIDE];
  for (int k = 0; k < found; ++k) {
    take_sides(d, lines, crossing[k], lane);
    BARRIER();
    if (lane == 0) leader_insert_line(d, tag);
    BARRIER();
  }
}
