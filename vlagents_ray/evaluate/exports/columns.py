"""The columns of a table of episodes: their names and types stay as they are; new ones come last."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import datetime, timezone
from typing import Any, Literal

from vlagents_ray.evaluate.results import CellResults, Episode, Results

Type = Literal["string", "integer", "number", "boolean", "time", "json"]


@dataclass(frozen=True, slots=True)
class Column:
    """One column. Any may be empty: of an episode that infrastructure failed, little is known."""

    name: str
    type: Type
    meaning: str
    value: Callable[[CellResults, Episode], Any]


def _of_result(name: str, kind: Type, meaning: str, field: str | None = None) -> Column:
    return Column(name, kind, meaning, lambda _cell, episode: getattr(episode.result, field or name))


def _of_cell(name: str, kind: Type, meaning: str) -> Column:
    return Column(name, kind, meaning, lambda cell, _episode: getattr(cell, name))


def _of_episode(name: str, kind: Type, meaning: str) -> Column:
    return Column(name, kind, meaning, lambda _cell, episode: getattr(episode, name))


COLUMNS = (
    Column("key", "string", "stands for all that decides the episode", lambda _cell, episode: str(episode.result.key)),
    _of_cell("policy", "string", "its name in the evaluation"),
    _of_cell("step", "integer", "of training, in a sweep over checkpoints"),
    _of_result("checkpoint", "string", "that the policy's reset named"),
    _of_cell("suite", "string", "its name in the evaluation"),
    _of_cell("env", "string", "full name, with the task"),
    Column("episode", "integer", "its number, from 0", lambda _cell, episode: episode.result.key.episode),
    Column("seed", "integer", "of the env's and the policy's reset", lambda _cell, episode: episode.result.key.seed),
    _of_cell("settings", "json", "all else that decides the episode: options of env and policy, checkpoint, codec"),
    _of_cell("described", "json", "what the env says of itself: versions, protocol"),
    _of_cell("code", "json", "of the env: its git commit, and the SHA-256 of what differed from it"),
    _of_result("status", "string", "done; policy_error: the policy broke it off; infra_failed: it is in no rate"),
    Column("counted", "boolean", "is it in the rates?", lambda _cell, episode: episode.counts),
    _of_result("success_once", "boolean", "the task was solved after some step"),
    _of_result("success_at_end", "boolean", "the task was solved after the last step"),
    _of_result("first_success", "integer", "steps after which it was solved for the first time"),
    _of_result("steps", "integer", "actions executed"),
    _of_result("return", "number", "sum of the rewards", "episode_return"),
    _of_result("ending", "string", "terminated, truncated, policy_done or error"),
    _of_result("instruction", "string", "the task in words"),
    _of_result("error", "string", "of a status other than done"),
    _of_result("actions_sha256", "string", "of the actions as executed: (steps, D) little-endian float32"),
    _of_result("seconds", "number", "from reset to the last step"),
    _of_result("reset_ms", "number", "of the env"),
    _of_result("env_step_ms", "number", "median of the env's steps"),
    _of_result("acts", "integer", "answers of the policy; fewer than steps with chunks"),
    _of_result("policy_ms", "number", "median of the policy's answers, transport included"),
    _of_result("policy_p95_ms", "number", "their 95th percentile"),
    _of_result("latency_ms", "number", "in real-time mode: what one answer took of the env's time, median"),
    _of_result("ticks_waited", "integer", "steps executed while the policy thought"),
    _of_result("ticks_held", "integer", "of them those with no row of a chunk left"),
    _of_result("timing_ms", "json", "medians of what the server says of one answer, by stage"),
    _of_result("transport", "string", "how observations went to the policy"),
    _of_episode("attempts", "integer", "1, and one more for each that infrastructure failed"),
    _of_episode("run", "integer", "which run over the plan it was played in, from 1"),
    Column("finished", "time", "when it was recorded", lambda _cell, episode: _time(episode.finished)),
    _of_episode("videos", "json", "paths in the folder of results"),
    _of_episode("trajectory", "string", "likewise"),
)  # fmt: skip


def rows(results: Results) -> Iterator[dict[str, Any]]:
    """Every recorded episode: Python values by the columns' names, those of type "json" still nested."""
    for cell in results.cells:
        for episode in cell.episodes:
            yield {column.name: column.value(cell, episode) for column in COLUMNS}


def _time(seconds: float) -> datetime:
    return datetime.fromtimestamp(seconds, timezone.utc)
