"""Combination of the results of several folders, for a report that compares them."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate.results.changes import changed, with_known
from vlagents_ray.evaluate.results.reader import CaseResults, Results, Run, Worker
from vlagents_ray.evaluate.results.summary import reported


def require_distinct(folders: Iterable[Path]) -> None:
    """Raise `ConfigError` if a folder is given twice, possibly with different paths."""
    paths: dict[Path, Path] = {}
    for folder in folders:
        first = paths.setdefault(folder.resolve(), folder)
        if first is not folder:
            also = "twice" if str(first) == str(folder) else f"also as {first}"
            raise ConfigError(f"{folder}: is named {also}; name each folder once")


def combined(folders: Sequence[Results]) -> Results:
    """Combine the results of several folders.

    The folder's name is appended to a policy's name, as in "pi0 (second)", if two folders contain
    the policy in the same env, or with different files, or with different weights of the same
    checkpoint.

    Raises:
        ConfigError: No folder is given, or two folders are parts of one evaluation, which must be
            merged instead.
    """
    if not folders:
        raise ConfigError(
            "report: expected one folder or more that evaluations wrote, got none; name at least "
            "one"
        )
    if len(folders) == 1:
        return folders[0]
    require_distinct(results.out for results in folders)
    _require_different_evaluations(folders)
    clashing = _clashing_policies(folders)

    homes = [results.out.resolve() for results in folders]
    base = Path(os.path.commonpath(homes))
    # The names of the folders or, if some names are equal, their paths below `base`.
    labels = [home.name for home in homes]
    if len(set(labels)) < len(labels):
        labels = [str(home.relative_to(base)) for home in homes]

    cases: list[CaseResults] = []
    runs: list[Run] = []
    policies: dict[str, dict[str, Any]] = {}
    workers: list[Worker] = []
    for results, home, label in zip(folders, homes, labels, strict=True):
        new_names = {}
        for case in results.cases:
            clashes = case.policy in clashing
            new_names[case.policy] = f"{case.policy} ({label})" if clashes else case.policy

        earlier_runs = len(runs)
        prefix = home.relative_to(base)
        for case in results.cases:
            moved = _moved(case, prefix, earlier_runs)
            cases.append(replace(moved, policy=new_names[case.policy]))

        for policy, metadata in results.policies.items():
            policies[new_names.get(policy, policy)] = metadata
        for worker in results.workers:
            policy = new_names.get(worker.policy, worker.policy)
            workers.append(replace(worker, policy=policy, run=worker.run + earlier_runs))
        runs += [replace(run, run=run.run + earlier_runs) for run in results.runs]

    subfolders_first = tuple(sorted(homes, reverse=True))
    return Results(base, tuple(cases), tuple(runs), policies, tuple(workers), subfolders_first)


def _moved(case: CaseResults, prefix: Path, earlier_runs: int) -> CaseResults:
    """Return the case with the paths of its videos below `prefix`, and with `earlier_runs` added to
    its run numbers.
    """
    episodes = []
    for episode in case.episodes:
        videos = tuple(str(prefix / video) for video in episode.videos)
        episodes.append(replace(episode, run=episode.run + earlier_runs, videos=videos))
    attempts = [replace(attempt, run=attempt.run + earlier_runs) for attempt in case.attempts]
    return replace(case, episodes=tuple(episodes), attempts=tuple(attempts))


def _require_different_evaluations(folders: Sequence[Results]) -> None:
    """Raise `ConfigError` if two folders have the same case, since they are then parts of one
    evaluation.
    """
    first_folders: dict[str, Path] = {}
    for results in folders:
        for case in results.cases:
            first = first_folders.setdefault(case.case_id, results.out)
            if first is not results.out:
                raise ConfigError(
                    f"report: {first} and {results.out} both have {case.policy_id!r} in "
                    f"{case.env!r} with the same settings; put parts of one evaluation into one "
                    f"folder first: `vlagents-ray merge {first} {results.out} --out OUT`, with "
                    "--accept-changes if code or weights changed between them"
                )


def _clashing_policies(folders: Sequence[Results]) -> set[str]:
    """Return the policies that differ between folders, or occur more than once in an env."""
    all_cases: list[CaseResults] = []
    for results in folders:
        all_cases += results.cases
    counts = Counter((case.policy_id, case.suite, case.env) for case in all_cases)
    clashing = {
        case.policy for case in all_cases if counts[case.policy_id, case.suite, case.env] > 1
    }

    known_weights: dict[tuple[str, str | None], str] = {}  # keys: (policy id, checkpoint)
    for case in all_cases:
        weights, checkpoint = reported(case, "weights"), reported(case, "checkpoint")
        if weights is None:
            continue
        if known_weights.setdefault((case.policy_id, checkpoint), weights) != weights:
            clashing.add(case.policy)

    swept = {case.policy for case in all_cases if case.step is not None}
    # Metadata of each policy from the first folder with the policy, completed with fields that only
    # later folders have.
    first_metadata: dict[str, dict[str, Any]] = {}
    for results in folders:
        for name, metadata in results.policies.items():
            first = first_metadata.setdefault(name, metadata)
            if changed(first, metadata, swept=name in swept) is not None:
                clashing.add(name)
            first_metadata[name] = with_known(first, metadata)
    return clashing
