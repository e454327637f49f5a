"""Plays a recorded episode again, and compares the two."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate.artifacts.recorder import Trajectory
from vlagents_ray.evaluate.plan.cases import cells
from vlagents_ray.evaluate.plan.config import EvalConfig
from vlagents_ray.evaluate.results.reader import CellResults, Episode, Results

_FEW = 5  # names in a message


@dataclass(frozen=True, slots=True)
class Recorded:
    """An episode that can be played again."""

    results: Results
    cell: CellResults
    episode: Episode

    @property
    def number_and_seed(self) -> tuple[int, int]:
        """(number, seed) of the episode, for `evaluate(..., only=...)`."""
        return self.episode.result.key.episode, self.episode.result.key.seed

    def config(self, out: Path, *, policy: dict[str, Any] | None = None) -> EvalConfig:
        """Settings of an evaluation of this episode's cell alone into `out`, with video and trajectory.

        They are those of its run. `policy` replaces settings of the policy.
        """
        run = next(run for run in self.results.runs if run.run == self.episode.run)
        config = EvalConfig.model_validate(run.config)
        where = (self.cell.contender, self.cell.suite, self.cell.env)
        cell = next(one for one in cells(config) if one.name == where)
        given = cell.policy.model_dump() | {"steps": [cell.step] if cell.policy.steps else []}
        if cell.policy.source is None:
            given |= {"config": {}}  # the server has its own configuration
        else:
            given |= {"url": None}  # it was served for that run, and is served again
        if policy is not None:
            given = {name: value for name, value in given.items() if name != "name"} | policy
        suite = cell.suite.model_dump() | {"envs": [cell.env], "worker": cell.worker.model_dump()}
        alone = {"policies": [given], "suites": [suite], "out": out, "workers": None, "resume": False}
        return EvalConfig.model_validate(config.model_dump() | alone | {"video": "all", "record": "all", "track": []})


def find(results: Results, name: str) -> Recorded:
    """Find the episode with the key `name`, or the only one with number N in an env, as "ENV#N".

    Raises `ConfigError` if there is none, if there are several, or if it failed by infrastructure.
    """
    found = [
        Recorded(results, cell, one)
        for cell in results.cells
        for one in cell.episodes
        if name in (one.result.full_key, str(one.result.key), f"{cell.env}#{one.result.key.episode}")
    ]
    if not found:
        have = [one.result.full_key for cell in results.cells for one in cell.episodes][:_FEW]
        raise ConfigError(f"{results.out}: has no episode {name!r}, want a key as {have}, or ENV#NUMBER")
    if len(found) > 1:
        keys = [f"{one.episode.result.full_key} ({one.cell.contender})" for one in found]
        raise ConfigError(f"{name!r} stands for {len(found)} episodes; want one of the keys {keys}")
    if found[0].episode.result.status == "infra_failed":
        raise ConfigError(f"{name!r} was never played to its end: {found[0].episode.result.error}")
    return found[0]


def compare(recorded: Recorded, replayed: Results) -> list[str]:
    """Return the differences of the replay, a sentence each; empty if it is the same episode.

    Actions are compared byte for byte, durations not at all. Raises `ConfigError` if infrastructure failed the replay.
    """
    [[again]] = [cell.episodes for cell in replayed.cells]
    if again.result.status == "infra_failed":
        raise ConfigError(f"the replay did not end, so that there is nothing to compare: {again.result.error}")
    before, now = recorded.episode.result.outcome, again.result.outcome
    found = [
        f"{name}: {before[name]!r} was recorded, now it is {now[name]!r}"
        for name in before
        if before[name] != now[name] and name not in ("key", "actions_sha256")
    ]
    if before["actions_sha256"] != now["actions_sha256"]:
        found.insert(0, _actions(recorded, replayed.file(str(again.trajectory))))
    weights = [one.result.weights for one in (recorded.episode, again)]
    if found and None not in weights and weights[0] != weights[1]:
        found.append(
            f"weights: {weights[0]} played it, now it is {weights[1]}: another checkpoint, or other files in it"
        )
    return found


def _actions(recorded: Recorded, replayed: Path) -> str:
    path = recorded.episode.trajectory
    if path is None:
        return (
            "actions: they differ; from which step on is not known, as no trajectory was recorded "
            "(eval --record all, or `record: all` in its file)"
        )
    file = recorded.results.file(path)
    if not file.is_file():
        return f"actions: they differ; from which step on is not known, as {file}, the recorded trajectory, is gone"
    before = Trajectory.load(file).actions
    now = Trajectory.load(replayed).actions
    rows = zip(before, now, strict=False)
    step = next((i for i, (a, b) in enumerate(rows) if a.tobytes() != b.tobytes()), None)
    if step is None:
        same = min(len(before), len(now))
        return f"actions: {len(before)} were recorded, now they are {len(now)}; the first {same} are the same"
    return f"actions: they differ from step {step} on: {_row(before[step])} was recorded, now it is {_row(now[step])}"


def _row(action: np.ndarray) -> str:
    return f"[{', '.join(f'{value:.9g}' for value in action)}]"
