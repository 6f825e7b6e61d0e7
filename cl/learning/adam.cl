/* Adam: one step of a network's parameters and of the hash grid's entries that a minibatch touched.
 *
 * The first PARAMETER_FLOATS / VEC work-items update VEC network parameters each (Kingma and Ba 2015, algorithm
 * 1), laid out as in train.cl: the gradient is the sum of `groups` rows of `partial`, in order. Each further
 * work-item updates VEC table entries. It gathers their gradients from an inverted index: pairs starts[i] ..
 * starts[i + 1] of the index belong to item i, entry entries[i]; each is a place in `grid_gradient` and a weight.
 * No atomics, so the same bits every time. Entries that a minibatch does not touch stay as they are.
 *
 * The step's rows of `plan` and `rates` hold the groups, entries and step sizes. The global offset tells
 * which rows these are (Kernel.repeat).
 *
 * Memory layout: entry e of `table` begins at e * ENTRY_FLOATS: GRID_FEATURES values. Then with
 * TABLE_ADAM both of Adam's moments of each value; else one second moment for all of them, and the sum
 * of the weights that the moving average has given to gradients so far.
 *
 * Work-group contract: one-dimensional, any size, no local memory, no barriers.
 */

#define AT_MOMENT GRID_FEATURES

/* Keeps moments of parameters without gradient from decaying to denormal numbers, with which CPUs are
 * slow. */
#define TINY 1e-30f

/* An entry's gradient by the index's item. */
entry_features gather_gradient(const uint item, global const uint *restrict starts, global const uint *restrict places,
                               global const float *restrict weights, global const float *restrict grid_gradient) {
  entry_features sum = (entry_features)0.0f;
  for (uint k = starts[item]; k < starts[item + 1]; ++k) sum += weights[k] * LOAD_ENTRY(grid_gradient + places[k]);
  return sum;
}

#if TABLE_ADAM
/* Table entries number first .. first + VEC of the index, those before `end`, as the network's
 * parameters are updated. The corrections in the step's `rates` are right for entries that every
 * minibatch touches. */
void update_entries(global const float *restrict rates, const uint first, const uint end,
                    global const uint *restrict entries, global const uint *restrict starts,
                    global const uint *restrict places, global const float *restrict weights,
                    global const float *restrict grid_gradient, global float *restrict table) {
  const float rate = rates[RATE_TABLE];
  for (uint item = first; item < min(first + VEC, end); ++item) {
    const entry_features gradient = gather_gradient(item, starts, places, weights, grid_gradient);
    global float *restrict own = table + entries[item] * (ulong)ENTRY_FLOATS;
    const entry_features m1 = ADAM_BETA1 * LOAD_ENTRY(own + AT_MOMENT) + ((1.0f - ADAM_BETA1) * gradient + TINY);
    const entry_features m2 = ADAM_BETA2 * LOAD_ENTRY(own + AT_MOMENT + GRID_FEATURES) +
                              ((1.0f - ADAM_BETA2) * gradient * gradient + TINY);
    STORE_ENTRY(LOAD_ENTRY(own) - rate * (m1 * rates[RATE_CORRECTION1]) /
                                         (sqrt(m2 * rates[RATE_CORRECTION2]) + ADAM_EPSILON), own);
    STORE_ENTRY(m1, own + AT_MOMENT);
    STORE_ENTRY(m2, own + AT_MOMENT + GRID_FEATURES);
  }
}
#else
/* Table entries number first .. first + VEC of the index, those before `end`. An entry has one second
 * moment for all its features and no first one: entries are touched too rarely for momentum. The share
 * of the present gradients in the moving average corrects its start from zero, entry by entry. */
void update_entries(global const float *restrict rates, const uint first, const uint end,
                    global const uint *restrict entries, global const uint *restrict starts,
                    global const uint *restrict places, global const float *restrict weights,
                    global const float *restrict grid_gradient, global float *restrict table) {
  const float rate = rates[RATE_TABLE];
  for (uint item = first; item < min(first + VEC, end); ++item) {
    const entry_features gradient = gather_gradient(item, starts, places, weights, grid_gradient);
    float each[GRID_FEATURES];
    STORE_ENTRY(gradient, each);
    float squares = 0.0f;
#pragma unroll
    for (uint f = 0; f < GRID_FEATURES; ++f) squares += each[f] * each[f];
    global float *restrict own = table + entries[item] * (ulong)ENTRY_FLOATS;
    const float moment =
        TABLE_BETA2 * own[AT_MOMENT] + ((1.0f - TABLE_BETA2) / GRID_FEATURES * squares + TINY);
    const float share = TABLE_BETA2 * own[AT_MOMENT + 1] + (1.0f - TABLE_BETA2);
    STORE_ENTRY(LOAD_ENTRY(own) - rate / (sqrt(moment / share) + ADAM_EPSILON) * gradient, own);
    own[AT_MOMENT] = moment;
    own[AT_MOMENT + 1] = share;
  }
}
#endif

kernel void adam(global const uint *restrict plan, global const float *restrict rates,
                 global const float *restrict partial, global float *restrict parameters,
                 global float *restrict moment1, global float *restrict moment2,
                 global float *restrict average, global float *restrict loss,
                 global const uint *restrict entries, global const uint *restrict starts,
                 global const uint *restrict places, global const float *restrict weights,
                 global const float *restrict grid_gradient, global float *restrict table) {
  const size_t number = get_global_offset(0) / get_local_size(0);
  global const uint *restrict step = plan + number * PLAN_WORDS;
  global const float *restrict own_rates = rates + number * RATE_FLOATS;
  const uint work_item = (uint)(get_global_id(0) - get_global_offset(0));
  if (work_item < PARAMETER_FLOATS / VEC) {
    const uint groups = step[PLAN_GROUPS];
    const float rate = own_rates[RATE_NETWORK];
    const float correction1 = own_rates[RATE_CORRECTION1];
    const float correction2 = own_rates[RATE_CORRECTION2];
    const float average_decay = own_rates[RATE_AVERAGE];
    const uint p = work_item * VEC;
    real gradient = (real)0.0f;
    for (uint g = 0; g < groups; ++g) gradient += LOAD(partial + g * (ulong)PARAMETER_FLOATS + p);
    const real m1 = ADAM_BETA1 * LOAD(moment1 + p) + ((1.0f - ADAM_BETA1) * gradient + TINY);
    const real m2 = ADAM_BETA2 * LOAD(moment2 + p) + ((1.0f - ADAM_BETA2) * gradient * gradient + TINY);
    const real value =
        LOAD(parameters + p) - rate * (m1 * correction1) / (sqrt(m2 * correction2) + ADAM_EPSILON);
    STORE(value, parameters + p);
    STORE(m1, moment1 + p);
    STORE(m2, moment2 + p);
    STORE(value + average_decay * (LOAD(average + p) - value), average + p);
    if (work_item == 0) {
      float sum = 0.0f;
      for (uint g = 0; g < groups; ++g) sum += partial[g * (ulong)PARAMETER_FLOATS + PARAMETER_LOSS];
      *loss = sum;
    }
    return;
  }
  const uint first = step[PLAN_FIRST_ENTRY] + (work_item - PARAMETER_FLOATS / VEC) * VEC;
  if (first < step[PLAN_END_ENTRY])
    update_entries(own_rates, first, step[PLAN_END_ENTRY], entries, starts,
                   places, weights, grid_gradient, table);
}
