/* The hash grid's gather lists (grid_index.py), built on GPUs: which columns touch which table entry, batch after batch.
 *
 * A pair is one corner of one column. Corner r of column c is corner[r * stride + c], with `weight` alike; there are
 * CORNERS a column. Columns edges[b] to edges[b + 1] are batch b, whose pairs are numbered row after row. A pair's key
 * holds its batch, its entry and its number in this order, so keys are all different and their order is the host's
 * stable one: lists are the same bit for bit, whoever sorts.
 *
 *   mark_entries   the entries that any column touches
 *   make_keys      keys of all pairs, by the touched entries' numbers, and after them keys that are larger than any
 *   sort_keys      one step of Batcher's bitonic sort (1968): keys at a distance of `reach` in runs of `span`
 *   count_lists    entries that begin in each chunk of pairs; the host sums these to `offsets`
 *   write_lists    entries, where their pairs begin, and each pair's place and weight, as adam.cl reads them
 *
 * Work-group contract: one-dimensional, any size, no local memory, no barriers. mark_entries and make_keys: a work-item
 * a pair; sort_keys: one two keys; the others: one a chunk.
 */

#define CORNERS (GRID_LEVELS * 8)

kernel void mark_entries(const uint count, const uint stride, global const uint *restrict corner,
                         global uint *restrict touched) {
  const uint item = (uint)get_global_id(0);
  if (item < CORNERS * stride && item % stride < count) touched[corner[item]] = 1u;
}

/* The batch of a column. */
uint batch_of(global const uint *restrict edges, const uint batches, const uint column) {
  uint low = 0;
  uint high = batches;
  while (high - low > 1) {
    const uint middle = (low + high) / 2;
    if (edges[middle] <= column)
      low = middle;
    else
      high = middle;
  }
  return low;
}

kernel void make_keys(const uint count, const uint stride, const uint size, const uint batches, const uint entry_shift,
                      const uint batch_shift, global const uint *restrict edges, global const uint *restrict corner,
                      global const uint *restrict number, global uint *restrict numbered,
                      global ulong *restrict keys) {
  const uint item = (uint)get_global_id(0);
  if (item >= size) return;
  if (item >= CORNERS * count) {
    keys[item] = ULONG_MAX;
    return;
  }
  const uint row = item / count;
  const uint column = item % count;
  const uint entry = number[corner[row * stride + column]];
  numbered[column * CORNERS + row] = entry;
  const uint batch = batch_of(edges, batches, column);
  const uint own = row * (edges[batch + 1] - edges[batch]) + column - edges[batch];
  keys[item] = (ulong)batch << batch_shift | (ulong)entry << entry_shift | own;
}

kernel void sort_keys(const uint size, const uint span, const uint reach, global ulong *restrict keys) {
  const uint item = (uint)get_global_id(0);
  if (item >= size / 2) return;
  const uint low = item / reach * 2 * reach + item % reach;
  const ulong first = keys[low];
  const ulong second = keys[low + reach];
  /* Runs rise and fall by turns; the last, of all keys, rises. */
  const bool rises = (low & span) == 0;
  if ((first > second) == rises) {
    keys[low] = second;
    keys[low + reach] = first;
  }
}

/* Whether a pair is the first of its batch and entry. */
bool begins_list(global const ulong *restrict keys, const uint at, const uint entry_shift) {
  return at == 0 || keys[at] >> entry_shift != keys[at - 1] >> entry_shift;
}

kernel void count_lists(const uint pairs, const uint chunk, const uint entry_shift, global const ulong *restrict keys,
                        global uint *restrict counts) {
  const uint item = (uint)get_global_id(0);
  if (item >= (pairs + chunk - 1) / chunk) return;
  uint found = 0;
  for (uint at = item * chunk; at < min(pairs, (item + 1) * chunk); ++at) found += begins_list(keys, at, entry_shift) ? 1 : 0;
  counts[item] = found;
}

kernel void write_lists(const uint pairs, const uint chunk, const uint stride, const uint entry_shift,
                        const uint batch_shift, global const uint *restrict edges, global const ulong *restrict keys,
                        global const uint *restrict offsets, global const float *restrict weight,
                        global uint *restrict entries, global uint *restrict starts, global uint *restrict places,
                        global float *restrict weights, global uint *restrict batch_lists) {
  const uint item = (uint)get_global_id(0);
  if (item >= (pairs + chunk - 1) / chunk) return;
  uint list = offsets[item];
  for (uint at = item * chunk; at < min(pairs, (item + 1) * chunk); ++at) {
    const ulong key = keys[at];
    const uint batch = (uint)(key >> batch_shift);
    if (begins_list(keys, at, entry_shift)) {
      entries[list] = (uint)(key >> entry_shift) & ((1u << (batch_shift - entry_shift)) - 1u);
      starts[list] = at;
      if (at == edges[batch] * CORNERS) batch_lists[batch] = list;
      ++list;
    }
    const uint own = (uint)(key & (((ulong)1 << entry_shift) - 1));
    const uint width = edges[batch + 1] - edges[batch];
    const uint row = own / width;
    const uint column = own % width;
    places[at] = column * (GRID_LEVELS * GRID_FEATURES) + row / 8 * GRID_FEATURES;
    weights[at] = weight[row * stride + edges[batch] + column];
  }
  if (item * chunk < pairs && pairs <= (item + 1) * chunk) starts[list] = pairs;
}
