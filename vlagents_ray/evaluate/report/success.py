"""The sections of the page with success rates and their differences."""

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

MOST_PAIRS = 15  # maximum number of pairs that are shown unfolded: all pairs of six policy ids
# Maximum number of pairs that are all compared: all pairs of 40 policy ids. If there are more
# pairs, e.g. for the checkpoints of a whole training, only the main pairs are compared.
MOST_COMPARED = 780


@dataclass(frozen=True, slots=True)
class Block:
    """A block of rows in the table, one row for each policy id."""

    name: str
    groups: list[Group]
    is_sum: bool = False  # whether the block is the sum of the tasks above it


@dataclass(frozen=True, slots=True)
class SuccessTable:
    """Success rates for each task, for each suite if there are several, and for all tasks."""

    blocks: list[Block]
    several: bool  # whether there are several policy ids
    # The reasons why the intervals are confidence sequences; empty if they are Wilson's.
    sequence: list[str]
    repeats: bool  # whether some episodes begin in the same initial state
    pooled: bool  # whether every policy has a common rate for all its cases
    some_lost: bool  # whether episodes were lost to infrastructure


@dataclass(frozen=True, slots=True)
class LearningCurve:
    """Success rates against training steps."""

    chart: RateChart
    # (policy, step, rate); the step is None for a policy without checkpoints.
    rows: list[tuple[str, float | None, Rate]]


def success_table(summary: Summary) -> SuccessTable:
    """Return the table of success rates, with the values for the note below the table."""
    total = summary.total
    return SuccessTable(
        list(_blocks(summary)),
        several=len(summary.results.policy_ids) > 1,
        sequence=summary.reasons_of_sequence,
        repeats=any(group.success_once.independent is not None for group in summary.cases),
        pooled=summary.has_one_rate_each,
        some_lost=total.infra_failures > 0,
    )


def learning_curves(summary: Summary) -> list[LearningCurve]:
    """Return success rates against training steps, for each policy with several steps; empty if no
    policy has several steps.
    """
    curves = [_learning_curve(title, cases) for title, cases in _parts_with_a_rate(summary)]
    return [curve for curve in curves if curve is not None]


def _blocks(summary: Summary) -> Iterator[Block]:
    """Yield a block for each task, in the order of the plan, a block with the sum of each suite
    after its tasks, and finally a block with the sum of all tasks.
    """
    order = {name: number for number, name in enumerate(summary.results.policy_ids)}

    def in_order(groups: list[Group]) -> list[Group]:
        return sorted(groups, key=lambda group: order[group.policy_id])

    suites: dict[str, dict[str, list[Group]]] = {}  # groups of cases by suite and env
    for group in summary.cases:
        suites.setdefault(group.suite, {}).setdefault(group.env, []).append(group)

    for suite, envs in suites.items():
        for env, groups in envs.items():
            yield Block(" ".join(filter(None, (suite, env))), in_order(groups))
        if len(suites) > 1 and len(envs) > 1:
            cases_of_suite = [case for case in summary.results.cases if case.suite == suite]
            name = f"all of {suite or 'the nameless suite'}"
            yield Block(name, in_order(_by_policy_id(cases_of_suite, suite)), is_sum=True)

    timings = by_timing(summary.results.cases)
    for timing, cases in timings.items():
        is_one_suite = len({case.suite for case in cases}) == 1
        is_one_task = is_one_suite and len({case.env for case in cases}) == 1
        if is_one_task or (is_one_suite and len(suites) > 1):
            # The sum would repeat the block of the only task, or the sum of the only suite.
            continue
        name = "all" if len(timings) == 1 else f"all {timing}"
        yield Block(name, in_order(_by_policy_id(cases, TOTAL)), is_sum=True)


def _by_policy_id(cases: Sequence[CaseResults], suite: str) -> list[Group]:
    """Return the sum of the cases of each policy id."""
    by_policy_id: dict[str, list[CaseResults]] = {}
    for case in cases:
        by_policy_id.setdefault(case.policy_id, []).append(case)
    return [group_of((name, suite, TOTAL), members) for name, members in by_policy_id.items()]


