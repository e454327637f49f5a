"""Paired comparison of two policies, or of a policy in real time with its synchronous
counterpart.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

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
    is_sequential,
    synchronous_twin,
    time_share_of,
)
from vlagents_ray.evaluate.results.statistics import (
    Pairs,
    Starts,
    difference_interval,
    holm,
    paired_test,
    sequential_difference_interval,
    sequential_test,
    sum_of,
)
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


class StartPairs(NamedTuple):
    """The pairs of one start, or of several starts with these outcomes."""

    finished: Pairs  # the pairs that both policies finished
    # With the pairs in which infrastructure lost an episode, with the outcomes that are worst and
    # best for A.
    worst: Pairs
    best: Pairs

    def __add__(self, other: StartPairs) -> StartPairs:  # type: ignore[override]
        return StartPairs(*(a + b for a, b in zip(self, other, strict=True)))


Strata = dict[str, dict[str, StartPairs]]  # keys: env, start


@dataclass(frozen=True, slots=True)
class PairedOutcomes:
    """The outcomes of two policies in the same episodes, one item for each env."""

    strata: tuple[Starts, ...]  # the episodes that both finished
    # With the lost episodes, with the outcomes that are worst and best for A. What breaks a
    # simulator may depend on the policy, so nothing is assumed about them.
    worst: tuple[Starts, ...]
    best: tuple[Starts, ...]
    is_sequential: bool  # whether the number of pairs may depend on their outcomes

    @classmethod
    def from_strata(cls, strata: Iterable[Strata], *, is_sequential: bool) -> PairedOutcomes:
        """Join the starts of each env, also if several suites have the env."""
        envs: Strata = {}
        for stratum in strata:
            for env, starts in stratum.items():
                joined = envs.setdefault(env, {})
                for start, pairs in starts.items():
                    joined[start] = joined[start] + pairs if start in joined else pairs

        numbers = [Counter(starts.values()) for starts in envs.values()]
        completions = []
        for place in range(len(StartPairs._fields)):
            strata_of_place: list[Counter[Pairs]] = []
            for starts_by_pairs in numbers:
                counts: Counter[Pairs] = Counter()
                for pairs, number in starts_by_pairs.items():
                    counts[pairs[place]] += number
                del counts[Pairs()]
                strata_of_place.append(counts)
            completions.append(tuple(strata_of_place))
        finished, worst, best = completions
        return cls(finished, worst, best, is_sequential)

    @property
    def p_value(self) -> float:
        """The largest p-value of `paired_test`, or `sequential_test`, for all outcomes of the lost
        episodes; 1 if these could change the sign of the difference.
        """
        if sum_of(self.worst).net <= 0 <= sum_of(self.best).net:
            return 1.0
        test = sequential_test if self.is_sequential else paired_test
        return max(test(self.worst), test(self.best))

    @property
    def interval(self) -> tuple[float, float]:
        """The interval of the difference, for all outcomes of the lost episodes."""
        interval_of = sequential_difference_interval if self.is_sequential else difference_interval
        low, high = interval_of(self.worst)
        return low, high if self.best == self.worst else interval_of(self.best)[1]


@dataclass(frozen=True, slots=True)
class Line:
    """The comparison of two policies on one suite, or on all suites together."""

    suite: str  # name of the suite, or "all"
    outcomes: PairedOutcomes
    p_value: float  # see `PairedOutcomes.p_value`
    # The p-value, adjusted with Holm's method for all comparisons of its family.
    adjusted: float

    @property
    def pairs(self) -> Pairs:
        """The counts for the episodes of all envs together that both policies finished."""
        return sum_of(self.outcomes.strata)

    @property
    def lost(self) -> int:
        """The number of further pairs in which infrastructure lost at least one episode."""
        return sum_of(self.outcomes.worst).total - self.pairs.total

    @property
    def starts(self) -> int:
        """The number of different starts of these pairs."""
        return sum(sum(starts.values()) for starts in self.outcomes.strata)

    @property
    def is_sequential(self) -> bool:
        """Whether the number of pairs may depend on their outcomes (see `is_sequential`)."""
        return self.outcomes.is_sequential

    @property
    def interval(self) -> tuple[float, float]:
        """(low, high), the 95 % interval of the success rate of A minus the success rate of B.

        It contains the intervals for all outcomes of the lost episodes. If `is_sequential`, it is a
        confidence sequence.
        """
        return self.outcomes.interval

    def to_json(self) -> dict[str, Any]:
        """Return the fields for JSON."""
        interval = "confidence_sequence" if self.is_sequential else "interval_95"
        return {
            "suite": self.suite,
            **self.pairs.to_json(),
            "starts": self.starts,
            "lost": self.lost,
            "p_value": self.p_value,
            interval: list(self.interval),
            "p_holm": self.adjusted,
        }


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
        timing: "synchronous", "in real time" or "on the robot" (see `by_timing`); required if the
            results have episodes with several timings, which are never pooled.
        accept_changes: Compare even if files, description or contract of an env differ, or if one
            policy ran with several versions of its files or weights.

    Returns:
        The comparison by suite and in total, based on success once.

    Raises:
        ConfigError: A policy id is unknown, or the policies share no finished episode, or an env of
            a suite had different settings for both, or a file or the weights changed and
            `accept_changes` is False, or the policies share episodes of several timings and
            `timing` is None.
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
    shared = [_shared(results, a, b, accept_changes=accept_changes) for a, b in policy_pairs]
    # Suites of one env have the same starts, so the totals join them.
    totals = _lines(
        ALL,
        [
            PairedOutcomes.from_strata(pair.suites.values(), is_sequential=pair.is_sequential)
            for pair in shared
        ],
        not_shown,
    )

    # A pair that shares only one suite has no line for this suite, as the line would repeat the
    # total.
    names: dict[str, None] = {}  # the names of all suites, in order
    for pair in shared:
        names |= dict.fromkeys(pair.suites)
    lines: list[list[Line]] = [[] for _ in policy_pairs]
    for name in names:
        members = []  # indices of the pairs that have a line for this suite
        outcomes_of_members = []
        for index, pair in enumerate(shared):
            if name in pair.suites and len(pair.suites) > 1:
                members.append(index)
                outcomes_of_members.append(
                    PairedOutcomes.from_strata(
                        [pair.suites[name]], is_sequential=pair.is_sequential
                    )
                )
        family = _lines(name, outcomes_of_members, not_shown)
        for index, line in zip(members, family, strict=True):
            lines[index].append(line)

    compared_pairs = []
    for i, (a, b) in enumerate(policy_pairs):
        time_share_a, time_share_b = map(_time_share, zip(*shared[i].cases, strict=True))
        compared_pairs.append(
            Comparison(
                a,
                b,
                tuple(lines[i]),
                totals[i],
                changes=tuple(shared[i].changes),
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
    cases: dict[tuple[str, str], list[tuple[CaseResults, CaseResults]]] = {}
    order = {name: number for number, name in enumerate(results.policy_ids)}
    for case in sorted(results.cases, key=lambda case: order[case.policy_id]):
        counterpart = synchronous_twin(results, case)
        if counterpart is None:
            continue
        pairs = _pairs(case, counterpart, results.starts)
        if _are_shared(pairs):
            names = (
                f"{case.policy_id}, {case.suite} in real time",
                f"{case.policy_id}, {counterpart.suite}".rstrip(", "),
            )
            strata.setdefault(names, {})[case.env] = pairs
            cases.setdefault(names, []).append((case, counterpart))

    outcomes = [
        PairedOutcomes.from_strata([by_env], is_sequential=_are_sequential(cases[names]))
        for names, by_env in strata.items()
    ]
    lines = _lines(ALL, outcomes)
    gaps = []
    for ((a, b), compared), line in zip(cases.items(), lines, strict=True):
        in_real_time = tuple(case for case, _ in compared)
        time_share = _time_share(in_real_time)
        gaps.append(Comparison(a, b, (), line, in_real_time, time_share_a=time_share))
    return gaps


def gap_to_synchronous(results: Results, case: CaseResults) -> float | None:
    """Return the success rate of a real-time case minus the success rate of its synchronous
    counterpart, on their common episodes.

    It is in [-1, 1]; None if there is no counterpart, or no common episode.
    """
    counterpart = synchronous_twin(results, case)
    if counterpart is None:
        return None
    pairs = _pairs(case, counterpart, results.starts)
    return _finished(pairs).difference


def _time_share(cases: Iterable[CaseResults]) -> TimeShare | None:
    """Return the figures over all counted episodes of these cases."""
    return time_share_of(list(itertools.chain.from_iterable(case.counted for case in cases)))


@dataclass(frozen=True, slots=True)
class _Shared:
    """The episodes that two policies share."""

    suites: dict[str, Strata]  # the pairs of outcomes by suite
    changes: list[Change]  # accepted changes between A and B
    cases: list[tuple[CaseResults, CaseResults]]  # the compared cases of A and B

    @property
    def is_sequential(self) -> bool:
        return _are_sequential(self.cases)


def _are_sequential(compared: Sequence[tuple[CaseResults, CaseResults]]) -> bool:
    """Return whether the number of pairs may depend on their outcomes."""
    return any(is_sequential(cases) for cases in zip(*compared, strict=True))


def _shared(results: Results, a: str, b: str, *, accept_changes: bool) -> _Shared:
    """Return the episodes that A and B share; raises `ConfigError` as `compare` does."""
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
        pairs = _pairs(case, other, results.starts)
        if _are_shared(pairs):
            suites.setdefault(case.suite, {})[case.env] = pairs
            compared.append((case, other))

    timings = by_timing([case for case, _ in compared])
    if len(timings) > 1:
        raise ConfigError(
            "compare: expected one timing, as episodes of several timings have no common rate, got "
            f"{a!r} and {b!r} with several; choose one: timing={' or '.join(map(repr, timings))}"
        )
    if not suites:
        raise ConfigError(
            f"compare: {a!r} and {b!r} share no finished episode; evaluate both with the same seeds"
        )
    return _Shared(suites, list(changes), compared)


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


def _pairs(
    a: CaseResults, b: CaseResults, starts: Mapping[str, Mapping[tuple[int, int], str]]
) -> dict[str, StartPairs]:
    """Return the outcomes, based on success once, of the episodes that both cases have, by start;
    `starts` is `Results.starts`.
    """
    # If the same episodes have different starts, e.g. as two machines render them differently, the
    # coarser division of the episodes is the safer one.
    keys = a.outcomes.keys() & b.outcomes.keys()
    of_a, of_b = starts[a.case_id], starts[b.case_id]
    starts_of_a = {key: (of_b if a.outcomes[key] is None else of_a)[key] for key in keys}
    starts_of_b = {key: (of_a if b.outcomes[key] is None else of_b)[key] for key in keys}
    names = min(starts_of_a, starts_of_b, key=lambda names: len(set(names.values())))

    pairs: dict[str, StartPairs] = {}
    for key in a.outcomes:
        if key in keys:
            pair = _PAIRS[a.outcomes[key], b.outcomes[key]]
            name = names[key]
            pairs[name] = pairs[name] + pair if name in pairs else pair
    return pairs


def _pair(solved_by_a: bool, solved_by_b: bool) -> Pairs:
    return Pairs(
        both=int(solved_by_a and solved_by_b),
        only_a=int(solved_by_a and not solved_by_b),
        only_b=int(solved_by_b and not solved_by_a),
        neither=int(not solved_by_a and not solved_by_b),
    )


# The pairs of one episode, by the outcomes of A and B; None is the outcome of a lost episode.
_PAIRS = {
    (a, b): StartPairs(
        finished=Pairs() if a is None or b is None else _pair(a, b),
        worst=_pair(bool(a), b is not False),
        best=_pair(a is not False, bool(b)),
    )
    for a, b in itertools.product((True, False, None), repeat=2)
}


def _are_shared(starts: Mapping[str, StartPairs]) -> bool:
    """Return whether both policies finished an episode of these starts."""
    return any(pairs.finished.total for pairs in starts.values())


def _finished(starts: Mapping[str, StartPairs]) -> Pairs:
    """Return the counts of the pairs that both policies finished."""
    return sum((pairs.finished for pairs in starts.values()), Pairs())


def _lines(suite: str, family: Sequence[PairedOutcomes], not_shown: int = 0) -> list[Line]:
    """Return the lines of one family.

    The comparisons that were left out count as undecided (p = 1). Larger p-values never make Holm's
    method reject more hypotheses, so the family-wise error rate holds for any choice of
    comparisons.

    Args:
        suite: The name of the suite, or "all".
        family: The outcomes of each shown member.
        not_shown: The number of members that were left out because of their outcomes.
    """
    p_values = [outcomes.p_value for outcomes in family]
    adjusted = holm(p_values + [1.0] * not_shown)[: len(p_values)]
    return [
        Line(suite, outcomes, p_value, adjusted_p)
        for outcomes, p_value, adjusted_p in zip(family, p_values, adjusted, strict=True)
    ]
