/* The arrangement of lines in a convex cell, as half-edges (de Berg et al., Computational Geometry, ch. 8).
 *
 * A cell is a convex polygon. Lines are inserted one after the other. Each line is evaluated once at all
 * vertices (`side`); from there on only the stored signs speak: zero counts as positive, a half-edge is
 * crossed when its two ends lie on different sides. Every line that enters a face therefore leaves it, each
 * insertion splits faces by chords, and the result is a planar subdivision whatever the rounding. Parallel,
 * coincident and concurrent lines need no special case: the worst they make is faces of almost no area.
 *
 * Layout. Half-edges bound their face counter-clockwise. `next` follows the face's boundary, `twin` is the
 * same edge seen from the neighbouring face, or OUTSIDE on the cell's border (there are no half-edges
 * outside the cell). A half-edge keeps its origin for ever: splitting it shortens it, and what is cut off
 * becomes a new half-edge. So nobody's `next` has to be searched for, `prev` is not needed, and half-edge i
 * always starts at corner i of the cell. Vertices lie as structure of arrays, padded to whole vectors.
 * `tag` holds the layer whose line the edge lies on (0: border of the unit square). Each face has exactly one
 * half-edge with the flag REPRESENTATIVE, listed in `face`.
 *
 * Where all points share the lines' directions, their determinants, two by two, could be kept, which leaves a
 * multiplication in leader_place_vertex where it now divides. Tried with multiplications in the division's
 * place, insertion took 25.4 ns a face, not 26.6 (32 lines, one core): one hundredth of a point's time, as the
 * division does not hold up the walk. The order of the directions is of no use to a walk either.
 *
 * Constants. MAX_CORNERS, MAX_VERTICES, MAX_HALF_EDGES: exact bounds for the layer's width, from the host.
 * SPACE: where a Dcel lies (__local on GPUs if it fits, else __global).
 *
 * Work-group contract: LANES work-items share one Dcel. `add_lines` is called by all of them and holds
 * barriers under uniform conditions; functions named leader_* are for lane 0 alone, between barriers.
 * Between two barriers stands one call, or one under `if (lane == 0)` alone: PoCL 3 miscompiles compound
 * conditions there.
 */

#define OUTSIDE 0xffff
#define REPRESENTATIVE 0x8000
#define TAG_MASK 0x7fff

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
  int visited; /* faces that the depth-first walk has entered */
  int failed; /* sticky: a capacity did not hold, the point must be done again */
} __attribute__((aligned(64))) Dcel;

/* VEC affine functions a x + b y + c at a time: structure of arrays, padded by zeros to whole vectors. */
typedef struct {
  number a[LINE_STRIDE] __attribute__((aligned(64)));
  number b[LINE_STRIDE] __attribute__((aligned(64)));
  number c[LINE_STRIDE] __attribute__((aligned(64)));
} Lines;

/* Makes the polygon in x, y and edge[].tag the cell: one face, no lines yet. */
void leader_begin_cell(SPACE Dcel *d, const int corners) {
  for (int i = 0; i < corners; ++i) {
    d->edge[i].next = (ushort)(i + 1 < corners ? i + 1 : 0);
    d->edge[i].twin = OUTSIDE;
    d->edge[i].origin = (ushort)i;
  }
  d->corners = corners;
  d->vertices = corners;
  d->edges = corners;
  d->faces = 1;
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

/* A vertex where the current line crosses the edge between two vertices on different sides. It is reached
 * from the end that is nearer to the line: the step is then at most half the edge, and a vertex close to
 * one end keeps its relative distance from it. */
void leader_place_vertex(SPACE Dcel *d, const int vertex, const int from, const int to) {
  const int near = fabs(d->side[from]) <= fabs(d->side[to]) ? from : to;
  const int far = near == from ? to : from;
  const number t = d->side[near] / (d->side[near] - d->side[far]);
  d->x[vertex] = FMA(t, d->x[far] - d->x[near], d->x[near]);
  d->y[vertex] = FMA(t, d->y[far] - d->y[near], d->y[near]);
  d->side[vertex] = 0;
}

bool leader_below(SPACE const Dcel *d, const int vertex) { return d->side[vertex] < 0; }

/* The half-edge on the cell's border through which the current line enters, or -1. */
int leader_find_entry(SPACE const Dcel *d) {
  /* A side of the cell with corners on different sides of the line, then the piece of it that is crossed. */
  int corner = 0;
  while (corner + 1 < d->corners && leader_below(d, corner) == leader_below(d, corner + 1)) ++corner;
  if (corner + 1 == d->corners) return -1;
  const bool below = leader_below(d, corner);
  int e = corner;
  int next = d->edge[e].next;
  while (leader_below(d, d->edge[next].origin) == below) {
    /* A vertex on the border ends exactly one line: go round it to the next piece of the side. */
    e = d->edge[d->edge[next].twin].next;
    next = d->edge[e].next;
  }
  return e;
}

/* Inserts the line whose values at the vertices are in `side` by a walk from face to face. */
void leader_insert_line(SPACE Dcel *d, const ushort tag) {
  if (d->failed) return;
  int behind = leader_find_entry(d);
  if (behind < 0) return;
  int vertices = d->vertices;
  int edges = d->edges;
  int faces = d->faces;

  /* The line stands at vertex `from` on the boundary of a face, between half-edges `behind` and `ahead`. */
  int from = vertices++;
  int ahead = edges++;
  int ahead_next = d->edge[behind].next;
  leader_place_vertex(d, from, d->edge[behind].origin, d->edge[ahead_next].origin);
  d->edge[ahead] = (HalfEdge){(ushort)ahead_next, OUTSIDE, (ushort)from,
                              (ushort)(d->edge[behind].tag & TAG_MASK)};
  for (;;) {
    if (vertices + 1 > MAX_VERTICES || edges + 4 > MAX_HALF_EDGES) {
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
    if (edge.twin == OUTSIDE) break;

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

/* Evaluates line j at all vertices. */
void take_sides(SPACE Dcel *d, SPACE const Lines *lines, const int j, const int lane) {
  const numbers a = lines->a[j];
  const numbers b = lines->b[j];
  const numbers c = lines->c[j];
  const int vertices = d->vertices;
  for (int v = lane * VEC; v < vertices; v += LANES * VEC)
    PUT(FMA(a, LOAD(d->x + v), FMA(b, LOAD(d->y + v), c)), SPACE, d->side + v);
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
