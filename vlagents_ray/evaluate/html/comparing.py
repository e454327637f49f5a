"""Which policy or checkpoint is better, on the episodes that both played; and what the clock costs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from vlagents_ray.evaluate.comparison import ALL, Comparison, Line, clock_gaps, comparable, comparisons
from vlagents_ray.evaluate.html.charts import difference_glyph
from vlagents_ray.evaluate.html.elements import Child, Html, Section, fold, row, section, table, tag
from vlagents_ray.evaluate.html.numbers import MINUS, NONE, p_value, points
from vlagents_ray.evaluate.statistics.pairs import ERROR_RATE
from vlagents_ray.evaluate.summary import Summary

MOST_PAIRS = 15  # shown unfolded: those of six contenders
MOST_REASONS = 10
_HEAD = [
    "Episodes",
    "both solved",
    "only A",
    "only B",
    "neither",
    f"A {MINUS} B, points",
    "95 % interval",
    "",
    "p",
    "p (Holm)",
]


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
            "McNemar's exact test of “both solve equally many”, (Holm) adjusted for the number of comparisons on "
            "the page; intervals are of a bootstrap of the pairs, task by task. A hollow dot: not told apart at 5 %.",
            class_="note",
        ),
        fold(f"{len(rest)} further pairs", _table(rest)) if rest else None,
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
    return table(["A", "B", "Suite", *_HEAD], (tag("tbody", list(_rows(one))) for one in found), "Comparison", words=3)


def _rows(one: Comparison) -> Iterator[Html]:
    for line in (*one.suites, one.total):
        sum_of = line.suite == ALL and bool(one.suites)
        yield row(one.a, one.b, line.suite or NONE, *_cells(line), words=3, class_="sum" if sum_of else None)


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
    return fold(f"{len(reasons)} pairs cannot be compared", tag("ul", items), printed=True)
