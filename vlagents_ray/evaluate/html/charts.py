"""Charts as SVG, drawn for a column of a page: a reader's eyes and a screen reader get the same.

Colours are the stylesheet's (classes c0 … c5), so that light, dark and paper have their own. Lines differ in
their dashes too, for those who cannot tell the colours apart.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

from vlagents_ray.evaluate.html.elements import Child, Html, tag
from vlagents_ray.evaluate.html.numbers import interval, number, percent
from vlagents_ray.evaluate.statistics import Rate

COLOURS = 6
WIDTH, HEIGHT = 460, 280
LEFT, RIGHT, TOP, BOTTOM = 38, 10, 10, 40  # margins
GLYPH, EDGE = 96, 6  # width of a table's interval, and what a dot takes beyond its ends
_DASHES = (None, "7 3", "2 3", "9 3 2 3", "12 4", "4 4")


@dataclass(frozen=True, slots=True)
class Series:
    """A line: rates with their intervals, over whatever stands on the x axis."""

    name: str
    colour: int  # its place among the lines
    points: Sequence[tuple[float, Rate]]  # by x
    stepped: bool = False  # constant up to the next point, rather than a way there


def rate_chart(series: Sequence[Series], x_label: str, title: str) -> Html:
    """Rates in per cent over `x_label`, each with its band, and a legend."""
    most = max((x for one in series for x, _ in one.points), default=0.0)
    least = min((x for one in series for x, _ in one.points), default=0.0)
    left, right = (least - 1, most + 1) if least == most else (least, most)

    def x_of(x: float) -> float:
        return LEFT + (WIDTH - LEFT - RIGHT) * (x - left) / (right - left)

    shapes: list[Child] = [list(_grid(x_label, [(x_of(tick), tick) for tick in ticks(left, right)]))]
    for one in series:
        known = [(x, rate) for x, rate in one.points if rate.rate is not None]
        placed = [(x_of(x), rate) for x, rate in known]
        if placed:
            shapes += [_band(one, placed), _line(one, placed)]
        if not one.stepped:
            shapes.append([_dot(one, x, x_of(x), rate) for x, rate in known])
    drawn = tag("svg", tag("title", title), shapes, viewbox=f"0 0 {WIDTH} {HEIGHT}", role="img", class_="chart")
    return tag("figure", tag("figcaption", title), legend([(one.name, one.colour) for one in series]), drawn)


def interval_glyph(rate: Rate) -> Html:
    """The rate and its interval as a dot on a line from 0 to 100 %; decoration, as the numbers stand beside it."""
    low, high = (EDGE + (GLYPH - 2 * EDGE) * bound for bound in rate.interval)
    shapes = [tag("path", d=f"M{EDGE} 8H{GLYPH - EDGE}", class_="rail")]
    if rate.rate is not None:
        shapes.append(tag("path", d=f"M{low:.1f} 8H{high:.1f}", class_="range"))
        shapes.append(tag("circle", cx=EDGE + (GLYPH - 2 * EDGE) * rate.rate, cy=8, r=3.5, class_="dot"))
    return tag("svg", shapes, viewbox=f"0 0 {GLYPH} 16", class_="glyph", aria_hidden="true")


def difference_glyph(difference: float, low: float, high: float, decided: bool) -> Html:
    """A difference of rates and its interval on a line from -100 to 100 points."""
    middle = GLYPH / 2
    left, dot, right = (middle + (middle - EDGE) * value for value in (low, difference, high))
    shapes = [
        tag("path", d=f"M{EDGE} 8H{GLYPH - EDGE}M{middle:.1f} 2V14", class_="rail"),
        tag("path", d=f"M{left:.1f} 8H{right:.1f}", class_="range"),
        tag("circle", cx=dot, cy=8, r=3.5, class_="dot"),
    ]
    class_ = "glyph" if decided else "glyph undecided"
    return tag("svg", shapes, viewbox=f"0 0 {GLYPH} 16", class_=class_, aria_hidden="true")


def stacked_bars(rows: Mapping[str, Mapping[str, float]], unit: str, title: str) -> Html:
    """A bar each row, made of its parts; all on one scale. There is a row at least."""
    names = list(dict.fromkeys(part for parts in rows.values() for part in parts))
    longest = max(sum(parts.values()) for parts in rows.values())
    scale = (WIDTH - 74) / longest if longest else 0.0
    shapes = []
    for index, (name, parts) in enumerate(rows.items()):
        top, left = 40 * index, 0.0
        shapes.append(tag("text", name, x=0, y=top + 12, class_="label"))
        for part, value in parts.items():
            width, colour = value * scale, names.index(part) % COLOURS
            hint = tag("title", f"{part}: {number(value, 2)} {unit}")
            shapes.append(tag("rect", hint, x=left, y=top + 18, width=width, height=14, class_=f"fill c{colour}"))
            left += width
        shapes.append(tag("text", f"{number(sum(parts.values()), 2)} {unit}", x=left + 6, y=top + 29))
    drawn = tag("svg", tag("title", title), shapes, viewbox=f"0 0 {WIDTH} {40 * len(rows)}", role="img", class_="chart")
    keys = legend([(name, index % COLOURS) for index, name in enumerate(names)], filled=True)
    return tag("figure", tag("figcaption", title), keys, drawn)


def legend(names: Iterable[tuple[str, int]], *, filled: bool = False) -> Html:
    """What each colour stands for."""
    return tag("ul", [tag("li", _swatch(colour, filled), name) for name, colour in names], class_="legend")


def ticks(low: float, high: float, most: int = 6) -> list[float]:
    """Round numbers within [low, high], at most `most` or one more, at equal distances."""
    if high <= low:
        return [low]
    rough = (high - low) / most
    magnitude = 10 ** math.floor(math.log10(rough))
    distance = next(factor * magnitude for factor in (1, 2, 2.5, 5, 10) if factor * magnitude >= rough * (1 - 1e-9))
    first, last = math.ceil(low / distance - 1e-9), math.floor(high / distance + 1e-9)
    return [distance * step for step in range(first, last + 1)]


def short(value: float) -> str:
    """A number for an axis: 20000 -> "20k"."""
    for size, suffix in ((1e6, "M"), (1e3, "k")):
        if abs(value) >= size:
            return f"{value / size:g}{suffix}"
    return f"{value:g}"


def _grid(x_label: str, x_ticks: Sequence[tuple[float, float]]) -> Iterator[Html]:
    bottom = HEIGHT - BOTTOM
    for share in (0.0, 0.25, 0.5, 0.75, 1.0):
        y = _y(share)
        yield tag("path", d=f"M{LEFT} {y:.1f}H{WIDTH - RIGHT}", class_="rail")
        yield tag("text", f"{100 * share:.0f}", x=LEFT - 6, y=y + 4, text_anchor="end")
    for x, tick in x_ticks:
        yield tag("path", d=f"M{x:.1f} {bottom}v4", class_="rail")
        yield tag("text", short(tick), x=x, y=bottom + 17, text_anchor="middle")
    yield tag("text", x_label, x=WIDTH - RIGHT, y=HEIGHT - 6, text_anchor="end", class_="axis")
    yield tag("text", "success in %", x=LEFT, y=HEIGHT - 6, class_="axis")


def _y(share: float) -> float:
    return TOP + (HEIGHT - TOP - BOTTOM) * (1 - share)


def _stairs(points: Sequence[tuple[float, float]], stepped: bool) -> list[tuple[float, float]]:
    """The corners of a line through `points`."""
    if not stepped:
        return list(points)
    corners = [corner for (_, y), (x, then) in pairwise(points) for corner in ((x, y), (x, then))]
    return [*points[:1], *corners]


def _path(points: Iterable[tuple[float, float]]) -> str:
    return "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in points)


def _band(one: Series, placed: Sequence[tuple[float, Rate]]) -> Html:
    low = _stairs([(x, _y(rate.interval[0])) for x, rate in placed], one.stepped)
    high = _stairs([(x, _y(rate.interval[1])) for x, rate in placed], one.stepped)
    return tag("path", d=f"{_path([*low, *reversed(high)])}Z", class_=f"band c{one.colour % COLOURS}")


def _line(one: Series, placed: Sequence[tuple[float, Rate]]) -> Html:
    points = _stairs([(x, _y(rate.rate or 0.0)) for x, rate in placed], one.stepped)
    dashes = _DASHES[one.colour % len(_DASHES)]
    return tag("path", d=_path(points), class_=f"line c{one.colour % COLOURS}", stroke_dasharray=dashes)


def _dot(one: Series, value: float, x: float, rate: Rate) -> Html:
    hint = tag("title", f"{one.name}, {short(value)}: {percent(rate)} % ({interval(rate)})")
    return tag("circle", hint, cx=x, cy=_y(rate.rate or 0.0), r=3.5, class_=f"fill c{one.colour % COLOURS}")


def _swatch(colour: int, filled: bool) -> Html:
    if filled:
        shape = tag("rect", x=0, y=2, width=12, height=12, rx=2, class_=f"fill c{colour % COLOURS}")
        return tag("svg", shape, viewbox="0 0 12 16", class_="swatch", aria_hidden="true")
    dashes = _DASHES[colour % len(_DASHES)]
    shape = tag("path", d="M0 8H28", class_=f"line c{colour % COLOURS}", stroke_dasharray=dashes)
    return tag("svg", shape, viewbox="0 0 28 16", class_="swatch", aria_hidden="true")
