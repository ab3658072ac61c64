"""Line charts as inline SVG. Colours are classes, which the page defines for light and dark."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from html import escape

WIDTH, HEIGHT = 640.0, 240.0
LEFT, RIGHT, TOP, BOTTOM = 68.0, 12.0, 10.0, 34.0

COLORS = 8  # classes `c0` to `c7` of report.css, then from the start again
DASHES = ("", "7 4", "2 3", "9 3 2 3", "14 4", "4 4 1 4")  # of lines of one colour, in order
MAX_POINTS = 1200  # two for each of 600 columns: more cannot be told apart at this width
MOST_DIGITS = 9  # of a tick's number: more do not fit to the left of the axis
SMALLEST = 1.0e-290  # what is smaller counts as zero: parts of it cannot be told from zero in double precision
LOGARITHMIC_FROM = 30.0  # ratio of the largest to the smallest value from which an axis that may be logarithmic is


@dataclass(frozen=True, slots=True)
class Line:
    """A line of a chart."""

    label: str  # in the legend
    x: Sequence[float]  # rising
    y: Sequence[float]  # as many; what is not finite leaves a gap
    color: int = 0  # index of its colour
    dash: int = 0  # index of its dashes


@dataclass(frozen=True, slots=True)
class Axis:
    """Where values lie on the paper."""

    low: float  # value at the beginning
    high: float  # value at the end
    start: float  # the beginning on the paper [pixels]
    end: float  # the end on the paper [pixels]
    logarithmic: bool = False  # distances are ratios

    def place(self, value: float) -> float:
        """Where a value lies [pixels]."""
        if self.logarithmic:
            share = math.log(value / self.low) / math.log(self.high / self.low)
        else:
            share = (value - self.low) / (self.high - self.low)
        return self.start + share * (self.end - self.start)

    def labels(self, count: int) -> list[tuple[float, str]]:
        """Places [pixels] and texts of round numbers on the axis, about `count` of them, that can be told apart."""
        ticks = self.ticks(count)
        step = abs(ticks[1] - ticks[0]) if len(ticks) > 1 and not self.logarithmic else None
        return [(self.place(tick), _number(tick, abs(tick) if step is None else step)) for tick in ticks]

    def ticks(self, count: int) -> list[float]:
        """Round numbers on the axis, about `count` of them."""
        if self.logarithmic:
            first, last = math.ceil(math.log10(self.low) - 1e-9), math.floor(math.log10(self.high) + 1e-9)
            every = max(1, math.ceil((last - first + 1) / count))
            return [10.0**exponent for exponent in range(first, last + 1, every)]
        step = _round_step((self.high - self.low) / count)
        first = math.ceil(self.low / step - 1e-9)
        last = math.floor(self.high / step + 1e-9)
        return [index * step for index in range(first, last + 1)]


def line_chart(lines: Sequence[Line], *, x_label: str, may_be_logarithmic: bool = False) -> str:
    """A chart of lines, of which one has a finite value at least, as an SVG element.

    `may_be_logarithmic`: use a logarithmic y axis where positive values differ by much; zeros then leave gaps.
    """
    x_values = [x for line in lines for x, y in zip(line.x, line.y, strict=True) if math.isfinite(y)]
    y_values = [y for line in lines for y in line.y if math.isfinite(y)]
    x_axis = _linear(min(x_values), max(x_values), LEFT, WIDTH - RIGHT)
    y_axis = _y_axis(y_values, may_be_logarithmic=may_be_logarithmic)
    parts = [
        f'<svg viewBox="0 0 {WIDTH:g} {HEIGHT:g}" role="img" aria-label="{escape(", ".join(e.label for e in lines))}">'
    ]
    parts += [
        f'<line class="grid" x1="{LEFT:g}" x2="{WIDTH - RIGHT:g}" y1="{y:.1f}" y2="{y:.1f}"/>'
        f'<text class="tick" x="{LEFT - 6:g}" y="{y + 3.5:.1f}" text-anchor="end">{number}</text>'
        for y, number in y_axis.labels(5)
    ]
    parts += [
        f'<line class="axis" x1="{x:.1f}" x2="{x:.1f}" y1="{HEIGHT - BOTTOM:g}" y2="{HEIGHT - BOTTOM + 4:g}"/>'
        f'<text class="tick" x="{x:.1f}" y="{HEIGHT - BOTTOM + 16:g}" text-anchor="middle">{number}</text>'
        for x, number in x_axis.labels(8)
    ]
    base = HEIGHT - BOTTOM
    parts.append(f'<line class="axis" x1="{LEFT:g}" x2="{WIDTH - RIGHT:g}" y1="{base:g}" y2="{base:g}"/>')
    parts.append(
        f'<text class="tick" x="{WIDTH - RIGHT:g}" y="{HEIGHT - 4:g}" text-anchor="end">{escape(x_label)}</text>'
    )
    for line in lines:
        parts += [
            f'<polyline class="line c{line.color % COLORS}" stroke-dasharray="{DASHES[line.dash % len(DASHES)]}" '
            f'points="{" ".join(f"{x_axis.place(x):.1f},{y_axis.place(y):.1f}" for x, y in run)}">'
            f"<title>{escape(line.label)}</title></polyline>"
            for run in _runs(line, positive=y_axis.logarithmic)
        ]
    return "".join([*parts, "</svg>"])


def swatch(line: Line) -> str:
    """A short piece of a line, for the legend."""
    dash = DASHES[line.dash % len(DASHES)]
    return (
        '<svg class="swatch" viewBox="0 0 28 8" aria-hidden="true">'
        f'<line class="line c{line.color % COLORS}" stroke-dasharray="{dash}" x1="0" x2="28" y1="4" y2="4"/></svg>'
    )


def _y_axis(values: Sequence[float], *, may_be_logarithmic: bool) -> Axis:
    bottom, top = HEIGHT - BOTTOM, TOP
    positive = [value for value in values if value > SMALLEST]
    if may_be_logarithmic and positive and min(values) >= 0.0 and max(positive) >= LOGARITHMIC_FROM * min(positive):
        first, last = math.floor(math.log10(min(positive))), math.ceil(math.log10(max(positive)))
        return Axis(10.0**first, 10.0**last, bottom, top, logarithmic=True)
    low, high = min(values), max(values)
    if 0.0 < low < 0.5 * high:
        low = 0.0
    elif 0.5 * low < high < 0.0:
        high = 0.0
    return _linear(low, high, bottom, top)


def _linear(low: float, high: float, start: float, end: float) -> Axis:
    """An axis that ends on round numbers where that costs little room, and has an extent in any case."""
    if high - low <= max(1e-12 * max(abs(low), abs(high)), SMALLEST):
        margin = 0.5 * abs(high) if abs(high) > SMALLEST else 1.0
        low, high = (low - margin, high + margin)
    step = _round_step((high - low) / 5)
    if start > end:  # the y axis, from bottom to top
        low, high = step * math.floor(low / step + 1e-9), step * math.ceil(high / step - 1e-9)
    return Axis(low, high, start, end)


def _round_step(least: float) -> float:
    """The smallest of 1, 2, 5, 10, ... times a power of ten that is no less."""
    power = 10.0 ** math.floor(math.log10(least))
    return next(factor * power for factor in (1.0, 2.0, 5.0, 10.0) if factor * power >= least * (1.0 - 1e-9))


def _number(value: float, step: float) -> str:
    """A tick's number: as short as tells it from one a step away, and the same zero for both signs of it."""
    if abs(value) < 1e-6 * step or value == 0.0:
        return "0"
    digits = 1 + math.floor(math.log10(abs(value))) - math.floor(math.log10(step) + 1e-9)
    text = f"{value:.{min(max(4, digits), MOST_DIGITS)}g}"
    mantissa, exponent_sign, exponent = text.partition("e")
    return f"{mantissa}e{int(exponent)}" if exponent_sign else mantissa


def _runs(line: Line, *, positive: bool) -> Iterator[list[tuple[float, float]]]:
    """The pieces between gaps, thinned out where there are more points than columns. A lone point is drawn, too."""
    run: list[tuple[float, float]] = []
    for x, y in zip(line.x, line.y, strict=True):
        if math.isfinite(y) and (y > 0.0 or not positive):
            run.append((x, y))
        elif run:
            yield _thinned(run)
            run = []
    if run:
        yield _thinned(run)


def _thinned(run: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """The lowest and the highest of each of some hundred pieces: no peak is lost."""
    if len(run) == 1:
        return run * 2
    if len(run) <= MAX_POINTS:
        return run
    size = math.ceil(len(run) / (MAX_POINTS // 2))
    kept = []
    for start in range(0, len(run), size):
        piece = run[start : start + size]
        kept += sorted({min(piece, key=lambda point: point[1]), max(piece, key=lambda point: point[1])})
    return kept
