"""Success rates and their differences, as sections of the page."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from vlagents_ray.evaluate.report.charts import RateChart, Series, rate_chart
from vlagents_ray.evaluate.results.changes import Change
from vlagents_ray.evaluate.results.comparison import Comparison, Line, comparable, comparisons
from vlagents_ray.evaluate.results.reader import CaseResults, Results, by_timing, rate_of
from vlagents_ray.evaluate.results.statistics import ERROR_RATE, Pairs, Rate
from vlagents_ray.evaluate.results.summary import TOTAL, Group, Summary, group_of, summarize

MOST_PAIRS = 15  # shown unfolded: those of six policy ids
# pairs, those of 40 policy ids; of more, such as a whole training's, only the main ones.
MOST_COMPARED = 780


@dataclass(frozen=True, slots=True)
class Block:
    """Rows of the table: one for each policy id."""

    name: str
    groups: list[Group]
    is_sum: bool = False  # of the tasks above it


@dataclass(frozen=True, slots=True)
class SuccessTable:
    """Each task, each suite if there are several, and all."""

    blocks: list[Block]
    several: bool  # policy ids
    stopped: int | None  # cases that stopped early; None: none could
    pooled: bool  # every policy has one rate for all its cases
    some_lost: bool  # infrastructure kept episodes from ending


@dataclass(frozen=True, slots=True)
class LearningCurve:
    """Success over the training step."""

    chart: RateChart
    # (policy, step, rate); no step: a policy without checkpoints.
    rows: list[tuple[str, float | None, Rate]]


def success_table(summary: Summary) -> SuccessTable:
    total = summary.total
    parts = [part for name in summary.results.contenders for part in summary.parts(name).values()]
    return SuccessTable(
        list(_blocks(summary)),
        len(summary.results.contenders) > 1,
        None if total.success_once.bounds is None else total.stopped,
        all(part.success_once.pooled for part in parts),
        total.infra_failures > 0,
    )


def learning_curves(summary: Summary) -> list[LearningCurve]:
    """Return success over the training steps of each policy with several; empty if none has."""
    return [
        curve
        for title, cases in _parts_with_a_rate(summary)
        if (curve := _learning_curve(title, cases))
    ]


def _blocks(summary: Summary) -> Iterator[Block]:
    """Yield tasks in the order of the plan, the sum of each suite after its tasks, and last the
    sum of all.
    """
    cases: dict[str, dict[str, list[Group]]] = {}
    order = {name: number for number, name in enumerate(summary.results.contenders)}

    def in_order(groups: list[Group]) -> list[Group]:
        return sorted(groups, key=lambda group: order[group.contender])

    for group in summary.cases:
        cases.setdefault(group.suite, {}).setdefault(group.env, []).append(group)
    for suite, envs in cases.items():
        for env, groups in envs.items():
            yield Block(" ".join(filter(None, (suite, env))), in_order(groups))
        if len(cases) > 1 and len(envs) > 1:
            of_suite = [case for case in summary.results.cases if case.suite == suite]
            yield Block(
                f"all of {suite or 'the nameless suite'}",
                in_order(_by_policy_id(of_suite, suite)),
                is_sum=True,
            )
    timings = by_timing(summary.results.cases)
    for timing, found in timings.items():
        suites = {case.suite for case in found}
        envs_of_one = {case.env for case in found} if len(suites) == 1 else set()
        if len(envs_of_one) == 1 or (envs_of_one and len(cases) > 1):
            continue  # it is above, as the only row, or as the sum of its suite
        name = "all" if len(timings) == 1 else f"all {timing}"
        yield Block(name, in_order(_by_policy_id(found, TOTAL)), is_sum=True)


def _by_policy_id(cases: Sequence[CaseResults], suite: str) -> list[Group]:
    found: dict[str, list[CaseResults]] = {}
    for case in cases:
        found.setdefault(case.contender, []).append(case)
    return [group_of((policy_id, suite, TOTAL), group) for policy_id, group in found.items()]


def _parts_with_a_rate(summary: Summary) -> Iterator[tuple[str, list[CaseResults]]]:
    """Yield the cases of each chart: all, and each suite; single tasks if a suite has no common
    rate.
    """
    timings = by_timing(summary.results.cases)
    for timing, cases in timings.items():
        suffix = "" if len(timings) == 1 else f", {timing}"
        suites: dict[str, list[CaseResults]] = {}
        for case in cases:
            suites.setdefault(case.suite, []).append(case)
        if _all_have_rates(cases):
            yield f"Success over training{suffix}", cases
        for suite, found in suites.items() if len(suites) > 1 or not _all_have_rates(cases) else ():
            name = suite or "the nameless suite"
            if _all_have_rates(found):
                yield f"{name}{suffix}", found
                continue
            for env in dict.fromkeys(case.env for case in found):
                yield f"{name} {env}{suffix}", [case for case in found if case.env == env]


def _all_have_rates(cases: Sequence[CaseResults]) -> bool:
    return all(group.success_once.pooled for group in _by_policy_id(cases, ""))


def _learning_curve(title: str, cases: Sequence[CaseResults]) -> LearningCurve | None:
    """Return a curve for each policy with several steps, a level line for each other; None if no
    policy has several.
    """
    by_policy: dict[str, dict[int, list[CaseResults]]] = {}
    without_steps: dict[str, list[CaseResults]] = {}
    for case in cases:
        if case.step is None:
            without_steps.setdefault(case.policy, []).append(case)
        else:
            by_policy.setdefault(case.policy, {}).setdefault(case.step, []).append(case)
    if not (swept := {policy: found for policy, found in by_policy.items() if len(found) > 1}):
        return None
    lines = [
        Series(
            policy,
            [(step, rate_of(group, "success_once")) for step, group in sorted(found.items())],
        )
        for policy, found in swept.items()
    ]
    first, last = (
        min(min(found) for found in swept.values()),
        max(max(found) for found in swept.values()),
    )
    levels = []
    for policy, group in without_steps.items():
        rate = rate_of(group, "success_once")
        levels.append(Series(f"{policy} (no steps)", [(first, rate), (last, rate)], level=True))
    rows: list[tuple[str, float | None, Rate]] = [
        (line.name, None, line.points[0][1]) for line in levels
    ]
    rows += [(line.name, step, rate) for line in lines for step, rate in line.points]
    pushed = all("pushed_weights" in case.settings for case in cases if case.step is not None)
    of_axis = "version of the weights" if pushed else "training step"
    return LearningCurve(rate_chart([*lines, *levels], of_axis, title), rows)


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


@dataclass(frozen=True, slots=True)
class ComparisonPart:
    """The comparisons of the episodes with one timing."""

    timing: str
    shown: list[Difference]
    by_suite: list[list[Difference]]  # of those shown, each with its suites
    folded: list[Difference]


@dataclass(frozen=True, slots=True)
class Comparisons:
    """The pairs of policy ids, the main ones first."""

    parts: list[ComparisonPart]
    left_out: int  # pairs beyond the main ones, if there are very many
    several_timings: bool
    reasons: list[str]  # reasons why other pairs are not compared
    changes: list[Change]  # accepted differences between environments of compared policies


@dataclass(frozen=True, slots=True)
class Family:
    """The comparisons of the episodes with one timing, whose p-values are adjusted for one
    another.
    """

    timing: str
    comparisons: list[Comparison]  # the main ones first
    main: int  # the number of these
    # Pairs beyond the main ones, if there are very many; their number is in the adjustment.
    left_out: int
    reasons: list[str]  # reasons why other pairs are not compared


def families(summary: Summary, *, accept_changes: bool = False) -> list[Family]:
    """Compare all policy ids, apart for each timing; of very many pairs only the main ones."""
    found = []
    for timing, cases in by_timing(summary.results.cases).items():
        results = summary.results.among(cases)
        of_timing = summarize(results)
        every = list(itertools.combinations(results.contenders, 2))
        wanted = every if len(every) <= MOST_COMPARED else _asked_first(of_timing, every)
        pairs, reasons = comparable(results, wanted, accept_changes=accept_changes)
        asked = _asked_first(of_timing, pairs)
        ordered = [*asked, *(pair for pair in _later_first(results, pairs) if pair not in asked)]
        # Whether a pair is the main one depends on the rates, so the adjustment is for all that
        # could have been.
        chosen_of = None if len(wanted) == len(every) else len(every)
        compared = comparisons(results, ordered, chosen_of=chosen_of, accept_changes=accept_changes)
        found.append(Family(timing, compared, len(asked), len(every) - len(wanted), reasons))
    return found


def families_json(summary: Summary, *, accept_changes: bool = False) -> list[dict[str, Any]]:
    """Return the comparisons of the page for JSON, each with its timing."""
    found = families(summary, accept_changes=accept_changes)
    return [
        one.to_json() | {"timing": family.timing} for family in found for one in family.comparisons
    ]


def compare_all(summary: Summary, *, accept_changes: bool = False) -> Comparisons | None:
    """Return all comparisons; None for a single policy id."""
    if len(summary.results.contenders) < 2:
        return None
    parts: list[ComparisonPart] = []
    found = families(summary, accept_changes=accept_changes)
    for family in found:
        shown, folded = family.comparisons, family.comparisons[:0]
        if len(shown) > MOST_PAIRS:
            shown, folded = shown[: family.main], shown[family.main :]
        by_suite = [[_difference(one, line) for line in one.suites] for one in shown if one.suites]
        parts.append(ComparisonPart(family.timing, totals(shown), by_suite, totals(folded)))
    changes = [change for family in found for one in family.comparisons for change in one.changes]
    return Comparisons(
        parts,
        sum(family.left_out for family in found),
        len(found) > 1,
        [reason for family in found for reason in family.reasons],
        list(dict.fromkeys(changes)),
    )


def totals(found: Sequence[Comparison]) -> list[Difference]:
    return [_difference(one, one.total) for one in found]


def _difference(one: Comparison, line: Line) -> Difference:
    decided = line.adjusted < ERROR_RATE
    return Difference(one.a, one.b, line.suite, line.pairs, line.interval, line.adjusted, decided)


def _asked_first(summary: Summary, pairs: Sequence[tuple[str, str]]) -> list[tuple[str, str]]:
    """Return each checkpoint with the one before it, and the best of all with the best of each
    other policy.
    """
    cases = {case.contender: (case.policy, case.step) for case in summary.results.cases}
    known = dict.fromkeys(_later_first(summary.results, pairs))
    asked = [
        (b, a)
        for a, b in itertools.pairwise(summary.results.contenders)
        if cases[a][0] == cases[b][0] and cases[a][1] is not None
    ]  # the checkpoints of a policy are in the order of their steps
    leaders: dict[str, str] = {}
    for name in summary.best:
        leaders.setdefault(cases[name][0], name)
    best = summary.best[0]
    asked += [
        pair for pair in known if best in pair and all(one in leaders.values() for one in pair)
    ]
    return [pair for pair in dict.fromkeys(asked) if pair in known]


def _later_first(results: Results, pairs: Sequence[tuple[str, str]]) -> list[tuple[str, str]]:
    """Return the pairs with the later checkpoint as A, so that progress is a gain."""
    order = {name: number for number, name in enumerate(results.contenders)}
    return [(a, b) if order[a] > order[b] else (b, a) for a, b in pairs]
