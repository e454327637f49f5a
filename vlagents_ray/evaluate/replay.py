"""Plays a recorded episode again, and compares the two."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate.artifacts.recorder import Trajectory
from vlagents_ray.evaluate.plan.cases import plan_cases
from vlagents_ray.evaluate.plan.config import EvalConfig
from vlagents_ray.evaluate.results.reader import CaseResults, Episode, Results

_FEW = 5  # names in a message
# Largest differences of actions of 1 or less, else relative. At the first step that differs, a
# batch of another size changes 1e-7 to 1e-5. Later steps amplify that, since each observation
# depends on the actions before it.
ROUNDING = 1e-4
DRIFT = 1e-2


@dataclass(frozen=True, slots=True)
class ActionsDifference:
    """By how much the actions of two episodes of one length differ: absolutely, or relatively to
    numbers above 1.
    """

    step: int  # the first that differs; the observations until then were the same
    at_first: float  # the largest of a number of that step's action
    largest: float  # of all steps

    @property
    def is_rounding(self) -> bool:
        """Whether another rounding explains the difference, at the first step and as it grew
        later.
        """
        return self.at_first <= ROUNDING and self.largest <= DRIFT


@dataclass(frozen=True, slots=True)
class Recorded:
    """An episode that can be played again."""

    results: Results
    case: CaseResults
    episode: Episode

    @property
    def number_and_seed(self) -> tuple[int, int]:
        """(number, seed) of the episode, for `evaluate(..., only=...)`."""
        return self.episode.result.key.episode, self.episode.result.key.seed

    def config(self, out: Path, *, policy: dict[str, Any] | None = None) -> EvalConfig:
        """Settings of an evaluation of this episode's case alone into `out`, with video and
        trajectory.

        They are those of its run. `policy` replaces settings of the policy.
        """
        run = next(run for run in self.results.runs if run.run == self.episode.run)
        config = EvalConfig.model_validate(run.config)
        # By its settings: `merge` may have taken the suite's name from another folder.
        case = next(
            (one for one in plan_cases(config) if one.fingerprint == self.case.case_id), None
        )
        if case is None:
            raise ConfigError(
                f"{self.results.out}: the settings of run {run.run} have no such case as that of "
                f"{self.episode.result.key}; replay it in the folder in which it was played"
            )
        given = case.policy.model_dump() | {"steps": [case.step] if case.policy.steps else []}
        if case.policy.source is None:
            given |= {"config": {}}  # the server has its own configuration
        else:
            given |= {"url": None}  # it was served for that run, and is served again
        if policy is not None:
            given = {name: value for name, value in given.items() if name != "name"} | policy
        suite = case.suite.model_dump() | {"envs": [case.env], "worker": case.worker.model_dump()}
        alone = {
            "policies": [given],
            "suites": [suite],
            "out": out,
            "workers": None,
            "resume": False,
        }
        return EvalConfig.model_validate(
            config.model_dump() | alone | {"video": "all", "record": "all", "track": []}
        )


def find(results: Results, name: str | None) -> Recorded:
    """Find the episode with the key `name`, or the only one with number N in an env, as "ENV#N".

    Raises `ConfigError` if no name is given, if there is none, if there are several, or if it
    failed by infrastructure.
    """
    matching = []
    for case in results.cases:
        for episode in case.episodes:
            result = episode.result
            names = (result.full_key, str(result.key), f"{case.env}#{result.key.episode}")
            if name in names:
                matching.append(Recorded(results, case, episode))

    if not matching:
        examples = [episode.result.full_key for episode in results.episodes[:_FEW]]
        problem = "got no episode" if name is None else f"has no episode {name!r}"
        raise ConfigError(f"{results.out}: {problem}, want a key as {examples}, or ENV#NUMBER")
    if len(matching) > 1:
        keys = [
            f"{recorded.episode.result.full_key} ({recorded.case.contender})"
            for recorded in matching
        ]
        raise ConfigError(
            f"{name!r} stands for {len(matching)} episodes; want one of the keys {keys}"
        )
    [recorded] = matching
    if recorded.episode.result.status == "infra_failed":
        raise ConfigError(f"{name!r} was never played to its end: {recorded.episode.result.error}")
    return recorded


def compare(recorded: Recorded, replayed: Results) -> list[str]:
    """Return the differences of the replay, a sentence each; empty if it is the same episode up to
    rounding.

    Actions that differ in their bytes are the same if that `is_rounding` (see
    `actions_difference`), and so are then returns that differ by no more than `DRIFT`. Durations
    are not compared. Raises `ConfigError` if infrastructure failed the replay.
    """
    [[again]] = [case.episodes for case in replayed.cases]
    if again.result.status == "infra_failed":
        raise ConfigError(
            f"the replay did not end, so that there is nothing to compare: {again.result.error}"
        )
    before, now = recorded.episode.result.outcome, again.result.outcome
    difference = actions_difference(recorded, replayed)
    is_rounding = difference is not None and difference.is_rounding
    returns = before["episode_return"], now["episode_return"]
    if is_rounding and math.isclose(*returns, rel_tol=DRIFT, abs_tol=DRIFT):
        now = now | {"episode_return": before["episode_return"]}
    found = [
        f"{name}: {before[name]!r} was recorded, now it is {now[name]!r}"
        for name in before
        if before[name] != now[name] and name not in ("key", "actions_sha256")
    ]
    if before["actions_sha256"] != now["actions_sha256"] and not is_rounding:
        found.insert(0, _actions(recorded, replayed.file(str(again.trajectory))))
    weights = [one.result.weights for one in (recorded.episode, again)]
    if found and None not in weights and weights[0] != weights[1]:
        found.append(
            f"weights: {weights[0]} played it, now it is {weights[1]}: another checkpoint, or "
            "other files in it"
        )
    return found


def actions_difference(recorded: Recorded, replayed: Results) -> ActionsDifference | None:
    """Return by how much the replayed actions differ.

    Returns:
        None if they are equal byte for byte, if their numbers differ, or if a trajectory is
        missing.
    """
    [[again]] = [case.episodes for case in replayed.cases]
    if recorded.episode.result.actions_sha256 == again.result.actions_sha256:
        return None
    paths = [
        None if one.trajectory is None else results.file(one.trajectory)
        for results, one in ((recorded.results, recorded.episode), (replayed, again))
    ]
    if not all(path is not None and path.is_file() for path in paths):
        return None
    before, now = (
        Trajectory.load(path).actions.astype(np.float64) for path in paths if path is not None
    )
    if before.shape != now.shape:
        return None
    by_step = np.max(np.abs(before - now) / np.maximum(1.0, np.abs(before)), axis=1)
    step = int(np.argmax(by_step > 0))
    return ActionsDifference(step, float(by_step[step]), float(by_step.max()))


def _actions(recorded: Recorded, replayed: Path) -> str:
    if (path := recorded.episode.trajectory) is None:
        return (
            "actions: they differ; from which step on is not known, nor whether by more than "
            "rounding, as no trajectory was recorded (eval --record all, or `record: all` in its "
            "file); the size of a batch, which several episodes share, changes the last digits of "
            "an action, about 1e-7"
        )
    file = recorded.results.file(path)
    if not file.is_file():
        return (
            f"actions: they differ; from which step on is not known, as {file}, the recorded "
            "trajectory, is gone"
        )
    before = Trajectory.load(file).actions
    now = Trajectory.load(replayed).actions
    rows = zip(before, now, strict=False)
    step = next((i for i, (a, b) in enumerate(rows) if a.tobytes() != b.tobytes()), None)
    if step is None:
        same = min(len(before), len(now))
        return (
            f"actions: {len(before)} were recorded, now they are {len(now)}; the first {same} "
            "are the same"
        )
    return (
        f"actions: they differ from step {step} on: {_row(before[step])} was recorded, now it "
        f"is {_row(now[step])}"
    )


def _row(action: np.ndarray) -> str:
    return f"[{', '.join(f'{value:.9g}' for value in action)}]"