def _parts_with_a_rate(summary: Summary) -> Iterator[tuple[str, list[CaseResults]]]:
    """Yield the title and the cases of each chart: all cases, then the cases of each suite; for a
    suite without a common rate, the cases of each task.
    """
    timings = by_timing(summary.results.cases)
    for timing, cases in timings.items():
        suffix = "" if len(timings) == 1 else f", {timing}"
        suites: dict[str, list[CaseResults]] = {}
        for case in cases:
            suites.setdefault(case.suite, []).append(case)

        have_rates = _all_have_rates(cases)
        if have_rates:
            yield f"Success over training{suffix}", cases
            if len(suites) == 1:
                continue  # the chart of the suite would be the same

        for suite, members in suites.items():
            name = suite or "the nameless suite"
            if _all_have_rates(members):
                yield f"{name}{suffix}", members
                continue
            for env in dict.fromkeys(case.env for case in members):
                yield f"{name} {env}{suffix}", [case for case in members if case.env == env]


def _all_have_rates(cases: Sequence[CaseResults]) -> bool:
    """Return whether each policy id has a common rate over these cases."""
    return all(group.success_once.pooled for group in _by_policy_id(cases, ""))


def _learning_curve(title: str, cases: Sequence[CaseResults]) -> LearningCurve | None:
    """Return a curve for each policy with several steps and a level line for each other policy;
    None if no policy has several steps.
    """
    by_policy: dict[str, dict[int, list[CaseResults]]] = {}
    without_steps: dict[str, list[CaseResults]] = {}
    for case in cases:
        if case.step is None:
            without_steps.setdefault(case.policy, []).append(case)
        else:
            by_policy.setdefault(case.policy, {}).setdefault(case.step, []).append(case)
    swept = {policy: steps for policy, steps in by_policy.items() if len(steps) > 1}
    if not swept:
        return None

    curves = []
    curve_rows: list[tuple[str, float | None, Rate]] = []
    all_steps: set[int] = set()
    for policy, steps in swept.items():
        all_steps |= steps.keys()
        points = [(step, rate_of(steps[step], "success_once")) for step in sorted(steps)]
        curves.append(Series(policy, points))
        curve_rows += [(policy, step, rate) for step, rate in points]

    levels = []
    level_rows: list[tuple[str, float | None, Rate]] = []
    first, last = min(all_steps), max(all_steps)
    for policy, members in without_steps.items():
        name = f"{policy} (no steps)"
        rate = rate_of(members, "success_once")
        levels.append(Series(name, [(first, rate), (last, rate)], level=True))
        level_rows.append((name, None, rate))

    is_pushed = all(case.settings.get("pushed_weights") for case in cases if case.step is not None)
    x_label = "version of the weights" if is_pushed else "training step"
    chart = rate_chart([*curves, *levels], x_label, title)
    return LearningCurve(chart, level_rows + curve_rows)


@dataclass(frozen=True, slots=True)
class Difference:
    """A row of the table: the success rate of A minus the success rate of B."""

    a: str
    b: str
    suite: str
    pairs: Pairs
    interval: tuple[float, float]  # 95 % interval
    p_value: float
    adjusted: float  # p-value
    decided: bool
    lost: int  # number of further pairs with an episode that infrastructure lost


@dataclass(frozen=True, slots=True)
class ComparisonPart:
    """The comparisons of the episodes with the same timing."""

    timing: str
    shown: list[Difference]
    by_suite: list[list[Difference]]  # lines by suite of each shown comparison with several suites
    folded: list[Difference]


@dataclass(frozen=True, slots=True)
class Comparisons:
    """The comparisons of all pairs of policy ids, the main pairs first."""

    parts: list[ComparisonPart]
    left_out: int  # number of further pairs that are not compared, if there are very many pairs
    several_timings: bool
    lost: int  # largest number of pairs of a comparison with a lost episode
    reasons: list[str]  # reasons why some pairs cannot be compared
    changes: list[Change]  # accepted differences between environments of compared policies


@dataclass(frozen=True, slots=True)
class Family:
    """The comparisons of the episodes with the same timing; their p-values are adjusted for the
    number of comparisons.
    """

    timing: str
    comparisons: list[Comparison]  # comparisons; those of the main pairs are first
    main: int  # number of main pairs
    # Number of further pairs that are not compared, if there are very many pairs. The adjustment of
    # the p-values includes this number.
    left_out: int
    reasons: list[str]  # reasons why other pairs are not compared


