/* What is left of VEC segments when intervals are cut out of them, one after another and in any order.
 *
 * A gap is a part that nothing has covered yet. There is room for MOST_GAPS of them; a segment with more is marked, and
 * whoever asked has to find another way. What is cut twice does no harm. Gaps shorter than a sliver, which rounding
 * leaves between neighbours, count as covered.
 *
 * Work-group contract: none; functions of private values.
 */

#define FAR_AWAY FLT_MAX

/* What is free of VEC lines: gaps from low to high, empty where low >= high, in any order. */
typedef struct {
  real low[MOST_GAPS], high[MOST_GAPS];
  uint used;
  whole refused;
} Gaps;

/* Takes from the gaps what lies between `from` and `to`, nothing where to <= from; returns whether that is something. */
bool cut_gaps(Gaps *gaps, const real from, const real to, const real sliver) {
  const real begin = SELECT((real)FAR_AWAY, from, from < to);
  const uint used = gaps->used;
  whole hit = (whole)0;
  for (uint k = 0; k < used; ++k) hit = hit || ((begin < gaps->high[k]) && (to > gaps->low[k]));
  /* Most of what is cut has been cut before. */
  if (!ANY(hit)) return false;
  const real left_of = begin - sliver;
  const real right_of = to + sliver;
  whole split = (whole)0;
  real end = (real)0.0f;
  uint kept = 0;
  for (uint k = 0; k < used; ++k) {
    const real low = gaps->low[k];
    const real high = gaps->high[k];
    const whole cut = (begin < high) && (to > low);
    const whole left = cut && (left_of > low);
    const whole right = cut && (right_of < high);
    end = SELECT(end, high, left && right);
    split = split || (left && right);
    const real new_low = SELECT(low, SELECT(high, to, right), cut && !left);
    const real new_high = SELECT(high, begin, left);
    gaps->low[kept] = new_low;
    gaps->high[kept] = new_high;
    if (ANY(new_low < new_high)) ++kept;
  }
  gaps->used = kept;
  /* Cut in two: the second half takes the first place that is empty. At most one gap of a segment is. */
  for (uint k = 0; ANY(split); ++k) {
    if (k == MOST_GAPS) {
      gaps->refused = gaps->refused || split;
      return true;
    }
    whole here = split;
    if (k < kept) {
      here = here && (gaps->low[k] >= gaps->high[k]);
    } else {
      gaps->low[k] = gaps->high[k] = (real)0.0f;
      gaps->used = k + 1;
    }
    gaps->low[k] = SELECT(gaps->low[k], to, here);
    gaps->high[k] = SELECT(gaps->high[k], end, here);
    split = split && !here;
  }
  return true;
}
