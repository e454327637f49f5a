"""Paired comparison of two policies, and of one policy in real time with its synchronous counterpart."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate.results.changes import listed, program_changes
from vlagents_ray.evaluate.results.reader import CellResults, Results, synchronous_twin
from vlagents_ray.evaluate.results.statistics import Pairs, difference_interval, holm

# The policy's settings among a cell's, in which compared cells may differ. All others are the env's.
OF_POLICY = frozenset({"policy", "policy_config", "policy_options", "checkpoint", "pushed_weights", "execute", "codec"})
ALL = "all"

Strata = dict[str, Pairs]  # by env


@dataclass(frozen=True, slots=True)
class Line:
    """The comparison on one suite, or on all suites together."""

    suite: str  # or "all"
    strata: tuple[Pairs, ...]  # by env
    adjusted: float  # McNemar's p-value, adjusted by Holm's method for all comparisons of its family

    @property
    def pairs(self) -> Pairs:
        """The episodes of all envs together."""
        return sum(self.strata, Pairs())

    @property
    def interval(self) -> tuple[float, float]:
        """(low, high), the 95 % interval of the success rate of A minus that of B (`difference_interval`)."""
        return difference_interval(self.strata)

    def to_json(self) -> dict[str, Any]:
        """Return the fields for JSON."""
        beside = {"interval_95": list(self.interval), "p_holm": self.adjusted}
        return {"suite": self.suite} | self.pairs.to_json() | beside


@dataclass(frozen=True, slots=True)
class Comparison:
    """Policy id A against policy id B ("NAME", or "NAME@STEP" in a sweep) on the episodes that both finished."""

    a: str
    b: str
    suites: tuple[Line, ...]  # one for each suite, in the order of the plan; empty if they share only one
    total: Line
    cells: tuple[CellResults, ...] = ()  # of `clock_gaps`: the cells in real time

    def to_json(self) -> dict[str, Any]:
        """Return the fields for JSON; `lines` has one entry for each suite, and the total last."""
        return {"a": self.a, "b": self.b, "lines": [line.to_json() for line in (*self.suites, self.total)]}


def compare(results: Results, a: str, b: str) -> Comparison:
    """Compare two policies on the episodes that both finished: same suite, env, settings of the env, number and seed.

    Args:
        results: Results that hold both.
        a: A policy id: the policy's name, with "@STEP" in a sweep over checkpoints; one of `results.contenders`.
        b: The other policy id.

    Returns:
        The comparison by suite and in total, by success once.

    Raises:
        ConfigError: One of the policy ids is unknown, they share no finished episode, or an env of a suite had
            different settings for the two.
    """
    return comparisons(results, [(a, b)])[0]


def comparisons(results: Results, which: Sequence[tuple[str, str]]) -> list[Comparison]:
    """Return `compare` for each of these pairs of policy ids, with p-values adjusted for one another.

    Those of one suite are one family for Holm's method, and those of all suites together another.
    """
    found = [_by_suite(results, a, b) for a, b in which]
    totals = _lines(ALL, [[pairs for strata in suites.values() for pairs in strata.values()] for suites in found])
    lines: list[list[Line]] = [[] for _ in which]
    for suite in dict.fromkeys(suite for suites in found for suite in suites):
        having = [index for index, suites in enumerate(found) if suite in suites and len(suites) > 1]
        family = _lines(suite, [list(found[index][suite].values()) for index in having])
        for index, line in zip(having, family, strict=True):
            lines[index].append(line)
    return [Comparison(a, b, tuple(lines[i]), totals[i]) for i, (a, b) in enumerate(which)]


def comparable(
    results: Results, which: Sequence[tuple[str, str]] | None = None
) -> tuple[list[tuple[str, str]], list[str]]:
    """Return the pairs of policy ids that `compare` accepts, and the reason for each refused one; by default of all."""
    pairs, reasons = [], []
    for a, b in itertools.combinations(results.contenders, 2) if which is None else which:
        try:
            _by_suite(results, a, b)
        except ConfigError as error:
            reasons.append(str(error))
        else:
            pairs.append((a, b))
    return pairs, reasons


def clock_gaps(results: Results) -> list[Comparison]:
    """Compare the suites of each policy in real time (A) with their synchronous counterparts (B).

    A is named "POLICY_ID, SUITE in real time", B "POLICY_ID, SUITE". A suite without a counterpart is left out.
    """
    found: dict[tuple[str, str], Strata] = {}
    cells: dict[tuple[str, str], list[CellResults]] = {}
    order = {name: number for number, name in enumerate(results.contenders)}
    for cell in sorted(results.cells, key=lambda cell: order[cell.contender]):
        counterpart = synchronous_twin(results, cell)
        if counterpart is not None and (pairs := _pairs(cell, counterpart)).total:
            name = f"{cell.contender}, {cell.suite} in real time", f"{cell.contender}, {counterpart.suite}".rstrip(", ")
            found.setdefault(name, {})[cell.env] = pairs
            cells.setdefault(name, []).append(cell)
    lines = _lines(ALL, [list(strata.values()) for strata in found.values()])
    return [Comparison(*name, (), line, tuple(of)) for (name, of), line in zip(cells.items(), lines, strict=True)]


def gap_to_synchronous(results: Results, cell: CellResults) -> float | None:
    """Return the success rate of a real-time cell minus that of its synchronous counterpart, on their common episodes.

    It is in [-1, 1]; None without a counterpart, or without such episodes.
    """
    counterpart = synchronous_twin(results, cell)
    return None if counterpart is None else _pairs(cell, counterpart).difference


def _by_suite(results: Results, a: str, b: str) -> dict[str, Strata]:
    if unknown := sorted({a, b} - set(results.contenders)):
        raise ConfigError(f"compare: got {unknown}, want two of the contenders {results.contenders}")
    others = {(cell.suite, cell.env): cell for cell in results.of(b)}
    found: dict[str, Strata] = {}
    for cell in results.of(a):
        if (other := others.get((cell.suite, cell.env))) is None:
            continue
        _require_same_env(cell, other)
        pairs = _pairs(cell, other)
        if pairs.total:
            found.setdefault(cell.suite, {})[cell.env] = pairs
    if not found:
        raise ConfigError(f"compare: {a!r} and {b!r} share no finished episode; evaluate both with the same seeds")
    return found


def _require_same_env(cell: CellResults, other: CellResults) -> None:
    one, two = ({k: value for k, value in each.settings.items() if k not in OF_POLICY} for each in (cell, other))
    for name in sorted(one.keys() | two.keys()):
        if one.get(name) != two.get(name):
            raise ConfigError(
                f"compare: {cell.env!r} had {name} {one.get(name)!r} for {cell.contender!r}, but {two.get(name)!r} for "
                f"{other.contender!r}; evaluate both alike, or name the suites apart"
            )
    if odd := program_changes(f"env {cell.env}", cell.program or None, other.program or None):
        raise ConfigError(
            f"compare: {cell.contender!r} and {other.contender!r} were not played in the same environment:\n"
            f"{listed(odd)}\nevaluate both with the same files"
        )
    programs = {one.env_program for each in (cell, other) for one in each.episodes if one.counts} - {None}
    if len(programs) > 1:
        raise ConfigError(
            f"compare: episodes of {cell.contender!r} and {other.contender!r} in {cell.env!r} were played with "
            f"{len(programs)} versions of its files, as --accept-changes allowed; evaluate both again in a new folder"
        )


def _pairs(a: CellResults, b: CellResults) -> Pairs:
    """Return the episodes of both cells, by success once."""
    theirs = {(one.key.episode, one.key.seed): bool(one.success_once) for one in b.counted}
    outcomes = [
        (bool(one.success_once), theirs[one.key.episode, one.key.seed])
        for one in a.counted
        if (one.key.episode, one.key.seed) in theirs
    ]
    return Pairs(*(outcomes.count(outcome) for outcome in ((True, True), (True, False), (False, True), (False, False))))


def _lines(suite: str, family: Sequence[Sequence[Pairs]]) -> list[Line]:
    adjusted = holm([sum(strata, Pairs()).p_value for strata in family])
    return [Line(suite, tuple(strata), p) for strata, p in zip(family, adjusted, strict=True)]
