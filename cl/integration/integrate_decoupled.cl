/* Method `decoupled`, last step: the integrals of the last hidden layer's neurons over the faces of the
 * arrangement before. The neurons are affine there but change sign; no face is cut for that: on a
 * triangle the integral of relu(z) has a closed form in the values at the vertices (triangle_integral).
 *
 * The arranged layer's own neurons are linear between the vertices. Their integrals, for certification,
 * are sums over vertices: a third of the areas around a vertex (`vertex_weight`) times the values there.
 *
 * The network is evaluated once at each vertex, which faces share. Most time goes into the loop over
 * triangles and neurons: it takes VEC neurons at a time on CPUs, one a lane on GPUs.
 *
 * Work-group contract: leader_* for lane 0 between barriers; the others for all lanes, end with a
 * barrier.
 */

/* All faces of the last arrangement as fans of triangles; adds them to the vertices' weights. */
void leader_list_triangles(SPACE Workspace *work, TABLES Tables *tables) {
  SPACE Dcel *d = &work->arrangement[LAST_ARRANGEMENT];
  int triangles = 0;
  number area = 0;
  for (int f = 0; f < d->faces; ++f) {
    const int first = d->face[f];
    HalfEdge edge = d->edge[first];
    const int apex = edge.origin;
    const number x0 = d->x[apex];
    const number y0 = d->y[apex];
    edge = d->edge[edge.next];
    int v1 = edge.origin;
    number x1 = d->x[v1];
    number y1 = d->y[v1];
    number absolute = 0;
    number fan = 0;
    number before = 0;
    while (edge.next != first) {
      edge = d->edge[edge.next];
      const int v2 = edge.origin;
      const number x2 = d->x[v2];
      const number y2 = d->y[v2];
      /* From the side that does not touch the apex: a short side far from the apex keeps its digits. */
      const number doubled = cross_product(x2 - x1, y2 - y1, x0 - x1, y0 - y1);
      const number third_area = doubled * ((number)1 / (number)6);
      if (triangles == MAX_TRIANGLES) {
        d->failed = 1;
        break;
      }
      TABLES Triangle *triangle = &tables->triangle[triangles++];
      triangle->third_area = third_area;
      tables->vertex_weight[v1] += before + third_area;
      before = third_area;
      fan += third_area;
      triangle->vertex[0] = (ushort)apex;
      triangle->vertex[1] = (ushort)v1;
      triangle->vertex[2] = (ushort)v2;
      absolute += fabs(doubled);
      x1 = x2;
      y1 = y2;
      v1 = v2;
    }
    tables->vertex_weight[v1] += before;
    tables->vertex_weight[apex] += fan;
    area = FMA((number)0.5f, absolute, area);
    if (f % FACES_A_SUM == FACES_A_SUM - 1 || f == d->faces - 1) {
      COMPENSATED_ADD(number, work->area, work->area_error, area);
      area = 0;
    }
  }
  work->faces += d->faces;
  work->listed = triangles;
}

#if HIDDEN == 1

/* The values of the only hidden layer's neurons at all vertices: they are affine in the whole square. */
void vertex_values(SPACE const Workspace *work, TABLES Tables *tables, const int lane) {
  SPACE const Dcel *d = &work->arrangement[0];
  SPACE const Lines *lines = &work->lines[0];
  for (int j = lane * VEC; j < MOMENT_STRIDE; j += LANES * VEC)
    for (int v = 0; v < d->vertices; ++v) {
      const numbers z = FMA(LOAD(lines->a + j), (numbers)d->x[v],
                            FMA(LOAD(lines->b + j), (numbers)d->y[v], LOAD(lines->c + j)));
      PUT(z, TABLES, tables->value + v * MOMENT_STRIDE + j);
    }
}

#else

/* Vertices that share each load of the matrix: independent sums hide the latency of FMA. */
#define VERTEX_BLOCK (TILE < 8 ? TILE : 8)

/* The activations of the layer before at the vertices [tile, tile + TILE), vertices across lanes. A
 * neuron is set to exactly 0 on its own line: a rounding error there would reach, through the next
 * layer's weights, faces in which the neuron is off. Their weighted sum goes to `excess`; weights are
 * left zero for the next cell. */
