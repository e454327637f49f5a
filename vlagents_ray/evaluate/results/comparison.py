"""Paired comparison of two policies, and of one policy in real time with its synchronous
counterpart.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate.results.changes import (
    Change,
    EnvStatement,
    env_changes,
    listed,
    program_changes,
)
from vlagents_ray.evaluate.results.reader import CaseResults, Results, by_timing, synchronous_twin
from vlagents_ray.evaluate.results.statistics import Pairs, difference_interval, holm
from vlagents_ray.naming import did_you_mean

# The policy's settings among a case's, in which compared cases may differ. All others are the
# env's.
OF_POLICY = frozenset(
    {
        "policy",
        "policy_config",
        "policy_options",
        "checkpoint",
        "pushed_weights",
        "execute",
        "codec",
    }
)
ALL = "all"

Strata = dict[str, Pairs]  # by env


@dataclass(frozen=True, slots=True)
class Line:
    """The comparison on one suite, or on all suites together."""

    suite: str  # or "all"
    strata: tuple[Pairs, ...]  # by env
    # McNemar's p-value, adjusted by Holm's method for all comparisons of its family.
    adjusted: float

    @property
    def pairs(self) -> Pairs:
        """The episodes of all envs together."""
        return sum(self.strata, Pairs())

    @property
    def interval(self) -> tuple[float, float]:
        """(low, high), the 95 % interval of the success rate of A minus that of B
        (`difference_interval`).
        """
        return difference_interval(self.strata)

    def to_json(self) -> dict[str, Any]:
        """Return the fields for JSON."""
        beside = {"interval_95": list(self.interval), "p_holm": self.adjusted}
        return {"suite": self.suite} | self.pairs.to_json() | beside


@dataclass(frozen=True, slots=True)
class Comparison:
    """Policy id A against policy id B ("NAME", or "NAME@STEP" in a sweep) on the episodes that
    both finished.
    """

    a: str
    b: str
    # One for each suite, in the order of the plan; empty if they share only one.
    suites: tuple[Line, ...]
    total: Line
    cases: tuple[CaseResults, ...] = ()  # of `clock_gaps`: the cases in real time
    changes: tuple[Change, ...] = ()  # accepted differences between the two environments

    def to_json(self) -> dict[str, Any]:
        """Return the fields for JSON; `lines` has one entry for each suite, and the total last."""
        lines = [line.to_json() for line in (*self.suites, self.total)]
        return {
            "a": self.a,
            "b": self.b,
            "lines": lines,
            "accepted_changes": [asdict(one) for one in self.changes],
        }


def compare(
    results: Results, a: str, b: str, *, timing: str | None = None, accept_changes: bool = False
) -> Comparison:
    """Compare two policies on the episodes that both finished: same suite, env, settings of the
    env, number and seed.

    Args:
        results: Results that hold both.
        a: A policy id: the policy's name, with "@STEP" in a sweep over checkpoints; one of
            `results.contenders`.
        b: The other policy id.
        timing: "synchronous" or "in real time", for results that have episodes of both, which are
            never pooled.
        accept_changes: Compare although files, description or contract of an env differ, or one of
            the two was played with several versions of its files or weights.

    Returns:
        The comparison by suite and in total, by success once.

    Raises:
        ConfigError: One of the policy ids is unknown, they share no finished episode, an env of a
            suite had different settings for the two, something changed and `accept_changes` is off,
            or they share episodes of several clocks and `timing` names none.
    """
    if timing is not None:
        timings = by_timing(results.cases)
        if timing not in timings:
            raise ConfigError(f"compare: got the timing {timing!r}, want one of {list(timings)}")
        results = results.among(timings[timing])
    return comparisons(results, [(a, b)], accept_changes=accept_changes)[0]


def comparisons(
    results: Results,
    which: Sequence[tuple[str, str]],
    *,
    chosen_of: int | None = None,
    accept_changes: bool = False,
) -> list[Comparison]:
    """Return `compare` for each of these pairs of policy ids, with p-values adjusted for one
    another.

    Those of one suite are one family for Holm's method, and those of all suites together another.

    Args:
        chosen_of: The number of all pairs, if these were chosen among them by their outcomes: the
            p-values are then adjusted for all.
    """
    not_shown = max(0, (chosen_of or 0) - len(which))
    shared = [_shared(results, a, b, accept_changes=accept_changes) for a, b in which]
    found = [suites for suites, _ in shared]
    together = [
        [pairs for strata in suites.values() for pairs in strata.values()] for suites in found
    ]
    totals = _lines(ALL, together, not_shown)
    lines: list[list[Line]] = [[] for _ in which]
    for suite in dict.fromkeys(suite for suites in found for suite in suites):
        having = [
            index for index, suites in enumerate(found) if suite in suites and len(suites) > 1
        ]
        family = _lines(suite, [list(found[index][suite].values()) for index in having], not_shown)
        for index, line in zip(having, family, strict=True):
            lines[index].append(line)
    return [
        Comparison(a, b, tuple(lines[i]), totals[i], changes=tuple(shared[i][1]))
        for i, (a, b) in enumerate(which)
    ]


def comparable(
    results: Results,
    which: Sequence[tuple[str, str]] | None = None,
    *,
    accept_changes: bool = False,
) -> tuple[list[tuple[str, str]], list[str]]:
    """Return the pairs of policy ids that `compare` accepts, and the reason for each refused
    one; by default of all.
    """
    pairs, reasons = [], []
    for a, b in itertools.combinations(results.contenders, 2) if which is None else which:
        try:
            _shared(results, a, b, accept_changes=accept_changes)
        except ConfigError as error:
            reasons.append(str(error))
        else:
            pairs.append((a, b))
    return pairs, reasons


def clock_gaps(results: Results) -> list[Comparison]:
    """Compare the suites of each policy in real time (A) with their synchronous counterparts (B).

    A is named "POLICY_ID, SUITE in real time", B "POLICY_ID, SUITE". A suite without a counterpart
    is left out.
    """
    found: dict[tuple[str, str], Strata] = {}
    cases: dict[tuple[str, str], list[CaseResults]] = {}
    order = {name: number for number, name in enumerate(results.contenders)}
    for case in sorted(results.cases, key=lambda case: order[case.contender]):
        counterpart = synchronous_twin(results, case)
        if counterpart is not None and (pairs := _pairs(case, counterpart)).total:
            name = (
                f"{case.contender}, {case.suite} in real time",
                f"{case.contender}, {counterpart.suite}".rstrip(", "),
            )
            found.setdefault(name, {})[case.env] = pairs
            cases.setdefault(name, []).append(case)
    lines = _lines(ALL, [list(strata.values()) for strata in found.values()])
    return [
        Comparison(*name, (), line, tuple(of))
        for (name, of), line in zip(cases.items(), lines, strict=True)
    ]


def gap_to_synchronous(results: Results, case: CaseResults) -> float | None:
    """Return the success rate of a real-time case minus that of its synchronous counterpart, on
    their common episodes.

    It is in [-1, 1]; None without a counterpart, or without such episodes.
    """
    counterpart = synchronous_twin(results, case)
    return None if counterpart is None else _pairs(case, counterpart).difference


def _shared(
    results: Results, a: str, b: str, *, accept_changes: bool
) -> tuple[dict[str, Strata], list[Change]]:
    """Return the pairs of outcomes by suite and env, and the accepted changes between the two."""
    if unknown := sorted({a, b} - set(results.contenders)):
        raise ConfigError(
            f"compare: expected two of the policies {results.contenders}, got {unknown}"
            + did_you_mean(unknown[0], results.contenders)
        )
    others = {(case.suite, case.env): case for case in results.of(b)}
    found: dict[str, Strata] = {}
    changes: dict[Change, None] = {}
    compared: list[CaseResults] = []
    for case in results.of(a):
        if (other := others.get((case.suite, case.env))) is None:
            continue
        changes |= dict.fromkeys(
            _changes_between(results, case, other, accept_changes=accept_changes)
        )
        pairs = _pairs(case, other)
        if pairs.total:
            found.setdefault(case.suite, {})[case.env] = pairs
            compared.append(case)
    if len(timings := by_timing(compared)) > 1:
        raise ConfigError(
            f"compare: {a!r} and {b!r} share episodes of several clocks, which have no rate in "
            "common; want one of "
            f"them, timing={' or '.join(map(repr, timings))}"
        )
    if not found:
        raise ConfigError(
            f"compare: {a!r} and {b!r} share no finished episode; evaluate both with the same seeds"
        )
    return found, list(changes)


_COMPARE_ALL_THE_SAME = "or compare them nevertheless and have the report say so (--accept-changes)"


def _changes_between(
    results: Results, case: CaseResults, other: CaseResults, *, accept_changes: bool
) -> list[Change]:
    """Return what differs between two policies' cases of one env besides the policies.

    Raises:
        ConfigError: The settings of the env differ; or its program, description or contract differ,
            or one of the cases mixes several versions of them or of its policy, and
            `accept_changes` is off.
    """
    one, two = (
        {k: value for k, value in each.settings.items() if k not in OF_POLICY}
        for each in (case, other)
    )
    for name in sorted(one.keys() | two.keys()):
        if one.get(name) != two.get(name):
            raise ConfigError(
                f"compare: {case.env!r} had {name} {one.get(name)!r} for {case.contender!r}, but "
                f"{two.get(name)!r} for "
                f"{other.contender!r}; evaluate both alike, or name the suites apart"
            )
    changes = program_changes(f"env {case.env}", case.program or None, other.program or None)
    statements = [EnvStatement(each.described, each.contract) for each in (case, other)]
    changes += env_changes(case.env, *statements)
    if changes and not accept_changes:
        raise ConfigError(
            f"compare: {case.contender!r} and {other.contender!r} were not played in the same "
            "environment:\n"
            f"{listed(changes)}\nevaluate both in the same one, {_COMPARE_ALL_THE_SAME}"
        )
    mixed = _mixed(results, case, other)
    if mixed and not accept_changes:
        raise ConfigError(
            f"compare: episodes of {case.contender!r} and {other.contender!r} in {case.env!r} were "
            "played with "
            f"{' and '.join(mixed)}, as --accept-changes allowed; evaluate both again in a new "
            "folder, "
            f"{_COMPARE_ALL_THE_SAME}"
        )
    return changes


def _mixed(results: Results, case: CaseResults, other: CaseResults) -> list[str]:
    """Return what the episodes of the two cases, or of one of them, do not have in common, in
    words.
    """
    env_programs = {
        one.env_program for each in (case, other) for one in each.episodes if one.counts
    } - {None}
    mixed = [f"{len(env_programs)} versions of its files"] if len(env_programs) > 1 else []
    for each in (case, other):
        counted = [one for one in each.episodes if one.counts]
        programs = {one.policy_program for one in counted} - {None}
        weights = {one.result.weights for one in counted} - {None}
        if len(programs) > 1:
            mixed.append(f"{len(programs)} versions of the files of {each.contender!r}")
        if len(weights) > 1:
            mixed.append(f"{len(weights)} weights of {each.contender!r}")
        settings = [
            change for change in results.accepted_changes if change.is_setting_of(each.policy)
        ]
        if settings:
            mixed.append(
                f"several settings of {each.contender!r} ({'; '.join(map(str, settings))})"
            )
    stated = [change for change in results.accepted_changes if change.is_statement_of(case.env)]
    if stated:
        mixed.append(f"several versions of the environment ({'; '.join(map(str, stated))})")
    return mixed


def _pairs(a: CaseResults, b: CaseResults) -> Pairs:
    """Return the episodes of both cases, by success once."""
    theirs = {(one.key.episode, one.key.seed): bool(one.success_once) for one in b.counted}
    outcomes = [
        (bool(one.success_once), theirs[one.key.episode, one.key.seed])
        for one in a.counted
        if (one.key.episode, one.key.seed) in theirs
    ]
    return Pairs(
        *(
            outcomes.count(outcome)
            for outcome in ((True, True), (True, False), (False, True), (False, False))
        )
    )


def _lines(suite: str, family: Sequence[Sequence[Pairs]], not_shown: int = 0) -> list[Line]:
    """Return the lines of one family, of which `not_shown` members were left out after a look at
    their outcomes.

    These count as undecided (p = 1). Holm's method rejects no more hypotheses if some p-values are
    larger, so that the family-wise error holds for any choice.
    """
    p_values = [sum(strata, Pairs()).p_value for strata in family]
    adjusted = holm(p_values + [1.0] * not_shown)[: len(p_values)]
    return [Line(suite, tuple(strata), p) for strata, p in zip(family, adjusted, strict=True)]
