"""Which policy or checkpoint is better, on the episodes that both played; and what the clock costs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from vlagents_ray.evaluate.comparison import Comparison, Line, clock_gaps, comparable, comparisons
from vlagents_ray.evaluate.html.charts import difference_glyph
from vlagents_ray.evaluate.html.elements import Child, Html, Section, fold, row, section, table, tag
from vlagents_ray.evaluate.html.numbers import MINUS, NONE, count, p_value, points
from vlagents_ray.evaluate.statistics.pairs import ERROR_RATE
from vlagents_ray.evaluate.summary import Summary

MOST_PAIRS = 15  # shown unfolded: those of six contenders
MOST_REASONS = 10
_COUNTS = ["Episodes", "both", "only A", "only B", "neither"]
_HEAD = [*_COUNTS, f"A {MINUS} B, points", "95 % interval", "", "p", "p (Holm)"]


def comparison(summary: Summary) -> Section | None:
    """Every pair of contenders; with many, those with the best one first. None for a single contender."""
    if len(summary.results.contenders) < 2:
        return None
    which, reasons = comparable(summary.results)
    found = comparisons(summary.results, which)
    best = max(summary.totals, key=lambda group: group.success_once.rate or 0.0).contender
    if len(found) <= MOST_PAIRS:
        first, rest = found, []
    else:
        first = [one for one in found if best in (one.a, one.b)]
        rest = [one for one in found if best not in (one.a, one.b)]
    return section(
        "Comparison",
        _table(first) if first else None,
        tag(
            "p",
            "Pairs are episodes of the same task, settings and seed that both finished, by success once. p is of "
            "McNemar's exact test of “both solve equally many”; p (Holm) allows for the number of pairs compared. "
            "Intervals are of a bootstrap of the episodes, task by task. A hollow dot: not told apart at 5 %.",
            class_="note",
        ),
        fold("By suite", _table_by_suite(first), printed=True) if any(one.suites for one in first) else None,
        fold(count(len(rest), "further pair"), _table(rest)) if rest else None,
        _uncompared(reasons),
    )


def real_time(summary: Summary) -> Section | None:
    """The gap between a clock that runs on while the policy thinks and one that waits; None without such suites."""
    gaps = clock_gaps(summary.results)
    if not gaps:
        return None
    return section(
        "Gap to the synchronous score",
        _table(gaps),
        tag(
            "p",
            "A: the clock runs on while the policy thinks; B: it waits. Read as the comparison above.",
            class_="note",
        ),
    )


def _table(found: Sequence[Comparison]) -> Html:
    rows = [row(one.a, one.b, *_cells(one.total), words=2) for one in found]
    return table(["A", "B", *_HEAD], rows, "Comparison of pairs", words=2)


def _table_by_suite(found: Sequence[Comparison]) -> Html:
    bodies = [tag("tbody", list(_suites(one))) for one in found if one.suites]
    return table(["A", "B", "Suite", *_HEAD], bodies, "Comparison by suite", words=3)


def _suites(one: Comparison) -> Iterator[Html]:
    for index, line in enumerate(one.suites):
        names = [tag("th", name, scope="rowgroup", rowspan=len(one.suites)) for name in (one.a, one.b)]
        cells = [tag("td", cell, class_="n") for cell in _cells(line)]
        yield tag("tr", names if index == 0 else None, tag("th", line.suite or NONE, scope="row"), cells)


def _cells(line: Line) -> list[Child]:
    pairs, (low, high) = line.pairs, line.interval
    decided = line.adjusted < ERROR_RATE
    glyph = difference_glyph(pairs.difference or 0.0, low, high, decided)
    p = tag("strong", p_value(line.adjusted)) if decided else p_value(line.adjusted)
    return [
        pairs.total, pairs.both, pairs.only_a, pairs.only_b, pairs.neither, tag("strong", points(pairs.difference)),
        f"{points(low)} to {points(high)}", glyph, p_value(line.pairs.p_value), p,
    ]  # fmt: skip


def _uncompared(reasons: Sequence[str]) -> Html | None:
    if not reasons:
        return None
    items = [tag("li", reason) for reason in reasons[:MOST_REASONS]]
    return fold(f"Not compared: {count(len(reasons), 'pair')}", tag("ul", items), printed=True)
