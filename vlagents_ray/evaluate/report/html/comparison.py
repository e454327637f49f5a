"""Which policy or checkpoint is better on the episodes that both played, and what a running clock costs."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

from vlagents_ray.evaluate.report.html.charts import Glyph, difference_glyph
from vlagents_ray.evaluate.results.comparison import Comparison, Line, clock_gaps, comparable, comparisons
from vlagents_ray.evaluate.results.reader import Results, by_timing
from vlagents_ray.evaluate.results.statistics import Pairs
from vlagents_ray.evaluate.results.statistics.pairs import ERROR_RATE
from vlagents_ray.evaluate.results.summary import Summary

MOST_PAIRS = 15  # shown unfolded: those of six policy ids
MOST_COMPARED = 780  # pairs, those of 40 policy ids; of more, as of a whole training's, only those asked for most


@dataclass(frozen=True, slots=True)
class Difference:
    """A row of the table: success rate of A less that of B."""

    a: str
    b: str
    suite: str
    pairs: Pairs
    interval: tuple[float, float]  # 95 %
    adjusted: float  # p-value
    decided: bool
    glyph: Glyph


@dataclass(frozen=True, slots=True)
class ComparisonPart:
    """The comparisons of the episodes with one timing."""

    timing: str
    shown: list[Difference]
    by_suite: list[list[Difference]]  # of those shown, each with its suites
    folded: list[Difference]


@dataclass(frozen=True, slots=True)
class Comparisons:
    """The pairs of policy ids, the ones that are asked for most first."""

    parts: list[ComparisonPart]
    left_out: int  # pairs beyond those asked for most, where there are very many
    several_timings: bool
    reasons: list[str]  # why other pairs are not compared


def compare_all(summary: Summary) -> Comparisons | None:
    """All comparisons; None for a single policy id."""
    if len(summary.results.contenders) < 2:
        return None
    reasons: list[str] = []
    parts, left_out = [], 0
    timings = by_timing(summary.results.cells)
    for timing, cells in timings.items():
        results = summary.results.among(cells)
        every = list(itertools.combinations(results.contenders, 2))
        wanted = every if len(every) <= MOST_COMPARED else _asked_first(summary, every)
        left_out += len(every) - len(wanted)
        pairs, why = comparable(results, wanted)
        reasons += why
        asked = _asked_first(summary, pairs)
        found = comparisons(results, [*asked, *(one for one in _later_first(results, pairs) if one not in asked)])
        shown, folded = (found, []) if len(found) <= MOST_PAIRS else (found[: len(asked)], found[len(asked) :])
        by_suite = [[_difference(one, line) for line in one.suites] for one in shown if one.suites]
        parts.append(ComparisonPart(timing, _totals(shown), by_suite, _totals(folded)))
    return Comparisons(parts, left_out, len(timings) > 1, reasons)


def real_time_gaps(summary: Summary) -> list[Difference]:
    """A clock that runs on while the policy thinks (A) against one that waits (B); empty without such suites."""
    return _totals(clock_gaps(summary.results))


def _totals(found: Sequence[Comparison]) -> list[Difference]:
    return [_difference(one, one.total) for one in found]


def _difference(one: Comparison, line: Line) -> Difference:
    decided, (low, high) = line.adjusted < ERROR_RATE, line.interval
    glyph = difference_glyph(line.pairs.difference or 0.0, low, high, decided=decided)
    return Difference(one.a, one.b, line.suite, line.pairs, (low, high), line.adjusted, decided, glyph)


def _asked_first(summary: Summary, pairs: Sequence[tuple[str, str]]) -> list[tuple[str, str]]:
    """Each checkpoint against the one before it, and of the policies' best ones the best against the others."""
    cells = {cell.contender: (cell.policy, cell.step) for cell in summary.results.cells}
    known = dict.fromkeys(_later_first(summary.results, pairs))
    asked = [
        (b, a)
        for a, b in itertools.pairwise(summary.results.contenders)
        if cells[a][0] == cells[b][0] and cells[a][1] is not None
    ]  # the checkpoints of a policy are in the order of their steps
    leaders: dict[str, str] = {}
    for name in summary.best:
        leaders.setdefault(cells[name][0], name)
    best = summary.best[0]
    asked += [pair for pair in known if best in pair and all(one in leaders.values() for one in pair)]
    return [pair for pair in dict.fromkeys(asked) if pair in known]


def _later_first(results: Results, pairs: Sequence[tuple[str, str]]) -> list[tuple[str, str]]:
    """The pairs with the later checkpoint as A, so that what training brought is a gain."""
    order = {name: number for number, name in enumerate(results.contenders)}
    return [(a, b) if order[a] > order[b] else (b, a) for a, b in pairs]