def families(summary: Summary, *, accept_changes: bool = False) -> list[Family]:
    """Compare all pairs of policy ids, separately for each timing; if there are very many pairs,
    compare only the main pairs.
    """
    members = []
    for timing, cases in by_timing(summary.results.cases).items():
        results = summary.results.among(cases)
        of_timing = summarize(results)
        all_pairs = list(itertools.combinations(results.policy_ids, 2))
        candidates = all_pairs
        chosen_of = None
        if len(all_pairs) > MOST_COMPARED:
            candidates = _main_pairs(of_timing, all_pairs)
            # The main pairs are selected by the rates, so the adjustment must include all pairs
            # that could have been selected.
            if len(candidates) < len(all_pairs):
                chosen_of = len(all_pairs)

        pairs, reasons = comparable(results, candidates, accept_changes=accept_changes)
        main = _main_pairs(of_timing, pairs)
        further = [pair for pair in _later_first(results, pairs) if pair not in main]
        compared = comparisons(
            results, main + further, chosen_of=chosen_of, accept_changes=accept_changes
        )
        left_out = len(all_pairs) - len(candidates)
        members.append(Family(timing, compared, len(main), left_out, reasons))
    return members


def families_json(summary: Summary, *, accept_changes: bool = False) -> list[dict[str, Any]]:
    """Return the comparisons of the page for JSON, each with its timing."""
    entries = []
    for family in families(summary, accept_changes=accept_changes):
        for comparison in family.comparisons:
            entries.append(comparison.to_json() | {"timing": family.timing})
    return entries


def compare_all(summary: Summary, *, accept_changes: bool = False) -> Comparisons | None:
    """Return the view of all comparisons; None for a single policy id."""
    if len(summary.results.policy_ids) < 2:
        return None
    parts: list[ComparisonPart] = []
    reasons: list[str] = []
    changes: list[Change] = []
    left_out = 0
    for family in families(summary, accept_changes=accept_changes):
        shown, folded = family.comparisons, family.comparisons[:0]
        if len(shown) > MOST_PAIRS:
            shown, folded = shown[: family.main], shown[family.main :]
        by_suite = []
        for comparison in shown:
            if comparison.suites:
                by_suite.append([_difference(comparison, line) for line in comparison.suites])
        parts.append(ComparisonPart(family.timing, totals(shown), by_suite, totals(folded)))

        reasons += family.reasons
        left_out += family.left_out
        for comparison in family.comparisons:
            changes += comparison.changes

    return Comparisons(
        parts,
        left_out,
        several_timings=len(parts) > 1,
        lost=max((row.lost for part in parts for row in part.shown + part.folded), default=0),
        reasons=reasons,
        changes=list(dict.fromkeys(changes)),
    )


def totals(comparisons: Sequence[Comparison]) -> list[Difference]:
    """Return the total of each comparison, as a row of a table."""
    return [_difference(comparison, comparison.total) for comparison in comparisons]


def _difference(comparison: Comparison, line: Line) -> Difference:
    return Difference(
        comparison.a,
        comparison.b,
        line.suite,
        line.pairs,
        line.interval,
        line.p_value,
        line.adjusted,
        decided=line.adjusted < ERROR_RATE,
        lost=line.lost,
    )


def _main_pairs(summary: Summary, pairs: Sequence[tuple[str, str]]) -> list[tuple[str, str]]:
    """Return the main pairs among `pairs`: each checkpoint with the previous checkpoint, and the
    best policy id with the best policy id of each other policy.
    """
    policies: dict[str, str] = {}  # keys: policy ids
    steps: dict[str, int | None] = {}
    for case in summary.results.cases:
        policies[case.policy_id] = case.policy
        steps[case.policy_id] = case.step

    main = []
    # The policy ids of a policy are in the order of their steps.
    for earlier, later in itertools.pairwise(summary.results.policy_ids):
        if policies[earlier] == policies[later] and steps[earlier] is not None:
            main.append((later, earlier))

    best_of_policy: dict[str, str] = {}
    for name in summary.best:
        best_of_policy.setdefault(policies[name], name)
    best = summary.best[0]
    leaders = set(best_of_policy.values())
    available = dict.fromkeys(_later_first(summary.results, pairs))
    main += [pair for pair in available if best in pair and leaders.issuperset(pair)]
    return [pair for pair in dict.fromkeys(main) if pair in available]


def _later_first(results: Results, pairs: Sequence[tuple[str, str]]) -> list[tuple[str, str]]:
    """Return the pairs with the later checkpoint as A, so that progress is positive."""
    order = {name: number for number, name in enumerate(results.policy_ids)}
    return [(a, b) if order[a] > order[b] else (b, a) for a, b in pairs]