void tile_activations(SPACE const Workspace *work, TABLES Tables *tables, const int tile, const int lane) {
  SPACE const Dcel *d = &work->arrangement[LAST_ARRANGEMENT];
  SPACE const Lines *lines = &work->lines[LAST_ARRANGEMENT];
  TABLES const number *inverse_terms = tables->inverse_terms + BIAS_OFFSET[HIDDEN - 2];
  for (int v = lane * VEC; v < TILE; v += LANES * VEC) {
    const numbers x = LOAD(d->x + tile + v);
    const numbers y = LOAD(d->y + tile + v);
    numbers sum = 0;
    for (int i = 0; i < WIDTH[HIDDEN - 1]; ++i) {
      const numbers h = activate(snapped_value(lines->a[i], lines->b[i], lines->c[i], x, y));
      PUT(h, TABLES, tables->activation + i * TILE + v);
      sum = FMA(h, (numbers)inverse_terms[i], sum);
    }
    TABLES number *excess = tables->excess + lane * VEC;
    PUT(FMA(sum, LOAD(tables->vertex_weight + tile + v), LOAD(excess)), TABLES, excess);
    PUT((numbers)0, TABLES, tables->vertex_weight + tile + v);
  }
}

/* The last hidden layer's neurons at these vertices, before activation, neurons across lanes. */
void tile_values(SPACE const Workspace *work, TABLES Tables *tables, const int tile, const int lane) {
  const int vertices = work->arrangement[LAST_ARRANGEMENT].vertices;
  const int rows = LESSER(TILE, vertices - tile);
  for (int j = lane * VEC; j < MOMENT_STRIDE; j += LANES * VEC) {
    TABLES const number *matrix = layer_matrix(work, tables, HIDDEN - 1) + j;
    const numbers bias = LOAD(layer_bias(work, tables, HIDDEN - 1) + j);
    for (int v = 0; v < rows; v += VERTEX_BLOCK) {
      numbers z[VERTEX_BLOCK];
#pragma unroll
      for (int q = 0; q < VERTEX_BLOCK; ++q) z[q] = bias;
      for (int i = 0; i < WIDTH[HIDDEN - 1]; ++i) {
        const numbers weight = LOAD(matrix + i * MOMENT_STRIDE);
        TABLES const number *h = tables->activation + i * TILE + v;
#pragma unroll
        for (int q = 0; q < VERTEX_BLOCK; ++q) z[q] = FMA(weight, (numbers)h[q], z[q]);
      }
#pragma unroll
      for (int q = 0; q < VERTEX_BLOCK; ++q)
        PUT(z[q], TABLES, tables->value + (tile + v + q) * MOMENT_STRIDE + j);
    }
  }
}

/* The values of the last hidden layer's neurons at all vertices of the last arrangement. */
void vertex_values(SPACE const Workspace *work, TABLES Tables *tables, const int lane) {
  const int vertices = work->arrangement[LAST_ARRANGEMENT].vertices;
  for (int tile = 0; tile < vertices; tile += TILE) {
    tile_activations(work, tables, tile, lane);
    BARRIER();
    tile_values(work, tables, tile, lane);
    BARRIER();
  }
}

#endif

/* Adds the triangles to the moments, neurons across lanes. */
void add_triangles(TABLES Tables *tables, const int triangles, const int lane) {
  for (int j = lane * VEC; j < MOMENT_STRIDE; j += LANES * VEC) {
    TABLES const number *value = tables->value + j;
    numbers moment = LOAD(tables->moment + j);
    numbers error = LOAD(tables->moment_error + j);
    TABLES number *open = tables->open + BIAS_OFFSET[HIDDEN - 1] + j;
    numbers open_sum = 0;
    for (int first = 0; first < triangles; first += TRIANGLES_A_SUM) {
      const int last = LESSER(first + TRIANGLES_A_SUM, triangles);
      numbers sum = 0;
      for (int t = first; t < last; ++t) {
        TABLES const Triangle *triangle = &tables->triangle[t];
        numbers share;
        const numbers integral = triangle_integral(LOAD(value + triangle->vertex[0] * MOMENT_STRIDE),
                                                   LOAD(value + triangle->vertex[1] * MOMENT_STRIDE),
                                                   LOAD(value + triangle->vertex[2] * MOMENT_STRIDE), &share);
        sum = FMA((numbers)triangle->third_area, integral, sum);
        open_sum = FMA((numbers)triangle->third_area, share, open_sum);
      }
      COMPENSATED_ADD(numbers, moment, error, sum);
    }
    PUT(FMA((numbers)3, open_sum, LOAD(open)), TABLES, open);
    PUT(moment, TABLES, tables->moment + j);
    PUT(error, TABLES, tables->moment_error + j);
  }
}

/* Adds the cell's last arrangement to the moments. */
void integrate_cell(SPACE Workspace *work, TABLES Tables *tables, const int lane) {
  if (lane == 0) leader_list_triangles(work, tables);
  BARRIER();
  vertex_values(work, tables, lane);
  BARRIER();
  add_triangles(tables, work->listed, lane);
#if HIDDEN > 1
  add_cell(work, tables, LAST_ARRANGEMENT, -1, lane);
#endif
  BARRIER();
}
