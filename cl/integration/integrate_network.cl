/* The memory of a work-group while it integrates a network, and how the network's parameters get there.
 *
 * Workspace holds what the lanes share and the leader walks through: it lies in SPACE (local memory on
 * GPUs if it fits). Tables hold the parameters and the flat lists that the lanes share out; they lie in
 * TABLES (global, or private where a work-item is alone). Matrices are stored transposed, [input][output], outputs padded with zeros to whole
 * vectors, so that one load reads the weights of VEC neurons.
 *
 * Range. Each neuron is scaled by a power of two (exact) so that its largest parameter lies in [1, 2),
 * and the next layer's column by the inverse. relu and leaky relu commute with positive factors, so the
 * scales of all layers are only added up, as exponents, and no product overflows or underflows, whatever
 * the weights. Where every neuron's largest parameter is moderate already, as in any ordinary network,
 * scaling would change no bit of the result and take a tenth of a small network's time: such points are
 * not scaled.
 *
 * Constants from the host: HIDDEN, ARRANGEMENTS, WIDTHS, STRIDES, MATRIX_OFFSETS, BIAS_OFFSETS and the
 * sizes of the arrays below; CORNER_BOUNDS, the most corners that a cell of each arrangement can have.
 *
 * Work-group contract: all functions are called by all lanes; none but scale_layers holds barriers.
 * Loops over neurons run to the padded end, so that all lanes take the same number of turns: PoCL 3
 * miscompiles an inner loop inside an outer one whose number of turns depends on the lane.
 */

#define LAST_ARRANGEMENT (ARRANGEMENTS - 1)
/* Faces whose areas are summed before the sum is added, compensated, to the total. */
#define FACES_A_SUM 16
/* Vertices whose activations are held at a time. */
#define TILE (VEC * LANES < 4 ? 4 : VEC * LANES)

/* A face: area, first moments, mean of its corners, sum of its triangles' absolute areas. */
typedef struct {
  number area;
  number x;
  number y;
  number mean_x;
  number mean_y;
  number absolute_area;
} Face;

typedef struct {
  number third_area;
  ushort vertex[3];
} Triangle;

typedef struct {
  Dcel arrangement[ARRANGEMENTS];
  Lines lines[LINE_LAYERS];
  int crossing[LINE_STRIDE + 1];
  int first_point;
  int level;
  int listed;
  int faces;
  int shared_scaled; /* the same for the layers that all points share */
  int scaled; /* whether this point's parameters are those in `scaled_matrix` and `scaled_bias` */
  int ill_conditioned; /* whether a channel's terms are more than CONDITION_LIMIT times what remains of them */
  Face face; /* that is the cell of the arrangement at `level`, in the one before */
  /* Sum of the absolute areas, compensated. */
  number area;
  number area_error;
} Workspace;

typedef struct {
  number matrix[MATRIX_NUMBERS] __attribute__((aligned(64)));
  number bias[BIAS_NUMBERS] __attribute__((aligned(64)));
  number scaled_matrix[MATRIX_NUMBERS] __attribute__((aligned(64)));
  number scaled_bias[BIAS_NUMBERS] __attribute__((aligned(64)));
  exponent_bits exponent[BIAS_NUMBERS] __attribute__((aligned(64)));
  number moment[MOMENT_STRIDE] __attribute__((aligned(64)));
  number moment_error[MOMENT_STRIDE] __attribute__((aligned(64)));
  number output[OUTPUT_STRIDE] __attribute__((aligned(64)));
  number bound[OUTPUT_STRIDE] __attribute__((aligned(64)));
  /* For certification, see integrate_check.cl. */
  number terms[BIAS_NUMBERS] __attribute__((aligned(64)));
  number inverse_terms[BIAS_NUMBERS] __attribute__((aligned(64)));
  number open[BIAS_NUMBERS] __attribute__((aligned(64)));
  number on_terms[BIAS_NUMBERS] __attribute__((aligned(64)));
  number excess[VEC * LANES] __attribute__((aligned(64)));
#if METHOD_FULL
  Face face[MAX_FACES];
#else
  number vertex_weight[MAX_VERTICES] __attribute__((aligned(64))); /* a third of the areas around a vertex */
  number activation[LINE_STRIDE * TILE] __attribute__((aligned(64)));
  number value[MAX_VERTICES * MOMENT_STRIDE] __attribute__((aligned(64)));
  Triangle triangle[MAX_TRIANGLES];
#endif
} __attribute__((aligned(64))) Tables;

/* Layer k maps WIDTH[k] numbers to WIDTH[k + 1]; outputs are padded to STRIDE[k]. */
__constant int WIDTH[] = {WIDTHS};
__constant int STRIDE[] = {STRIDES};
__constant int MATRIX_OFFSET[] = {MATRIX_OFFSETS};
__constant int BIAS_OFFSET[] = {BIAS_OFFSETS};
__constant int CORNER_BOUND[] = {CORNER_BOUNDS};

/* Adds a triangle of the fan round a corner: twice its area, and the sum of its sides from that
 * corner. */
void add_to_face(Face *face, const number doubled_area, const number sum_x, const number sum_y) {
  const number area = (number)0.5f * doubled_area;
  face->area += area;
  face->x = FMA(area, sum_x, face->x);
  face->y = FMA(area, sum_y, face->y);
  face->absolute_area += fabs(area);
}

/* The fan's sums to moments and mean; (x, y) is the corner. */
void finish_face(Face *face, const number x, const number y, const int corners) {
  const number third = (number)1 / (number)3;
  const number share = (number)1 / (number)corners;
  face->x = FMA(face->area, x, face->x * third);
  face->y = FMA(face->area, y, face->y * third);
  face->mean_x *= share;
  face->mean_y *= share;
}

