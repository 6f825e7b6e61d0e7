"""Figures as SVG text that follows the page's colours: bars, and lines over two logarithmic axes.

Shapes have classes, not colours: `s0` to `s6` are the series, `ink` is text and `grid` are lines. The
page, and `standalone` for files, give these their colours, light and dark.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from html import escape

# Of a figure, in units of which 420 are a phone's width.
WIDTH, ROW, LABEL, VALUE = 420, 17, 172, 54
PLOT_HEIGHT, MARGIN = 250, (46, 30)
COLOURS = (
    # The series on light ground, and on dark.
    ("#1f6fb2", "#6db3f2"), ("#d9661f", "#ff9d5c"), ("#2b8a3e", "#69c779"), ("#8452a8", "#c49be0"),
    ("#7a7a7a", "#a5a5a5"), ("#b5294e", "#f07f9d"), ("#0b7f86", "#5cc8cf"),
)  # fmt: skip
INK = ("#222222", "#e6e6e6")
GRID = ("#c9c9c9", "#555555")


def style(dark: bool) -> str:
    """Rules for the classes."""
    series = "".join(f".s{n}{{fill:{pair[dark]};stroke:{pair[dark]}}}" for n, pair in enumerate(COLOURS))
    return (
        f"{series}.ink{{fill:{INK[dark]};stroke:none;font:11px system-ui,sans-serif}}"
        f".grid{{stroke:{GRID[dark]};stroke-width:1;fill:none}}"
        ".line{fill:none;stroke-width:1.8}"
    )


def standalone(svg: str) -> str:
    """The figure for a file of its own, on either ground."""
    rules = f"<style>{style(False)}@media(prefers-color-scheme:dark){{{style(True)}}}</style>"
    head, body = svg.split(">", 1)
    return f"{head}>{rules}{body}\n"


def bars(
    rows: Sequence[tuple[str, float, int]],
    note: str,
    mark: float | None = None,
    log: bool = True,
    series: Sequence[str] = (),
) -> str:
    """Horizontal bars.

    Parameters
    ----------
    rows : sequence of (str, float, int)
        Label, value and number of the series. Values must be positive where `log`.
    note : str
        What is shown, and in which unit.
    mark : float, optional
        Where bars begin, to either side: 1 for ratios.
    series : sequence of str
        What the series are called, if there are several.
    """
    values = [value for _, value, _ in rows]
    scale = math.log10 if log else float
    low, high = min(values), max(values)
    if mark is not None:
        low, high = min(low, mark), max(high, mark)
    start = (scale(low) - (0.0 if mark is not None else 0.15)) if log else min(0.0, low)
    span = max(scale(high) - start, 1e-9)
    room = WIDTH - LABEL - VALUE

    def across(value: float) -> float:
        return LABEL + room * (scale(value) - start) / span

    legend, first = _legend(series, 26)
    start_y = first - 4
    height = ROW * len(rows) + start_y + 4
    parts = [_text(4, 13, note), *legend]
    base = across(mark) if mark is not None else LABEL
    for k, (label, value, number) in enumerate(rows):
        top, end = start_y + ROW * k, across(value)
        left, width = min(base, end), max(abs(end - base), 1.0)
        parts.append(_text(LABEL - 5, top + 12, label, "end"))
        parts.append(
            f'<rect class="s{number}" x="{left:.1f}" y="{top + 2}" width="{width:.1f}" height="12"/>'
        )
        parts.append(_text(max(left + width, base) + 4, top + 12, brief(value)))
    if mark is not None:
        parts.append(f'<path class="grid" d="M{base:.1f} {start_y - 2}V{height - 2}"/>')
    return _svg(height, parts, note)


def lines(series: Mapping[str, Sequence[tuple[float, float]]], x_name: str, y_name: str) -> str:
    """Lines over logarithmic axes; points that are not positive are left out."""
    kept = {name: [(x, y) for x, y in points if x > 0 and y > 0] for name, points in series.items()}
    points = [point for own in kept.values() for point in own]
    legend, first = _legend(list(kept), 26)
    (left, below), top = MARGIN, first
    height = top + PLOT_HEIGHT + below
    x_axis = _Axis([x for x, _ in points], left, WIDTH - 12)
    y_axis = _Axis([y for _, y in points], top + PLOT_HEIGHT, top)
    parts = [_text(4, 13, f"{y_name} against {x_name}"), *legend]
    for value in x_axis.ticks:
        at = x_axis.at(value)
        parts.append(f'<path class="grid" d="M{at:.1f} {top}V{top + PLOT_HEIGHT}"/>')
        parts.append(_text(at, top + PLOT_HEIGHT + 15, brief(value), "middle"))
    for value in y_axis.ticks:
        at = y_axis.at(value)
        parts.append(f'<path class="grid" d="M{left} {at:.1f}H{WIDTH - 12}"/>')
        parts.append(_text(left - 4, at + 4, brief(value), "end"))
    for k, own in enumerate(kept.values()):
        number = k % len(COLOURS)
        path = "L".join(f"{x_axis.at(x):.1f} {y_axis.at(y):.1f}" for x, y in own)
        if path:
            parts.append(f'<path class="line s{number}" style="fill:none" d="M{path}"/>')
        parts += [
            f'<circle class="s{number}" cx="{x_axis.at(x):.1f}" cy="{y_axis.at(y):.1f}" r="2.4"/>'
            for x, y in own
        ]
    return _svg(height, parts, f"{y_name} against {x_name}")


def _legend(series: Sequence[str], top: float) -> tuple[list[str], float]:
    """Names of series with their colours, below `top`; and where they end."""
    # As many beside each other as the longest leaves room for.
    columns = max(1, min(3, int((WIDTH - 8) / (6.2 * max(map(len, series), default=1) + 22))))
    parts = []
    for k, name in enumerate(series):
        x, y = 6 + (k % columns) * (WIDTH - 8) // columns, top + 4 + 14 * (k // columns)
        parts.append(f'<rect class="s{k % len(COLOURS)}" x="{x}" y="{y - 7}" width="10" height="6"/>')
        parts.append(_text(x + 14, y, name))
    return parts, top + 14 * -(-len(series) // columns)


class _Axis:
    """A logarithmic axis between two places of the figure."""

    def __init__(self, values: Sequence[float], start: float, end: float) -> None:
        low, high = math.log10(min(values, default=1)), math.log10(max(values, default=10))
        margin = max(0.04 * (high - low), 0.05)
        self._low, self._high = low - margin, high + margin
        self._start, self._end = start, end
        decades = range(math.ceil(self._low), math.floor(self._high) + 1)
        step = max(1, len(decades) // 6)
        ticks = [10.0**n for n in decades[::step]]
        if len(ticks) < 2:
            numbers = range(math.floor(self._low), math.ceil(self._high) + 1)
            every = (m * 10.0**n for n in numbers for m in (1, 2, 5))
            ticks = [t for t in every if self._low <= math.log10(t) <= self._high]
        self.ticks = ticks

    def at(self, value: float) -> float:
        share = (math.log10(value) - self._low) / (self._high - self._low)
        return self._start + share * (self._end - self._start)


def brief(value: float) -> str:
    """A number in few characters."""
    if value == 0:
        return "0"
    return f"{value:.3g}" if 1e-3 <= abs(value) < 1e5 else f"{value:.0e}".replace("e-0", "e-")


def _text(x: float, y: float, text: str, anchor: str = "start") -> str:
    return f'<text class="ink" x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{escape(text)}</text>'


def _svg(height: float, parts: Sequence[str], name: str) -> str:
    body = "".join(parts)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height:.0f}" role="img" '
        f'aria-label="{escape(name)}">{body}</svg>'
    )
