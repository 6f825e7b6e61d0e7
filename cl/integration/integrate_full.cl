/* Method `full`, last step: the integrals of the last hidden layer's neurons over the faces of its own
 * arrangement, where each of them is affine and keeps its sign.
 *
 * Work-group contract: leader_* for lane 0 between barriers; integrate_cell for all lanes, ends with a
 * barrier.
 */

/* Area, first moments and mean of a face, as a fan of triangles. */
Face leader_measure_face(SPACE const Dcel *d, const int first) {
  const int apex = d->edge[first].origin;
  const number x0 = d->x[apex];
  const number y0 = d->y[apex];
  number x1 = 0;
  number y1 = 0;
  Face face = {0, 0, 0, x0, y0, 0};
  int corners = 1;
  for (int e = d->edge[first].next; e != first; e = d->edge[e].next) {
    const number x2 = d->x[d->edge[e].origin] - x0;
    const number y2 = d->y[d->edge[e].origin] - y0;
    add_to_face(&face, cross_product(x1, y1, x2, y2), x1 + x2, y1 + y2);
    face.mean_x += x2 + x0;
    face.mean_y += y2 + y0;
    x1 = x2;
    y1 = y2;
    ++corners;
  }
  finish_face(&face, x0, y0, corners);
  return face;
}

/* Measures all faces of the last arrangement. */
void leader_list_faces(SPACE Workspace *work, TABLES Tables *tables) {
  SPACE const Dcel *d = &work->arrangement[LAST_ARRANGEMENT];
  number area = 0;
  for (int f = 0; f < d->faces; ++f) {
    const Face face = leader_measure_face(d, d->face[f]);
    tables->face[f] = face;
    area += face.absolute_area;
    if (f % FACES_A_SUM == FACES_A_SUM - 1 || f == d->faces - 1) {
      COMPENSATED_ADD(number, work->area, work->area_error, area);
      area = 0;
    }
  }
  work->faces += d->faces;
  work->listed = d->faces;
}

/* Adds the faces to the moments, neurons across lanes, and what they do wrong to `excess`: nothing where
 * no line crosses the cell. */
void add_faces(SPACE const Workspace *work, TABLES Tables *tables, const int lane) {
  const bool cut = work->crossing[LINE_STRIDE] > 0;
  for (int j = lane * VEC; j < MOMENT_STRIDE; j += LANES * VEC) {
    numbers sum = 0;
    numbers share = LOAD(tables->open + BIAS_OFFSET[LAST_ARRANGEMENT] + j);
    for (int f = 0; f < work->listed; ++f) {
      const numbers integral = face_integral(&work->lines[LAST_ARRANGEMENT], j, tables->face[f]);
      share += integral > 0 ? (numbers)tables->face[f].area : (numbers)0;
      sum += integral;
    }
    PUT(share, TABLES, tables->open + BIAS_OFFSET[LAST_ARRANGEMENT] + j);
    numbers moment = LOAD(tables->moment + j);
    numbers error = LOAD(tables->moment_error + j);
    COMPENSATED_ADD(numbers, moment, error, sum);
    PUT(moment, TABLES, tables->moment + j);
    PUT(error, TABLES, tables->moment_error + j);
    numbers unused;
    if (cut) add_excess(tables, LAST_ARRANGEMENT, j, cell_integral(work, LAST_ARRANGEMENT, j, &unused) - sum, lane);
  }
}

/* Adds the cell's last arrangement to the moments. */
void integrate_cell(SPACE Workspace *work, TABLES Tables *tables, const int lane) {
  if (lane == 0) leader_list_faces(work, tables);
  BARRIER();
  add_faces(work, tables, lane);
  BARRIER();
}
