"""Results of several folders, merged into a new folder."""

from __future__ import annotations

import itertools
import json
import sqlite3
from collections.abc import Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate.artifacts import storage
from vlagents_ray.evaluate.plan.config import canonical
from vlagents_ray.evaluate.report.page import FILE as REPORT
from vlagents_ray.evaluate.report.page import write_report
from vlagents_ray.evaluate.results.changes import (
    Change,
    EnvStatement,
    changed,
    env_changes,
    listed,
    policy_changes,
    program_changes,
    with_known,
)
from vlagents_ray.evaluate.results.combination import require_distinct
from vlagents_ray.evaluate.results.database import FILE, create, insert
from vlagents_ray.evaluate.results.reader import Results, episode_of, reading, table
from vlagents_ray.evaluate.results.summary import Summary, summarize, write_summary

_SHOWN = 10  # maximum number of conflicts in a message
Row = dict[str, Any]
_Name = tuple[str, str, str, str]  # policy, step, suite and env of a case


@dataclass(slots=True)
class _Merged:
    """The tables of the merged results, by key; `home` is the folder of an episode's files."""

    swept: set[str]  # policies with steps in any folder

    runs: list[Row] = field(default_factory=list)
    policies: dict[str, Row] = field(default_factory=dict)
    cases: dict[str, Row] = field(default_factory=dict)
    episodes: dict[str, Row] = field(default_factory=dict)
    attempts: list[Row] = field(default_factory=list)
    workers: list[Row] = field(default_factory=list)
    home: dict[str, Path] = field(default_factory=dict)
    names: dict[_Name, Row] = field(default_factory=dict)  # a case of each name in any folder


def merge(
    out: Path, folders: Sequence[Path], *, keep_first: bool = False, accept_changes: bool = False
) -> Summary:
    """Merge the results of `folders` into the new folder `out`, which can be resumed.

    An episode with the same outcome in several folders is copied from the first folder; an episode
    with an outcome replaces one that failed because of the infrastructure. Without `keep_first`,
    the order of the folders changes neither a rate nor whether they can be merged.

    Args:
        out: A folder without results; it is created if it is missing.
        folders: Folders of results.
        keep_first: Whether the first folder wins for an episode with different outcomes.
        accept_changes: Whether to merge even if files of a policy or an environment, weights, or
            the description or contract of an environment differ; the report shows the differences.

    Returns:
        The summary of the merged results.

    Raises:
        ConfigError: Cases with the same name have different settings; a case that can stop early
            has different seeds or numbers of episodes; a policy or the files of an
            environment differ between folders and `accept_changes` is off; an episode has different
            outcomes and `keep_first` is off; or an episode's file is missing, or outside of its
            folder because of its path or a symbolic link.
        StorageFailed: The disk is full, or cannot be written to.
    """
    if (out / FILE).exists():
        raise ConfigError(
            f"{out}: has results; merge into a new folder, and name this one among those to be "
            "merged"
        )
    require_distinct(folders)

    merged = _Merged(_swept_policies(folders))
    conflicts: list[str] = []
    for folder in folders:
        with reading(folder) as db:
            changes = _add_policies(merged, folder, db) + _add_cases(merged, folder, db)
            if changes and not accept_changes:
                raise ConfigError(
                    f"{folder} was not run with the same code and files as the folders before "
                    f"it:\n{listed(changes)}\nmerge them separately, or allow the difference, "
                    "which the report then shows (--accept-changes)"
                )

            conflicts += _add_episodes(merged, folder, db)
            if changes:
                last_run = merged.runs[-1]
                changes_of_run = json.loads(last_run["changes"] or "[]")
                changes_of_run += [asdict(change) for change in changes]
                last_run["changes"] = canonical(changes_of_run)

    _require_one_checkpoint(merged, weights_may_differ=accept_changes)
    if conflicts and not keep_first:
        shown = "\n".join(f"- {text}" for text in conflicts[:_SHOWN])
        raise ConfigError(
            f"{len(conflicts)} episodes have different outcomes:\n{shown}\n"
            "find out why (vlagents-ray replay), or keep those of the folders named first "
            "(--keep-first)"
        )

    with storage.storing(out):
        _link_files(merged, out, folders)
        tables = {
            "runs": merged.runs,
            "policies": list(merged.policies.values()),
            "cases": list(merged.cases.values()),
            "episodes": list(merged.episodes.values()),
            "attempts": merged.attempts,
            "workers": merged.workers,
        }
        with storage.whole(out / FILE) as unfinished, closing(sqlite3.connect(unfinished)) as db:
            create(db)
            with db:
                for name, rows in tables.items():
                    for row in rows:
                        insert(db, name, row)

        summary = summarize(Results.load(out))
        write_summary(summary)
    write_report(summary.results, out / REPORT)
    return summary


