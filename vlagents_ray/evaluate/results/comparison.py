"""Paired comparison of two policies, and of one policy in real time with its synchronous
counterpart.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from vlagents_ray.chunking.timeliness import TimeShare
from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate.results.changes import (
    Change,
    EnvStatement,
    env_changes,
    listed,
    program_changes,
)
from vlagents_ray.evaluate.results.reader import (
    CaseResults,
    Results,
    by_timing,
    synchronous_twin,
    time_share_of,
)
from vlagents_ray.evaluate.results.statistics import Pairs, difference_interval, holm
from vlagents_ray.naming import did_you_mean

# The settings of a policy, in which compared cases may differ. All other settings are the env's.
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
        test = {"interval_95": list(self.interval), "p_holm": self.adjusted}
        return {"suite": self.suite} | self.pairs.to_json() | test


@dataclass(frozen=True, slots=True)
class Comparison:
    """Policy id A against policy id B ("NAME", or "NAME@STEP" in a sweep) on the episodes that
    both finished.
    """

    a: str
    b: str
    # One line for each suite, in the order of the plan; empty if A and B share only one suite.
    suites: tuple[Line, ...]
    total: Line
    cases: tuple[CaseResults, ...] = ()  # the cases in real time; only of `clock_gaps`
    changes: tuple[Change, ...] = ()  # accepted differences between the two environments
    # Shares over the compared cases; None if their environments waited for the policy.
    time_share_a: TimeShare | None = None
    time_share_b: TimeShare | None = None

    def to_json(self) -> dict[str, Any]:
        """Return the fields for JSON; `lines` has one entry for each suite, and the total last."""
        lines = [line.to_json() for line in (*self.suites, self.total)]
        return {
            "a": self.a,
            "b": self.b,
            "lines": lines,
            "time_share_a": None if self.time_share_a is None else self.time_share_a.to_json(),
            "time_share_b": None if self.time_share_b is None else self.time_share_b.to_json(),
            "accepted_changes": [asdict(change) for change in self.changes],
        }


def compare(
    results: Results, a: str, b: str, *, timing: str | None = None, accept_changes: bool = False
) -> Comparison:
    """Compare two policies on the episodes that both finished: same suite, env, settings of the
    env, number and seed.

    Args:
        results: Results that hold both.
        a: A policy id: the policy's name, with "@STEP" in a sweep over checkpoints; one of
            `results.policy_ids`.
        b: The other policy id.
        timing: "synchronous" or "in real time", for results that have episodes of both, which are
            never pooled.
        accept_changes: Compare even if files, description or contract of an env differ, or if one
            of the policies ran with several versions of its files or weights.

    Returns:
        The comparison by suite and in total, by success once.

    Raises:
        ConfigError: One of the policy ids is unknown, or they share no finished episode, or an env
            of a suite had different settings for the two, or something changed and
            `accept_changes` is off, or they share episodes of several clocks and `timing` is None.
    """
    if timing is not None:
        timings = by_timing(results.cases)
        if timing not in timings:
            raise ConfigError(f"compare: expected a timing of {list(timings)}, got {timing!r}")
        results = results.among(timings[timing])

    return comparisons(results, [(a, b)], accept_changes=accept_changes)[0]


def comparisons(
    results: Results,
    policy_pairs: Sequence[tuple[str, str]],
    *,
    chosen_of: int | None = None,
    accept_changes: bool = False,
) -> list[Comparison]:
    """Return `compare` for each of these pairs of policy ids, with p-values adjusted for the number
    of comparisons.

    The comparisons on one suite are one family for Holm's method. The comparisons on all suites
    together are another family.

    Args:
        results: Results that hold all of them.
        policy_pairs: The pairs of policy ids.
        chosen_of: The number of all pairs, if these were chosen by their outcomes. The p-values are
            then adjusted for all pairs.
        accept_changes: As for `compare`.
    """
    not_shown = max(0, (chosen_of or 0) - len(policy_pairs))
    suites_of_pairs: list[dict[str, Strata]] = []
    changes_of_pairs: list[list[Change]] = []
    time_shares_of_pairs: list[list[TimeShare | None]] = []
    for a, b in policy_pairs:
        suites, changes, compared = _shared(results, a, b, accept_changes=accept_changes)
        suites_of_pairs.append(suites)
        changes_of_pairs.append(changes)
        time_shares_of_pairs.append([_time_share(cases) for cases in zip(*compared, strict=True)])

    strata_of_pairs: list[list[Pairs]] = []
    names: dict[str, None] = {}  # the names of all suites, in order
    for suites in suites_of_pairs:
        names |= dict.fromkeys(suites)
        strata_of_pairs.append([])
        for strata in suites.values():
            strata_of_pairs[-1] += strata.values()
    totals = _lines(ALL, strata_of_pairs, not_shown)

    # A pair that shares only one suite has no line for it, as the line would repeat the total.
    lines: list[list[Line]] = [[] for _ in policy_pairs]
    for name in names:
        members = []  # indices of the pairs that have a line for this suite
        strata_of_members = []
        for index, suites in enumerate(suites_of_pairs):
            if name in suites and len(suites) > 1:
                members.append(index)
                strata_of_members.append(list(suites[name].values()))
        family = _lines(name, strata_of_members, not_shown)
        for index, line in zip(members, family, strict=True):
            lines[index].append(line)

    compared_pairs = []
    for i, (a, b) in enumerate(policy_pairs):
        changes, (time_share_a, time_share_b) = changes_of_pairs[i], time_shares_of_pairs[i]
        compared_pairs.append(
            Comparison(
                a,
                b,
                tuple(lines[i]),
                totals[i],
                changes=tuple(changes),
                time_share_a=time_share_a,
                time_share_b=time_share_b,
            )
        )
    return compared_pairs


def comparable(
    results: Results,
    policy_pairs: Sequence[tuple[str, str]] | None = None,
    *,
    accept_changes: bool = False,
) -> tuple[list[tuple[str, str]], list[str]]:
    """Return the pairs of policy ids that `compare` accepts, and the reason for each pair that it
    does not accept. By default, all pairs are tried.
    """
    if policy_pairs is None:
        policy_pairs = list(itertools.combinations(results.policy_ids, 2))
    accepted, reasons = [], []
    for a, b in policy_pairs:
        try:
            _shared(results, a, b, accept_changes=accept_changes)
        except ConfigError as error:
            reasons.append(str(error))
        else:
            accepted.append((a, b))
    return accepted, reasons


def clock_gaps(results: Results) -> list[Comparison]:
    """Compare the suites of each policy in real time (A) with their synchronous counterparts (B).

    A is named "POLICY_ID, SUITE in real time", B "POLICY_ID, SUITE". A suite without a counterpart
    is left out.
    """
    strata: dict[tuple[str, str], Strata] = {}  # by the names of A and B
    cases: dict[tuple[str, str], list[CaseResults]] = {}
    order = {name: number for number, name in enumerate(results.policy_ids)}
    for case in sorted(results.cases, key=lambda case: order[case.policy_id]):
        counterpart = synchronous_twin(results, case)
        if counterpart is None:
            continue
        pairs = _pairs(case, counterpart)
        if pairs.total:
            names = (
                f"{case.policy_id}, {case.suite} in real time",
                f"{case.policy_id}, {counterpart.suite}".rstrip(", "),
            )
            strata.setdefault(names, {})[case.env] = pairs
            cases.setdefault(names, []).append(case)

    lines = _lines(ALL, [list(by_env.values()) for by_env in strata.values()])
    return [
        Comparison(a, b, (), line, tuple(compared), time_share_a=_time_share(compared))
        for ((a, b), compared), line in zip(cases.items(), lines, strict=True)
    ]


def gap_to_synchronous(results: Results, case: CaseResults) -> float | None:
    """Return the success rate of a real-time case minus that of its synchronous counterpart, on
    their common episodes.

    It is in [-1, 1]; None without a counterpart, or without such episodes.
    """
    counterpart = synchronous_twin(results, case)
    return None if counterpart is None else _pairs(case, counterpart).difference


def _time_share(cases: Iterable[CaseResults]) -> TimeShare | None:
    """Return the figures of all counted episodes of these cases."""
    return time_share_of(list(itertools.chain.from_iterable(case.counted for case in cases)))


def _shared(
    results: Results, a: str, b: str, *, accept_changes: bool
) -> tuple[dict[str, Strata], list[Change], list[tuple[CaseResults, CaseResults]]]:
    """Return the pairs of outcomes by suite and env, the accepted changes between the two, and the
    compared cases of A and B.
    """
    unknown = sorted({a, b} - set(results.policy_ids))
    if unknown:
        raise ConfigError(
            f"compare: expected two of the policies {results.policy_ids}, got {unknown}"
            + did_you_mean(unknown[0], results.policy_ids)
        )

    cases_of_b = {(case.suite, case.env): case for case in results.of(b)}
    suites: dict[str, Strata] = {}
    changes: dict[Change, None] = {}
    compared: list[tuple[CaseResults, CaseResults]] = []
    for case in results.of(a):
        other = cases_of_b.get((case.suite, case.env))
        if other is None:
            continue
        changes |= dict.fromkeys(
            _changes_between(results, case, other, accept_changes=accept_changes)
        )
        pairs = _pairs(case, other)
        if pairs.total:
            suites.setdefault(case.suite, {})[case.env] = pairs
            compared.append((case, other))

    timings = by_timing([case for case, _ in compared])
    if len(timings) > 1:
        raise ConfigError(
            "compare: expected one clock, as episodes of several clocks have no common rate, got "
            f"{a!r} and {b!r} with several; choose one: timing={' or '.join(map(repr, timings))}"
        )
    if not suites:
        raise ConfigError(
            f"compare: {a!r} and {b!r} share no finished episode; evaluate both with the same seeds"
        )
    return suites, list(changes), compared


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
    for name in sorted((case.settings.keys() | other.settings.keys()) - OF_POLICY):
        value, other_value = case.settings.get(name), other.settings.get(name)
        if value != other_value:
            raise ConfigError(
                f"compare: expected the same {name} of {case.env!r} for all policies, got "
                f"{value!r} for {case.policy_id!r} and {other_value!r} for {other.policy_id!r}; "
                "evaluate both with the same, or give the suites different names"
            )

    changes = program_changes(f"env {case.env}", case.program or None, other.program or None)
    changes += env_changes(
        case.env,
        EnvStatement(case.described, case.contract),
        EnvStatement(other.described, other.contract),
    )
    if changes and not accept_changes:
        raise ConfigError(
            f"compare: expected {case.policy_id!r} and {other.policy_id!r} in the same "
            f"environment, got different ones:\n{listed(changes)}\nevaluate both in the same one, "
            f"{_COMPARE_ALL_THE_SAME}"
        )

    mixed = _mixed(results, case, other)
    if mixed and not accept_changes:
        raise ConfigError(
            f"compare: expected episodes of {case.policy_id!r} and {other.policy_id!r} in "
            f"{case.env!r} with the same files, got {' and '.join(mixed)}, as --accept-changes "
            f"allowed; evaluate both again in a new folder, {_COMPARE_ALL_THE_SAME}"
        )
    return changes


def _mixed(results: Results, case: CaseResults, other: CaseResults) -> list[str]:
    """Return, in words, the properties that differ between episodes of the two cases, or within
    one of them.
    """
    accepted = results.accepted_changes
    counted_by_case = [case.counted_episodes, other.counted_episodes]
    mixed = []
    env_programs = {episode.env_program for episode in itertools.chain(*counted_by_case)} - {None}
    if len(env_programs) > 1:
        mixed.append(f"{len(env_programs)} versions of its files")

    for either, counted in zip((case, other), counted_by_case, strict=True):
        programs = {episode.policy_program for episode in counted} - {None}
        if len(programs) > 1:
            mixed.append(f"{len(programs)} versions of the files of {either.policy_id!r}")

        weights = {episode.result.weights for episode in counted} - {None}
        if len(weights) > 1:
            mixed.append(f"{len(weights)} weights of {either.policy_id!r}")

        of_policy = [str(change) for change in accepted if change.is_setting_of(either.policy)]
        if of_policy:
            mixed.append(f"several settings of {either.policy_id!r} ({'; '.join(of_policy)})")

    of_env = [str(change) for change in accepted if change.is_statement_of(case.env)]
    if of_env:
        mixed.append(f"several versions of the environment ({'; '.join(of_env)})")
    return mixed


def _pairs(a: CaseResults, b: CaseResults) -> Pairs:
    """Return the counts of the episodes that both cases have, by success once."""
    counts: Counter[tuple[bool, bool]] = Counter()
    for episode, solved_by_a in a.solved.items():
        if episode in b.solved:
            counts[solved_by_a, b.solved[episode]] += 1
    return Pairs(
        both=counts[True, True],
        only_a=counts[True, False],
        only_b=counts[False, True],
        neither=counts[False, False],
    )


def _lines(suite: str, family: Sequence[Sequence[Pairs]], not_shown: int = 0) -> list[Line]:
    """Return the lines of one family.

    The members that were left out count as undecided (p = 1). Larger p-values never make Holm's
    method reject more hypotheses, so the family-wise error rate is valid for any choice.

    Args:
        suite: The name of the suite, or "all".
        family: The strata of each shown member.
        not_shown: The number of members that were left out because of their outcomes.
    """
    p_values = [sum(strata, Pairs()).p_value for strata in family]
    adjusted = holm(p_values + [1.0] * not_shown)[: len(p_values)]
    return [
        Line(suite, tuple(strata), p_value)
        for strata, p_value in zip(family, adjusted, strict=True)
    ]
