"""Geometry of the page's charts, in SVG units; `templates/charts.html.j2` draws the charts.

Colours are the classes c0 to c5 of the stylesheet, which defines them for light mode, dark mode and
print. Lines also differ in their dashes, for readers who cannot distinguish the colours.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from typing import NamedTuple

from vlagents_ray.evaluate.results.statistics import Rate

NONE, MINUS = "\u2013", "\u2212"
_COLOURS = 6
_DASHES = (None, "7 3", "2 3", "9 3 2 3", "12 4", "4 4")
_GLYPH = 96  # the width of a glyph
_EDGE = 6  # the margin at both ends of a glyph's axis, so that a dot at an end fits
_LIMITS = (0.05, 0.1, 0.2, 0.4, 0.6, 1.0)  # possible ends of the axes of differences


def percent(rate: Rate) -> str:
    """Return the rate in percent, with one decimal."""
    return NONE if rate.rate is None else f"{100 * rate.rate:.1f}"


def interval(rate: Rate) -> str:
    """Return the interval of the rate in percent."""
    if rate.rate is None:
        return NONE
    low, high = rate.interval
    return f"{100 * low:.1f} to {100 * high:.1f}"


def bounds(values: tuple[float, float] | None) -> str:
    """Return the interval (low, high) in percent."""
    if values is None:
        return NONE
    low, high = values
    return f"{100 * low:.1f} to {100 * high:.1f}"


def interval_name(rate: Rate) -> str:
    """Return the name of the rate's interval: a confidence sequence if the number of episodes may
    depend on their outcomes, otherwise Wilson's interval.
    """
    if rate.error_rate is None:
        return "95 % Wilson interval"
    return f"{100 * (1 - rate.error_rate):g} % confidence sequence"


def points(difference: float | None) -> str:
    """Return a difference of rates, in percentage points, with its sign."""
    if difference is None:
        return NONE
    text = f"{100 * difference:+.1f}".replace("-", MINUS)
    return "0.0" if float(f"{100 * difference:.1f}") == 0 else text


def p_value(p: float) -> str:
    """Return a p-value with its significant digits; a very small one as "< 0.0001"."""
    if p < 1e-4:
        return "< 0.0001"
    if p < 0.01:
        return f"{p:.4f}"
    if p < 0.1:
        return f"{p:.3f}"
    return f"{p:.2f}"


def number(value: float | None, digits: int = 1) -> str:
    """Return a number with thin spaces between thousands; a dash for None."""
    return NONE if value is None else f"{value:,.{digits}f}".replace(",", "\u202f")


def quantity(n: int, noun: str) -> str:
    """Return a number with a noun, in the plural if it is not 1: "1 episode", "2 episodes"."""
    return f"{number(n, 0)} {noun}" if n == 1 else f"{number(n, 0)} {noun}s"


def duration(seconds: float) -> str:
    """Return a duration in at most two units: "1 h 12 min"."""
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 60 else f"{minutes // 60} h {minutes % 60} min"


def moment(seconds: float) -> str:
    """Return a time in seconds since 1970, to the minute, in UTC."""
    return datetime.fromtimestamp(seconds, timezone.utc).strftime("%Y-%m-%d %H:%M UTC")


class PlotArea(NamedTuple):
    """Size of a chart, and the edges of the area inside its axes."""

    width: int = 460
    height: int = 280
    left: int = 38
    right: int = 450
    top: int = 10
    bottom: int = 240

    def y(self, share: float) -> float:
        """Return the y coordinate at which `share`, in [0, 1], is drawn."""
        return self.top + (self.bottom - self.top) * (1 - share)


PLOT = PlotArea()


@dataclass(frozen=True, slots=True)
class Series:
    """Rates with their intervals, by x."""

    name: str
    points: Sequence[tuple[float, Rate]]
    level: bool = False  # whether the series is a single rate, independent of x


@dataclass(frozen=True, slots=True)
class Style:
    """An entry of a legend."""

    name: str
    colour: str  # a class of the stylesheet
    dashes: str | None = None  # `stroke-dasharray`


@dataclass(frozen=True, slots=True)
class Curve:
    """A series as it is drawn."""

    style: Style
    path: str | None  # the path of the line; None: no rate is known
    band: str | None  # the path around its intervals
    dots: list[tuple[float, float, str]]  # (x, y, description)


@dataclass(frozen=True, slots=True)
class RateChart:
    """A chart of rates in percent against x, each with the band of its intervals."""

    title: str
    x_label: str
    x_ticks: list[tuple[float, str]]  # (x, text)
    lines: list[Curve]


@dataclass(frozen=True, slots=True)
class BarChart:
    """A chart of bars that consist of segments, all on one scale. A bar is (name, sum of its
    values, [(style, value, width in percent)]).
    """

    title: str
    legend: list[Style]
    bars: list[tuple[str, float, list[tuple[Style, float, float]]]]


@dataclass(frozen=True, slots=True)
class Glyph:
    """A dot with its interval on an axis, for the cell of a table. It is only decoration, since the
    next cells contain the numbers.
    """

    axis: str
    range: str | None
    dot: float | None
    decided: bool = True  # False: the dot is hollow


def rate_chart(series: Sequence[Series], x_label: str, title: str) -> RateChart:
    """Return a chart with a line for each of `series`, in order, on a common axis from the smallest
    to the largest x.
    """
    all_x: list[float] = []
    for line in series:
        all_x += [x for x, _ in line.points]
    low_x, high_x = min(all_x, default=0.0), max(all_x, default=0.0)
    if low_x == high_x:
        low_x, high_x = low_x - 1, high_x + 1

    def x_of(x: float) -> float:
        return PLOT.left + (PLOT.right - PLOT.left) * (x - low_x) / (high_x - low_x)

    curves = []
    for index, line in enumerate(series):
        style = Style(line.name, f"c{index % _COLOURS}", _DASHES[index % len(_DASHES)])
        rates, lows, highs, dots = [], [], [], []
        for x, rate in line.points:
            if rate.rate is None:
                continue
            low, high = rate.interval
            rates.append((x_of(x), PLOT.y(rate.rate)))
            lows.append((x_of(x), PLOT.y(low)))
            highs.append((x_of(x), PLOT.y(high)))
            if not line.level:
                text = f"{line.name}, {short(x)}: {percent(rate)} % ({interval(rate)})"
                dots.append((x_of(x), PLOT.y(rate.rate), text))

        path = band = None
        if rates:
            path = _path(rates)
            band = f"{_path([*lows, *reversed(highs)])}Z"
        curves.append(Curve(style, path, band, dots))

    x_ticks = [(x_of(tick), short(tick)) for tick in ticks(low_x, high_x)]
    return RateChart(title, x_label, x_ticks, curves)


def bar_chart(rows: Mapping[str, Mapping[str, float]], title: str) -> BarChart:
    """Return a chart with a bar for each of `rows`, which must not be empty. A row maps the names
    of its segments to values.
    """
    names: dict[str, None] = {}  # names of all segments
    for values in rows.values():
        names |= dict.fromkeys(values)
    styles = {name: Style(name, f"c{index % _COLOURS}") for index, name in enumerate(names)}

    longest = max(sum(values.values()) for values in rows.values())
    bars = []
    for row_name, values in rows.items():
        segments = []
        for name, value in values.items():
            width = 100 * value / longest if longest else 0.0
            segments.append((styles[name], value, width))
        bars.append((row_name, sum(values.values()), segments))
    return BarChart(title, list(styles.values()), bars)


def interval_glyph(rate: Rate) -> Glyph:
    """Return the rate and its interval on an axis from 0 to 100 %."""
    axis = f"M{_EDGE} 8H{_GLYPH - _EDGE}"
    if rate.rate is None:
        return Glyph(axis, None, None)

    def x_of(share: float) -> float:
        return _EDGE + (_GLYPH - 2 * _EDGE) * share

    low, high = rate.interval
    return Glyph(axis, f"M{x_of(low):.1f} 8H{x_of(high):.1f}", x_of(rate.rate))


def difference_limit(intervals: Iterable[tuple[float, float]]) -> float:
    """Return the end of an axis on which all these intervals fit. The axis is symmetric around
    0.
    """
    largest = max((max(abs(low), abs(high)) for low, high in intervals), default=1.0)
    return next(limit for limit in _LIMITS if limit >= largest)


def difference_glyph(
    difference: float, interval: tuple[float, float], limit: float, *, decided: bool
) -> Glyph:
    """Return a difference of rates and its interval on an axis from -`limit` to `limit`, with a
    mark at 0.
    """
    middle = _GLYPH / 2

    def x_of(value: float) -> float:
        return middle + (middle - _EDGE) * value / limit

    low, high = interval
    axis = f"M{_EDGE} 8H{_GLYPH - _EDGE}M{middle:.1f} 2V14"
    return Glyph(axis, f"M{x_of(low):.1f} 8H{x_of(high):.1f}", x_of(difference), decided)


def difference_labels(limit: float) -> tuple[str, str, str]:
    """Return the labels of the axis from -`limit` to `limit` at its left end, its middle and its
    right end, in percentage points.
    """
    return f"{MINUS}{100 * limit:g}", "0", f"+{100 * limit:g}"


def ticks(low: float, high: float, intervals: int = 6) -> list[float]:
    """Return round numbers within [low, high] at equal distances, which divide the range into at
    most `intervals` intervals.
    """
    if high <= low:
        return [low]
    shortest = (high - low) / intervals
    magnitude = 10 ** math.floor(math.log10(shortest))
    # The tolerances keep the ticks at the ends, which rounding errors could remove.
    distances = (factor * magnitude for factor in (1, 2, 2.5, 5, 10))
    distance = next(value for value in distances if value >= shortest * (1 - 1e-9))
    first = math.ceil(low / distance - 1e-9)
    last = math.floor(high / distance + 1e-9)
    return [distance * step for step in range(first, last + 1)]


def short(value: float) -> str:
    """Return a number in the short form for an axis: 20000 -> "20k"."""
    for size, suffix in ((1e6, "M"), (1e3, "k")):
        if abs(value) >= size:
            return f"{value / size:g}{suffix}"
    return f"{value:g}"


def px(value: float) -> str:
    """Return a coordinate with at most two decimals."""
    return f"{value:.2f}".rstrip("0").rstrip(".")


def _path(points: Iterable[tuple[float, float]]) -> str:
    return "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in points)
