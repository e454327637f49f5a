"""Results of several machines in one folder: each episode once."""

from __future__ import annotations

import itertools
import json
import sqlite3
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate.config import canonical
from vlagents_ray.evaluate.files import PROVENANCE, link_or_copy, whole
from vlagents_ray.evaluate.html import FILE as REPORT
from vlagents_ray.evaluate.html import write_report
from vlagents_ray.evaluate.results import Results, episode_of, reading, table
from vlagents_ray.evaluate.schema import FILE, SCHEMA, VERSION, WORKERS
from vlagents_ray.evaluate.store import IDENTITY
from vlagents_ray.evaluate.summary import Summary, summarize, write_summary

_SHOWN = 10  # conflicts in a message
Row = dict[str, Any]


@dataclass(slots=True)
class _Merged:
    """The tables to be, by their keys; `home` says where an episode's files are."""

    runs: list[Row] = field(default_factory=list)
    policies: dict[str, Row] = field(default_factory=dict)
    cells: dict[str, Row] = field(default_factory=dict)
    episodes: dict[str, Row] = field(default_factory=dict)
    attempts: list[Row] = field(default_factory=list)
    workers: list[Row] = field(default_factory=list)
    home: dict[str, Path] = field(default_factory=dict)


def merge(out: Path, folders: Sequence[Path], *, keep_first: bool = False) -> Summary:
    """Put the results of `folders` together in the new folder `out`, which can be resumed.

    An episode with the same outcome in several is there once, as the first has it; one that infrastructure failed
    gives way to one that was played. Raises `ConfigError` if cells of one name have different settings, if a policy
    is not the same everywhere, and for an episode with different outcomes, unless `keep_first`.
    """
    if (out / FILE).exists():
        raise ConfigError(f"{out}: has results; merge into a new folder, and name this one among those to be merged")
    merged = _Merged()
    conflicts: list[str] = []
    for folder in folders:
        with reading(folder) as db:
            _add_policies(merged, folder, db)
            _add_cells(merged, folder, db)
            conflicts += _add_episodes(merged, folder, db)
    _require_one_checkpoint(merged)
    if conflicts and not keep_first:
        shown = "\n".join(f"- {text}" for text in conflicts[:_SHOWN])
        raise ConfigError(
            f"{len(conflicts)} episodes have different outcomes:\n{shown}\n"
            f"find out why (vlagents-ray replay), or keep those of the folders named first (--keep-first)"
        )
    _link_files(merged, out, folders)
    with whole(out / FILE) as part:
        _write(merged, part)
    summary = summarize(Results.load(out))
    write_summary(summary)
    write_report(summary.results, out / REPORT)
    return summary


def _add_policies(merged: _Merged, folder: Path, db: sqlite3.Connection) -> None:
    # As in `Store.note_policy`: in a sweep the server's own checkpoint may be any.
    swept = {name for (name,) in db.execute("SELECT DISTINCT policy FROM cells WHERE step IS NOT NULL")}
    for row in table(db, "policies"):
        known = merged.policies.setdefault(row["name"], row)
        before, now = json.loads(known["metadata"]), json.loads(row["metadata"])
        identity = IDENTITY[:1] if row["name"] in swept else IDENTITY
        if differing := [what for what in identity if before.get(what) != now.get(what)]:
            raise ConfigError(
                f"{folder}: policy {row['name']!r} has {differing[0]} {now.get(differing[0])!r}, that of the folders "
                f"before it {before.get(differing[0])!r}; give one of them another name in its evaluation"
            )


def _add_cells(merged: _Merged, folder: Path, db: sqlite3.Connection) -> None:
    names = {_name(row): row for row in merged.cells.values()}
    for row in table(db, "cells"):
        known = merged.cells.get(row["cell"]) or names.setdefault(_name(row), row)  # a suite may have a new name
        if known["cell"] != row["cell"]:
            before, now = json.loads(known["settings"]), json.loads(row["settings"])
            odd = [f"{k}: {before.get(k)!r} and {now.get(k)!r}" for k in now if before.get(k) != now.get(k)]
            raise ConfigError(f"{folder}: {' '.join(filter(None, _name(row)))} has other settings: {'; '.join(odd)}")
        if known is row:
            merged.cells[row["cell"]] = row
            continue
        if known["stop"] != row["stop"]:
            where = " ".join(filter(None, _name(row)))
            raise ConfigError(f"{folder}: {where} stops early by {row['stop']}, that before it by {known['stop']}")
        for name in ("described", "contract", "code"):
            known[name] = known[name] or row[name]
        _extend(known, row, folder)


