"""Paired comparison of two policies, or of a policy in real time with its synchronous
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

# Settings of the policy, which may differ between compared cases. All other settings belong to the
# env.
OF_POLICY = frozenset(
    {
        "policy",
        "policy_config",
        "policy_options",
        "checkpoint",
        "checkpoint_step",
        "pushed_weights",
        "execute",
        "codec",
    }
)
ALL = "all"

Strata = dict[str, Pairs]  # keys: envs


@dataclass(frozen=True, slots=True)
class Line:
    """The comparison of two policies on one suite, or on all suites together."""

    suite: str  # name of the suite, or "all"
    strata: tuple[Pairs, ...]  # one item for each env
    # McNemar's p-value, adjusted with Holm's method for all comparisons of its family.
    adjusted: float

    @property
    def pairs(self) -> Pairs:
        """The counts for the episodes of all envs together."""
        return sum(self.strata, Pairs())

    @property
    def interval(self) -> tuple[float, float]:
        """(low, high), the 95 % interval of the success rate of A minus the success rate of B (see
        `difference_interval`).
        """
        return difference_interval(self.strata)

    def to_json(self) -> dict[str, Any]:
        """Return the fields for JSON."""
        test = {"interval_95": list(self.interval), "p_holm": self.adjusted}
        return {"suite": self.suite} | self.pairs.to_json() | test


@dataclass(frozen=True, slots=True)
class Comparison:
    """The comparison of policy id A with policy id B ("NAME", or "NAME@STEP" in a sweep) on the
    episodes that both finished.
    """

    a: str
    b: str
    # One line for each suite, in the order of the plan; empty if A and B share only one suite.
    suites: tuple[Line, ...]
    total: Line
    cases: tuple[CaseResults, ...] = ()  # the cases in real time; only set by `clock_gaps`
    changes: tuple[Change, ...] = ()  # accepted differences between the two environments
    # Figures over the compared cases; None if their environments waited for the policy.
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
        results: The results that contain both policies.
        a: A policy id: the policy's name, with "@STEP" in a sweep over checkpoints; one of
            `results.policy_ids`.
        b: The other policy id.
        timing: "synchronous" or "in real time"; required if the results have episodes with both
            timings, which are never pooled.
        accept_changes: Compare even if files, description or contract of an env differ, or if one
            policy ran with several versions of its files or weights.

    Returns:
        The comparison by suite and in total, based on success once.

    Raises:
        ConfigError: A policy id is unknown, or the policies share no finished episode, or an env of
            a suite had different settings for both, or a file or the weights changed and
            `accept_changes` is False, or the policies share episodes of several clocks and `timing`
            is None.
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

    For Holm's method, the comparisons on one suite are one family, and the comparisons on all
    suites together are another family.

    Args:
        results: The results that contain all policies.
        policy_pairs: The pairs of policy ids.
        chosen_of: The number of all possible pairs, if `policy_pairs` was chosen by the outcomes.
            The p-values are then adjusted for all possible pairs.
        accept_changes: As in `compare`.
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

    # A pair that shares only one suite has no line for this suite, as the line would repeat the
    # total.
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
    """Return the pairs of policy ids that `compare` accepts, and the reasons why it rejects the
    other pairs. By default, all pairs are tried.
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
    """Compare each policy's suites in real time (A) with their synchronous counterparts (B).

    The name of A is "POLICY_ID, SUITE in real time", and the name of B is "POLICY_ID, SUITE". A
    suite without a counterpart is left out.
    """
    strata: dict[tuple[str, str], Strata] = {}  # keys: (name of A, name of B)
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
    """Return the success rate of a real-time case minus the success rate of its synchronous
    counterpart, on their common episodes.

    It is in [-1, 1]; None if there is no counterpart, or no common episode.
    """
    counterpart = synchronous_twin(results, case)
    return None if counterpart is None else _pairs(case, counterpart).difference


def _time_share(cases: Iterable[CaseResults]) -> TimeShare | None:
    """Return the figures over all counted episodes of these cases."""
    return time_share_of(list(itertools.chain.from_iterable(case.counted for case in cases)))


def _shared(
    results: Results, a: str, b: str, *, accept_changes: bool
) -> tuple[dict[str, Strata], list[Change], list[tuple[CaseResults, CaseResults]]]:
    """Return the pairs of outcomes by suite and env, the accepted changes between A and B, and the
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


_COMPARE_ALL_THE_SAME = "or compare them nevertheless, which the report mentions (--accept-changes)"


def _changes_between(
    results: Results, case: CaseResults, other: CaseResults, *, accept_changes: bool
) -> list[Change]:
    """Return the differences between two policies' cases of one env, other than the policies
    themselves.

    Raises:
        ConfigError: The settings of the env differ. Or, if `accept_changes` is False: the program,
            description or contract of the env differ, or one of the cases mixes several versions of
            them or of its policy.
    """
    for name in sorted((case.settings.keys() | other.settings.keys()) - OF_POLICY):
        value, other_value = case.settings.get(name), other.settings.get(name)
        if value != other_value:
            raise ConfigError(
                f"compare: expected the same {name} of {case.env!r} for all policies, got "
                f"{value!r} for {case.policy_id!r} and {other_value!r} for {other.policy_id!r}; "
                "evaluate both with the same value, or give the suites different names"
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
            f"environment, got different ones:\n{listed(changes)}\nevaluate both in the same "
            f"environment, {_COMPARE_ALL_THE_SAME}"
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
    """Return descriptions of the properties that differ between the episodes of both cases, or
    within one of the cases.
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
    """Return the counts of outcomes over the episodes that both cases have, based on success
    once.
    """
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

    The comparisons that were left out count as undecided (p = 1). Larger p-values never make Holm's
    method reject more hypotheses, so the family-wise error rate holds for any choice of
    comparisons.

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