def _swept_policies(folders: Sequence[Path]) -> set[str]:
    """Return the policies with steps: their servers may have begun with any checkpoint."""
    swept: set[str] = set()
    for folder in folders:
        with reading(folder) as db:
            rows = db.execute("SELECT DISTINCT policy FROM cases WHERE step IS NOT NULL")
            swept |= {name for (name,) in rows}
    return swept


def _add_policies(merged: _Merged, folder: Path, db: sqlite3.Connection) -> list[Change]:
    """Add the policies of a folder; return the changes since the folders before it."""
    changes = []
    for row in table(db, "policies"):
        known = merged.policies.setdefault(row["name"], row)
        before = json.loads(known["metadata"])
        now = json.loads(row["metadata"])
        is_swept = row["name"] in merged.swept
        changes += policy_changes(f"policy {row['name']}", before, now, swept=is_swept)
        difference = changed(before, now, swept=is_swept)
        if difference in ("policy", "checkpoint"):
            raise ConfigError(
                f"{folder}: policy {row['name']!r} has {difference} {now.get(difference)!r}, the "
                f"folders before it have {before.get(difference)!r}; give one of them another "
                "name in its evaluation"
            )
        known["metadata"] = json.dumps(with_known(before, now))
    return changes


def _add_cases(merged: _Merged, folder: Path, db: sqlite3.Connection) -> list[Change]:
    """Add the cases of a folder; return the changes since the folders before it."""
    changes: dict[Change, None] = {}
    for row in table(db, "cases"):
        named = merged.names.setdefault(_name(row), row)
        if named["case_id"] != row["case_id"]:
            before = json.loads(named["settings"])
            differing = []
            for name, value in json.loads(row["settings"]).items():
                if before.get(name) != value:
                    differing.append(f"{name}: {before.get(name)!r} and {value!r}")
            raise ConfigError(
                f"{folder}: {' '.join(filter(None, _name(row)))} has other settings: "
                f"{'; '.join(differing)}"
            )
        if row["case_id"] not in merged.cases:
            merged.cases[row["case_id"]] = row
            continue
        known = merged.cases[row["case_id"]]
        _require_same_stopping(known, row, folder)
        # A suite may have another name in this folder; the choice is the same in any order.
        known["suite"] = min(known["suite"], row["suite"])

        programs = []
        statements = []
        for case in (known, row):
            programs.append(None if case["program"] is None else json.loads(case["program"]))
            described = json.loads(case["described"] or "{}")
            contract = json.loads(case["contract"] or "{}")
            statements.append(EnvStatement(described, contract))
        changes |= dict.fromkeys(program_changes(f"env {row['env']}", *programs))
        changes |= dict.fromkeys(env_changes(row["env"], *statements))

        # An empty description or contract contains no information, so a later one is compared with
        # the first that is not empty. The program of an installed environment is empty.
        for name in ("described", "contract", "code"):
            if known[name] in (None, "{}"):
                known[name] = row[name]
        known["program"] = known["program"] or row["program"]
        _extend(known, row, folder)
    return list(changes)


def _require_same_stopping(known: Row, row: Row, folder: Path) -> None:
    """Raise `ConfigError` if a case stops early by another rule than in the folders before, or in
    another plan: which episodes count depends on their order in the plan.
    """
    where = " ".join(filter(None, _name(row)))
    if known["stop"] != row["stop"]:
        raise ConfigError(
            f"{folder}: {where} stops early by {row['stop']}, but by {known['stop']} in the "
            f"folders before it; merge them separately"
        )
    plans = [(json.loads(case["seeds"]), case["planned"]) for case in (known, row)]
    if known["stop"] is not None and plans[0] != plans[1]:
        (seeds, planned), (now_seeds, now_planned) = plans
        raise ConfigError(
            f"{folder}: {where} can stop early: expected {planned} episodes with the seeds "
            f"{seeds}, as in the folders before it, got {now_planned} with {now_seeds}; merge them "
            "separately, or evaluate without `stop`"
        )


def _name(case: Row) -> _Name:
    step = "" if case["step"] is None else f"step {case['step']}"
    return case["policy"], step, case["suite"], case["env"]


