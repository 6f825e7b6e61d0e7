/* Method `full`, last step: the integrals of the last hidden layer's neurons over the faces of its own
 * arrangement, where each of them is affine and keeps its sign.
 *
 * Work-group contract: leader_* for lane 0 between barriers; integrate_cell for all lanes, ends with a barrier.
 */

/* Area and first moments of a face, as a fan of triangles; returns the sum of their absolute areas. */
number leader_measure_face(SPACE const Dcel *d, const int first, __global Face *result) {
  const int apex = d->edge[first].origin;
  const number x0 = d->x[apex];
  const number y0 = d->y[apex];
  number x1 = 0;
  number y1 = 0;
  Face face = {0, 0, 0, x0, y0};
  number absolute = 0;
  int corners = 1;
  for (int e = d->edge[first].next; e != first; e = d->edge[e].next) {
    const number x2 = d->x[d->edge[e].origin] - x0;
    const number y2 = d->y[d->edge[e].origin] - y0;
    const number triangle = (number)0.5f * cross_product(x1, y1, x2, y2);
    face.area += triangle;
    face.x = FMA(triangle, (x1 + x2) / 3, face.x);
    face.y = FMA(triangle, (y1 + y2) / 3, face.y);
    face.mean_x += x2 + x0;
    face.mean_y += y2 + y0;
    absolute += fabs(triangle);
    x1 = x2;
    y1 = y2;
    ++corners;
  }
  face.x = FMA(face.area, x0, face.x);
  face.y = FMA(face.area, y0, face.y);
  face.mean_x /= (number)corners;
  face.mean_y /= (number)corners;
  *result = face;
  return absolute;
}

/* Measures all faces of the last arrangement. */
void leader_list_faces(SPACE Workspace *work, __global Tables *tables) {
  SPACE const Dcel *d = &work->arrangement[LAST_ARRANGEMENT];
  number area = work->area;
  number area_error = work->area_error;
  for (int f = 0; f < d->faces; ++f) {
    const number absolute = leader_measure_face(d, d->face[f], &tables->face[f]);
    COMPENSATED_ADD(number, area, area_error, absolute);
  }
  work->area = area;
  work->area_error = area_error;
  work->faces += d->faces;
  work->listed = d->faces;
}

/* Adds the faces to the moments, neurons across lanes; each neuron keeps its sign in a face. */
void add_faces(SPACE const Workspace *work, __global Tables *tables, const int lane) {
  SPACE const Lines *lines = &work->lines[HIDDEN - 1];
  const int faces = work->listed;
  for (int j = lane * VEC; j < MOMENT_STRIDE; j += LANES * VEC) {
    const numbers a = LOAD(lines->a + j);
    const numbers b = LOAD(lines->b + j);
    const numbers c = LOAD(lines->c + j);
    numbers sum = 0;
    for (int f = 0; f < faces; ++f) {
      const Face face = tables->face[f];
      const numbers mean = FMA(a, (numbers)face.mean_x, FMA(b, (numbers)face.mean_y, c));
      const numbers integral =
          FMA(a, (numbers)face.x, FMA(b, (numbers)face.y, c * (numbers)face.area));
#if LEAKY
      sum += mean < 0 ? (number)NEGATIVE_SLOPE * integral : integral;
#else
      sum += mean < 0 ? (numbers)0 : integral;
#endif
    }
    numbers moment = LOAD(tables->moment + j);
    numbers error = LOAD(tables->moment_error + j);
    COMPENSATED_ADD(numbers, moment, error, sum);
    PUT(moment, __global, tables->moment + j);
    PUT(error, __global, tables->moment_error + j);
  }
}

/* Adds the cell's last arrangement to the moments. */
void integrate_cell(SPACE Workspace *work, __global Tables *tables, const int lane) {
  if (lane == 0) leader_list_faces(work, tables);
  BARRIER();
  add_faces(work, tables, lane);
  BARRIER();
}
