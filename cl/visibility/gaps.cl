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

/* Takes from the gaps what lies between `from` and `to`. */
void cut_gaps(Gaps *gaps, const real from, const real to, const real sliver) {
  const real left_of = from - sliver;
  const real right_of = to + sliver;
  const uint used = gaps->used;
  whole split = (whole)0;
  real end = (real)0.0f;
  for (uint k = 0; k < used; ++k) {
    const real low = gaps->low[k];
    const real high = gaps->high[k];
    const whole hit = (from < high) && (to > low);
    if (!ANY(hit)) continue;
    const whole left = hit && (left_of > low);
    const whole right = hit && (right_of < high);
    end = SELECT(end, high, left && right);
    split = split || (left && right);
    gaps->low[k] = SELECT(low, SELECT(high, to, right), hit && !left);
    gaps->high[k] = SELECT(high, from, left);
  }
  /* Cut in two: the second half takes the first place that is empty. At most one gap of a line is. */
  for (uint k = 0; ANY(split); ++k) {
    if (k == MOST_GAPS) {
      gaps->refused = gaps->refused || split;
      return;
    }
    whole here = split;
    if (k < used) {
      here = here && (gaps->low[k] >= gaps->high[k]);
    } else {
      gaps->low[k] = gaps->high[k] = (real)0.0f;
      gaps->used = k + 1;
    }
    gaps->low[k] = SELECT(gaps->low[k], to, here);
    gaps->high[k] = SELECT(gaps->high[k], end, here);
    split = split && !here;
  }
}
