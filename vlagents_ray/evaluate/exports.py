"""A table with one row for each episode, as JSON or CSV.

The names and types of the columns never change, and new columns are added at the end.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Any, Literal

from vlagents_ray.evaluate.artifacts.storage import require_folder_of, whole
from vlagents_ray.evaluate.plan.config import canonical
from vlagents_ray.evaluate.results.reader import CaseResults, Episode, Results

# First characters of a text that a spreadsheet reads as a formula, which could send the table to
# another person: https://owasp.org/www-community/attacks/CSV_Injection
_FORMULA = ("=", "+", "-", "@", "\t", "\r", "\n")

Type = Literal["string", "integer", "number", "boolean", "time", "json"]


@dataclass(frozen=True, slots=True)
class Column:
    """A column. Any value may be empty, for example if infrastructure failed."""

    name: str
    type: Type
    meaning: str
    value: Callable[[CaseResults, Episode], Any]


# The fields that a lost episode has; nothing else was measured.
_OF_LOST = {"full_key", "status", "error"}


def _of_result(name: str, value_type: Type, meaning: str, field: str | None = None) -> Column:
    field = field or name

    def value(_case: CaseResults, episode: Episode) -> Any:
        is_lost = episode.result.status == "infra_failed"
        return None if is_lost and field not in _OF_LOST else getattr(episode.result, field)

    return Column(name, value_type, meaning, value)


def _of_case(name: str, value_type: Type, meaning: str) -> Column:
    return Column(name, value_type, meaning, lambda case, _episode: getattr(case, name))


def _of_episode(name: str, value_type: Type, meaning: str) -> Column:
    return Column(name, value_type, meaning, lambda _case, episode: getattr(episode, name))


def _share(_case: CaseResults, episode: Episode) -> float | None:
    time_share = episode.result.time_share
    return None if time_share is None else time_share.share


COLUMNS = (
    _of_result(
        "key",
        "string",
        "identifies the episode by everything that determines it, including the weights",
        "full_key",
    ),
    _of_case("policy", "string", "name of the policy in the evaluation"),
    _of_case("step", "integer", "training step, in a sweep over checkpoints"),
    _of_result("checkpoint", "string", "checkpoint that the policy reported at the reset"),
    _of_result(
        "weights", "string", "digest of the checkpoint's weights; null if the policy reports none"
    ),
    _of_result(
        "policy_version",
        "integer",
        "version of the weights used for the last action; 0 is the loaded checkpoint",
    ),
    _of_result(
        "policy_fingerprint",
        "string",
        "fingerprint of that version, computed by the replica from the weights in memory",
    ),
    _of_result(
        "first_policy_version", "integer", "version of the weights used for the first action"
    ),
    _of_case("suite", "string", "name of the suite in the evaluation"),
    _of_case("env", "string", "full name, with the task"),
    Column(
        "episode",
        "integer",
        "number of the episode, from 0",
        lambda _case, episode: episode.result.key.episode,
    ),
    Column(
        "seed",
        "integer",
        "seed of the env's and the policy's reset",
        lambda _case, episode: episode.result.key.seed,
    ),
    _of_case(
        "settings",
        "json",
        "all other settings of the episode: options of env and policy, checkpoint, codec",
    ),
    _of_case("described", "json", "the env's description of itself: versions, protocol"),
    _of_case("code", "json", "git commit of the env, and the SHA-256 of uncommitted changes"),
    _of_result(
        "status",
        "string",
        "done; policy_error: the policy failed; infra_failed: lost, excluded from all rates",
    ),
    Column(
        "counted",
        "boolean",
        "whether the rates include the episode",
        lambda _case, episode: episode.counts,
    ),
    _of_result("success_once", "boolean", "the task was solved after some step"),
    _of_result("success_at_end", "boolean", "the task was solved after the last step"),
    _of_result("first_success", "integer", "steps after which the task was first solved"),
    _of_result("steps", "integer", "actions executed"),
    _of_result("return", "number", "sum of the rewards", "episode_return"),
    _of_result("ending", "string", "terminated, truncated, policy_done or error"),
    _of_result("instruction", "string", "the task in words"),
    _of_result(
        "start", "string", "name of the initial state, which equal starts share; null on a robot"
    ),
    _of_result("error", "string", "error, if the status is not done"),
    _of_result(
        "actions_sha256",
        "string",
        "SHA-256 of the executed actions: (steps, D) little-endian float32",
    ),
    _of_result("seconds", "number", "duration from the reset to the last step"),
    _of_result("reset_ms", "number", "duration of the env's reset"),
    _of_result("env_step_ms", "number", "median of the env's steps"),
    _of_result(
        "env_seconds", "number", "duration of the env's reset and all its steps; null on a robot"
    ),
    _of_result(
        "acts",
        "integer",
        "number of answers of the policy; if they are chunks, fewer than `steps`",
    ),
    _of_result(
        "policy_ms", "number", "median latency of the policy's answers, including transport"
    ),
    _of_result("policy_p95_ms", "number", "their 95th percentile"),
    _of_result(
        "policy_seconds",
        "number",
        "time that the policy computed for the episode: its share of each batch",
    ),
    _of_result(
        "latency_ms", "number", "in real-time mode: median latency of an answer, in the env's time"
    ),
    _of_result("ticks_waited", "integer", "steps executed while the policy computed"),
    _of_result("timing_ms", "json", "median duration of each stage of an answer on the server"),
    _of_result("transport", "string", "transport of the observations"),
    _of_episode("attempts", "integer", "1, and one more for each failure of infrastructure"),
    _of_episode(
        "run",
        "integer",
        "number of the command that ran the episode, from 1; resuming adds one",
    ),
    Column(
        "finished",
        "time",
        "time at which the episode was recorded",
        lambda _, episode: datetime.fromtimestamp(episode.finished, timezone.utc),
    ),
    _of_episode("videos", "json", "paths in the folder of results"),
    _of_episode("trajectory", "string", "path in the folder of results"),
    _of_result(
        "revision",
        "string",
        "the hub's commit of the checkpoint, if it was loaded from the hub's cache",
    ),
    _of_episode(
        "env_program",
        "string",
        "digest of the software that runs the episode and of the env's files, including its code",
    ),
    _of_episode(
        "policy_program",
        "string",
        "digest of the software of the policy's server, its files and code, and the values of a "
        "factory; null if its server reports none",
    ),
    _of_result(
        "ticks",
        "integer",
        "ticks at which the policy was to act; null where the env waits for the policy",
    ),
    _of_result("starved", "integer", "number of these ticks for which no action had arrived"),
    Column("share", "number", "share of the ticks in time, in [0, 1]", _share),
    _of_result("age_p50_ms", "number", "median age of the executed actions"),
    _of_result("age_p95_ms", "number", "their 95th percentile"),
    _of_result("age_p99_ms", "number", "their 99th percentile"),
)


def rows(results: Results, *, flat: bool = False) -> Iterator[dict[str, Any]]:
    """Yield a dict for each recorded episode, with a Python value for each column. Values of the
    type "json" are nested or, if `flat`, text.
    """
    for case in results.cases:
        for episode in case.episodes:
            row = {}
            for column in COLUMNS:
                value = column.value(case, episode)
                row[column.name] = canonical(value) if flat and column.type == "json" else value
            yield row


def to_json(results: Results, path: Path) -> int:
    """Write a list with one object for each episode; times are in ISO 8601 and UTC.

    Returns:
        The number of episodes.
    """
    require_folder_of(path)
    episodes = list(rows(results))
    text = json.dumps(episodes, indent=1, default=_text, ensure_ascii=False)
    with whole(path) as temporary:
        temporary.write_text(text + "\n", encoding="utf-8")
    return len(episodes)


def to_csv(results: Results, path: Path) -> int:
    """Write a header, and a line for each episode. None is written as an empty field, and a boolean
    as `true` or `false`. A text that a spreadsheet would read as a formula begins with "'".

    Returns:
        The number of episodes.
    """
    require_folder_of(path)
    number = 0
    with whole(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, [column.name for column in COLUMNS])
        writer.writeheader()
        for row in rows(results, flat=True):
            for name, value in row.items():
                if isinstance(value, bool):
                    row[name] = str(value).lower()
                elif isinstance(value, datetime):
                    row[name] = _text(value)
                elif isinstance(value, str) and value.startswith(_FORMULA):
                    row[name] = f"'{value}"
            writer.writerow(row)
            number += 1
    return number


def _text(value: object) -> str:
    if isinstance(value, datetime):
        return value.isoformat()
    raise TypeError(f"{type(value).__name__} is not JSON")