numbers activate(const numbers z) {
#if LEAKY
  return z < 0 ? (number)NEGATIVE_SLOPE * z : z;
#else
  return z > 0 ? z : (numbers)0;
#endif
}

/* ---- parameters ---------------------------------------------------------------------------------- */

/* Transposes the row-major weights of layer k into `matrix`. */
void load_weights(TABLES Tables *tables, const int k, __global const stored *weights, const int lane) {
  const int inputs = WIDTH[k];
  const int stride = STRIDE[k];
  TABLES number *matrix = tables->matrix + MATRIX_OFFSET[k];
  for (int i = 0; i < inputs; ++i)
    for (int j = lane; j < WIDTH[k + 1]; j += LANES) matrix[i * stride + j] = (number)weights[j * inputs + i];
}

/* Copies the biases of layer k. */
void load_biases(TABLES Tables *tables, const int k, __global const stored *biases, const int lane) {
  for (int j = lane; j < WIDTH[k + 1]; j += LANES) tables->bias[BIAS_OFFSET[k] + j] = (number)biases[j];
}

/* Sets `scaled` if a neuron of layer k has to be scaled. */
void check_range(SPACE int *scaled, TABLES const Tables *tables, const int k, const int lane) {
  const int inputs = WIDTH[k];
  const int stride = STRIDE[k];
  TABLES const number *matrix = tables->matrix + MATRIX_OFFSET[k];
  for (int j = lane * VEC; j < stride; j += LANES * VEC) {
    numbers largest = fabs(LOAD(tables->bias + BIAS_OFFSET[k] + j));
    for (int i = 0; i < inputs; ++i) {
      const numbers weight = fabs(LOAD(matrix + i * stride + j));
      largest = GREATER(largest, weight);
    }
    if (!all_moderate(largest)) RAISE(scaled);
  }
}

/* The parameters of layer k to compute with. */
TABLES const number *layer_matrix(SPACE const Workspace *work, TABLES const Tables *tables, const int k) {
  return (work->scaled ? tables->scaled_matrix : tables->matrix) + MATRIX_OFFSET[k];
}

TABLES const number *layer_bias(SPACE const Workspace *work, TABLES const Tables *tables, const int k) {
  return (work->scaled ? tables->scaled_bias : tables->bias) + BIAS_OFFSET[k];
}

/* What was computed for neurons [j, j + VEC) of layer k, with their powers of two put back. */
numbers unscale(SPACE const Workspace *work, TABLES const Tables *tables, const int k, const int j,
                const numbers value) {
  if (!work->scaled) return value;
  return times_power_of_two(value, LOAD(tables->exponent + BIAS_OFFSET[k] + j));
}

/* Scales the neurons of layer k by powers of two, given the exponents taken out of the layer before. */
void scale_layer(TABLES Tables *tables, const int k, const int lane) {
  const int inputs = WIDTH[k];
  const int stride = STRIDE[k];
  TABLES const number *matrix = tables->matrix + MATRIX_OFFSET[k];
  TABLES number *scaled = tables->scaled_matrix + MATRIX_OFFSET[k];
  TABLES const exponent_bits *before = tables->exponent + (k > 0 ? BIAS_OFFSET[k - 1] : 0);
  for (int j = lane * VEC; j < stride; j += LANES * VEC) {
    const numbers bias = LOAD(tables->bias + BIAS_OFFSET[k] + j);
    exponents largest = exponent_of(bias);
    for (int i = 0; i < inputs; ++i) {
      const exponents e = exponent_of(LOAD(matrix + i * stride + j)) + (k > 0 ? before[i] : 0);
      largest = GREATER(largest, e);
    }
    PUT(times_power_of_two(bias, -largest), TABLES, tables->scaled_bias + BIAS_OFFSET[k] + j);
    for (int i = 0; i < inputs; ++i)
      PUT(times_power_of_two(LOAD(matrix + i * stride + j), (k > 0 ? before[i] : 0) - largest), TABLES,
          scaled + i * stride + j);
    STORE(largest, tables->exponent + BIAS_OFFSET[k] + j);
  }
}

/* All layers; ends with a barrier. */
void scale_layers(TABLES Tables *tables, const int lane) {
  for (int k = 0; k <= HIDDEN; ++k) {
    scale_layer(tables, k, lane);
    BARRIER();
  }
}

/* The first layer's neurons are lines in the unit square. */
void first_lines(SPACE Workspace *work, TABLES const Tables *tables, const int lane) {
  SPACE Lines *lines = &work->lines[0];
  TABLES const number *matrix = layer_matrix(work, tables, 0);
  TABLES const number *bias = layer_bias(work, tables, 0);
  for (int j = lane * VEC; j < STRIDE[0]; j += LANES * VEC) {
    PUT(LOAD(matrix + j), SPACE, lines->a + j);
    PUT(LOAD(matrix + STRIDE[0] + j), SPACE, lines->b + j);
    PUT(LOAD(bias + j), SPACE, lines->c + j);
  }
}

void clear_sums(TABLES Tables *tables, const int lane) {
  for (int j = lane; j < MOMENT_STRIDE; j += LANES) {
    tables->moment[j] = 0;
    tables->moment_error[j] = 0;
  }
  for (int j = lane * VEC; j < BIAS_NUMBERS; j += LANES * VEC) PUT((numbers)0, TABLES, tables->open + j);
  PUT((numbers)0, TABLES, tables->excess + lane * VEC);
}