def _extend(case: Row, other: Row, folder: Path) -> None:
    """Plan the seeds of both cases in ascending order, each with the larger number of episodes per
    seed.
    """
    seeds, added = json.loads(case["seeds"]), json.loads(other["seeds"])
    episodes = max(case["planned"] // len(seeds), other["planned"] // len(added))
    ordered = seeds if seeds == added else sorted({*seeds, *added})
    if any(high - low < episodes for low, high in itertools.pairwise(sorted(ordered))):
        raise ConfigError(
            f"{folder}: {case['env']}: expected seeds {episodes} or more apart, as each has "
            f"{episodes} episodes, got {added}, together {ordered}, with which some episodes "
            f"would be run twice"
        )
    # A folder that began after the first results of another one may have been added for them.
    planned_at = max(case["planned_at"], other["planned_at"])
    case |= {
        "seeds": canonical(ordered),
        "planned": episodes * len(ordered),
        "planned_at": planned_at,
    }


def _add_episodes(merged: _Merged, folder: Path, db: sqlite3.Connection) -> list[str]:
    """Add episodes, runs, attempts and workers under new numbers; return the contradictions to
    earlier folders.
    """
    offset = len(merged.runs)
    runs = {row["run"]: offset + i for i, row in enumerate(table(db, "runs"), 1)}
    merged.runs += [row | {"run": runs[row["run"]]} for row in table(db, "runs")]
    merged.attempts += [row | {"run": runs[row["run"]]} for row in table(db, "attempts")]
    merged.workers += [row | {"run": runs[row["run"]]} for row in table(db, "workers")]

    conflicts = []
    for row in table(db, "episodes"):
        row["run"] = runs[row["run"]]
        known = merged.episodes.get(row["key"])
        if known is None or (known["status"] == "infra_failed" and row["status"] != "infra_failed"):
            merged.episodes[row["key"]] = row
            merged.home[row["key"]] = folder
        elif row["status"] != "infra_failed":
            before = episode_of(dict(known)).result.outcome
            now = episode_of(dict(row)).result.outcome
            differing = []
            for name in before:
                if before[name] != now[name]:
                    differing.append(f"{name} is {before[name]!r} and {now[name]!r}")
            if differing:
                conflicts.append(
                    f"{row['key']}: {', '.join(differing)} in {merged.home[row['key']]} and "
                    f"{folder}"
                )
    return conflicts


def _require_one_checkpoint(merged: _Merged, *, weights_may_differ: bool) -> None:
    """Raise `ConfigError` if a case has several checkpoints, or a checkpoint of a policy several
    weights.
    """
    # For each case: the key of one episode per checkpoint.
    checkpoints: dict[str, dict[str, str]] = {}
    # For each policy, step and checkpoint: the key of one episode per version of the weights.
    weights: dict[tuple[str, int | None, str | None], dict[str, str]] = {}
    for row in merged.episodes.values():
        case = merged.cases[row["case_id"]]
        checkpoint = row["checkpoint"]
        if checkpoint is not None:
            keys_by_checkpoint = checkpoints.setdefault(row["case_id"], {})
            keys_by_checkpoint.setdefault(checkpoint, row["key"])
        if row["weights"] is not None:
            keys_by_weights = weights.setdefault((case["policy"], case["step"], checkpoint), {})
            keys_by_weights.setdefault(row["weights"], row["key"])

    for case_id, keys in checkpoints.items():
        _require_one(merged.cases[case_id]["env"], "checkpoints", keys)
    if not weights_may_differ:
        for (policy, _, checkpoint), keys in weights.items():
            _require_one(f"{policy} {checkpoint!r}", "weights under one name", keys)


def _require_one(subject: str, kind: str, keys: dict[str, str]) -> None:
    """Raise `ConfigError` if `keys` has several entries, each with the key of an episode."""
    if len(keys) > 1:
        raise ConfigError(
            f"{subject}: was run by several {kind}: {keys}; merge these episodes separately, or "
            f"set another `name` for one of the policies in its evaluation"
        )


def _link_files(merged: _Merged, out: Path, folders: Sequence[Path]) -> None:
    """Link the files of all episodes into `out`."""
    sources: dict[Path, Path] = {}
    for key, row in merged.episodes.items():
        home = merged.home[key]
        paths: list[str] = json.loads(row["videos"])
        if row["trajectory"] is not None:
            paths += [*storage.trajectory_videos(home, row["trajectory"]), row["trajectory"]]
        for path in paths:
            sources[out / path] = storage.require_there(storage.inside(home, path))

    for folder in folders:
        for diff in sorted((folder / storage.PROVENANCE).glob("*.diff")):
            name = f"{storage.PROVENANCE}/{diff.name}"
            sources[out / name] = storage.inside(folder, name)

    # All files have been checked above, before the first one is written.
    for target, source in sources.items():
        storage.link_or_copy(source, target)