def _name(cell: Row) -> tuple[str, str, str, str]:
    step = "" if cell["step"] is None else f"step {cell['step']}"
    return cell["policy"], step, cell["suite"], cell["env"]


def _extend(cell: Row, other: Row, folder: Path) -> None:
    """Plan the seeds of both; of each as many episodes as the one that planned more."""
    seeds, added = json.loads(cell["seeds"]), json.loads(other["seeds"])
    episodes = max(cell["planned"] // len(seeds), other["planned"] // len(added))
    seeds += [seed for seed in added if seed not in seeds]
    ordered = sorted(seeds)
    if any(high - low < episodes for low, high in itertools.pairwise(ordered)):
        raise ConfigError(
            f"{folder}: {cell['env']} has the seeds {added}; together they are {ordered}, and with {episodes} episodes "
            f"of each some would be played twice; want them {episodes} or more apart"
        )
    cell |= {"seeds": canonical(seeds), "planned": episodes * len(seeds)}


def _add_episodes(merged: _Merged, folder: Path, db: sqlite3.Connection) -> list[str]:
    """Also runs, attempts and workers, which are numbered anew; returns what contradicts the folders before it."""
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
            merged.episodes[row["key"]], merged.home[row["key"]] = row, folder
        elif row["status"] != "infra_failed" and (odd := _differences(known, row)):
            conflicts.append(f"{row['key']}: {odd} in {merged.home[row['key']]} and {folder}")
    return conflicts


def _differences(known: Row, row: Row) -> str:
    before, now = episode_of(dict(known)).result.outcome, episode_of(dict(row)).result.outcome
    return ", ".join(f"{name} is {before[name]!r} and {now[name]!r}" for name in before if before[name] != now[name])


def _require_one_checkpoint(merged: _Merged) -> None:
    played: dict[str, dict[str, str]] = {}
    for row in merged.episodes.values():
        if row["checkpoint"] is not None:
            played.setdefault(row["cell"], {}).setdefault(row["checkpoint"], row["key"])
    for cell, checkpoints in played.items():
        if len(checkpoints) > 1:
            raise ConfigError(f"{merged.cells[cell]['env']}: was played by several checkpoints: {checkpoints}")


def _link_files(merged: _Merged, out: Path, folders: Sequence[Path]) -> None:
    for key, row in merged.episodes.items():
        home = merged.home[key]
        paths = [home / path for path in json.loads(row["videos"])]
        if row["trajectory"] is not None:
            numbers = home / row["trajectory"]
            paths += [*sorted(numbers.parent.glob(f"{numbers.stem}_*.mp4")), numbers]
        for path in paths:
            link_or_copy(path, out / path.relative_to(home))
    for folder in folders:
        for path in sorted((folder / PROVENANCE).glob("*.diff")):
            link_or_copy(path, out / PROVENANCE / path.name)


def _write(merged: _Merged, path: Path) -> None:
    tables = {
        "runs": merged.runs,
        "policies": list(merged.policies.values()),
        "cells": list(merged.cells.values()),
        "episodes": list(merged.episodes.values()),
        "attempts": merged.attempts,
        "workers": merged.workers,
    }
    with closing(sqlite3.connect(path)) as db:
        db.executescript(f"BEGIN; {SCHEMA} {WORKERS} PRAGMA user_version = {VERSION}; COMMIT;")
        with db:
            for name, rows in tables.items():
                for row in rows:
                    columns, marks = ", ".join(row), ", ".join("?" * len(row))
                    db.execute(f"INSERT INTO {name} ({columns}) VALUES ({marks})", tuple(row.values()))  # noqa: S608 (our own names)
