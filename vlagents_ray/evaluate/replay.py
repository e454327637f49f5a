"""Runs a recorded episode again, and compares the replay with the recording."""

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

_FEW = 5  # maximum number of names in a message
# The largest differences that count as rounding: absolute for numbers up to 1, relative for larger
# numbers. At the first step that differs, another batch size causes differences of 1e-7 to 1e-5.
# Later steps amplify these differences, since each observation depends on the actions before it.
ROUNDING = 1e-4
DRIFT = 1e-2


@dataclass(frozen=True, slots=True)
class ActionsDifference:
    """The differences between the actions of two episodes of the same length. They are absolute for
    numbers up to 1, and relative for larger numbers.
    """

    step: int  # the first step that differs; the observations up to it were equal
    at_first: float  # the largest difference at that step
    largest: float  # the largest difference at any step

    @property
    def is_rounding(self) -> bool:
        """Whether rounding explains the difference, at the first step and at later steps."""
        return self.at_first <= ROUNDING and self.largest <= DRIFT


@dataclass(frozen=True, slots=True)
class Recorded:
    """An episode that can be replayed."""

    results: Results
    case: CaseResults
    episode: Episode

    @property
    def number_and_seed(self) -> tuple[int, int]:
        """(number, seed) of the episode, for `evaluate(..., only=...)`."""
        return self.episode.result.key.episode, self.episode.result.key.seed

    @property
    def rows(self) -> int | None:
        """The number of rows of the policy's forward passes; None if the bits of its actions may
        depend on the batch.
        """
        metadata = self.results.policies.get(self.case.policy) or {}
        rows: int | None = (metadata.get("passes") or {}).get("rows")
        return rows

    def config(self, out: Path, *, policy: dict[str, Any] | None = None) -> EvalConfig:
        """Return the settings for an evaluation of only this episode's case, with video and
        trajectory. All other settings are those of the episode's run.

        Args:
            out: The folder of results.
            policy: Replaces settings of the policy.

        Raises:
            ConfigError: The settings of the run do not contain the case.
        """
        run = next(run for run in self.results.runs if run.run == self.episode.run)
        config = EvalConfig.model_validate(run.config)
        # Search the case by its settings, since `merge` may have taken the suite's name from
        # another folder.
        cases = plan_cases(config)
        case = next((case for case in cases if case.fingerprint == self.case.case_id), None)
        if case is None:
            raise ConfigError(
                f"{self.results.out}: expected the case of {self.episode.result.key} in the "
                f"settings of run {run.run}, got other cases; replay the episode in the folder in "
                f"which it was run"
            )

        policy_settings = case.policy.model_dump()
        policy_settings["steps"] = [case.step] if case.policy.steps else []
        if case.policy.source is None:
            policy_settings["config"] = {}  # the server has its own configuration
        else:
            # The policy was served for that run, and will be served again.
            policy_settings["url"] = None
        if policy is not None:
            policy_settings.pop("name", None)
            policy_settings |= policy

        suite = case.suite.model_dump() | {"envs": [case.env], "worker": case.worker.model_dump()}
        only_this_case = {
            "policies": [policy_settings],
            "suites": [suite],
            "out": out,
            "workers": None,
            "resume": False,
        }
        return EvalConfig.model_validate(
            config.model_dump() | only_this_case | {"video": "all", "record": "all", "track": []}
        )


def find(results: Results, name: str | None) -> Recorded:
    """Find the episode with the key `name`; `name` may also be "ENV#N" if only one episode in the
    env has the number N.

    Raises:
        ConfigError: `name` is None, or no episode or several episodes have this name, or the
            episode failed because of infrastructure.
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
        problem = "got none" if name is None else f"got {name!r}, which no episode has"
        raise ConfigError(
            f"{results.out}: expected a key such as {examples}, or ENV#NUMBER, {problem}"
        )

    if len(matching) > 1:
        keys = [
            f"{recorded.episode.result.full_key} ({recorded.case.policy_id})"
            for recorded in matching
        ]
        raise ConfigError(
            f"expected the name of one episode, got {name!r}, which {len(matching)} episodes "
            f"have; use one of the keys {keys}"
        )

    [recorded] = matching
    if recorded.episode.result.status == "infra_failed":
        raise ConfigError(
            f"expected a finished episode, got {name!r}, which never ended: "
            f"{recorded.episode.result.error}"
        )
    return recorded


def compare(recorded: Recorded, replayed: Results) -> list[str]:
    """Return a sentence for each difference between replay and recording; empty if the episodes are
    equal up to rounding.

    Actions with different bytes count as equal if the difference `is_rounding` (see
    `actions_difference`). Then returns also count as equal if they differ by at most `DRIFT`.
    Durations are not compared.

    Raises:
        ConfigError: The replay failed because of infrastructure.
    """
    [[replay]] = [case.episodes for case in replayed.cases]
    if replay.result.status == "infra_failed":
        raise ConfigError(
            f"expected a finished replay to compare, got a failed replay: {replay.result.error}"
        )

    recorded_outcome = recorded.episode.result.outcome
    replayed_outcome = replay.result.outcome
    difference = actions_difference(recorded, replayed)
    is_rounding = difference is not None and difference.is_rounding
    returns = recorded_outcome["episode_return"], replayed_outcome["episode_return"]
    if is_rounding and math.isclose(*returns, rel_tol=DRIFT, abs_tol=DRIFT):
        replayed_outcome = replayed_outcome | {"episode_return": returns[0]}

    differences = []
    if recorded_outcome["actions_sha256"] != replayed_outcome["actions_sha256"] and not is_rounding:
        replayed_trajectory = replayed.file(str(replay.trajectory))
        differences.append(_describe_actions(recorded, replayed_trajectory))
    for name, recorded_value in recorded_outcome.items():
        replayed_value = replayed_outcome[name]
        if recorded_value != replayed_value and name not in ("key", "actions_sha256"):
            differences.append(
                f"{name}: expected {recorded_value!r}, as recorded, got {replayed_value!r}"
            )

    recorded_weights = recorded.episode.result.weights
    replayed_weights = replay.result.weights
    are_known = recorded_weights is not None and replayed_weights is not None
    if differences and are_known and recorded_weights != replayed_weights:
        differences.append(
            f"weights: expected {recorded_weights}, as recorded, got {replayed_weights}: another "
            "checkpoint, or other files in it"
        )
    return differences


def actions_difference(recorded: Recorded, replayed: Results) -> ActionsDifference | None:
    """Return the difference between the recorded and the replayed actions.

    Returns:
        None if they are equal byte for byte, if their numbers differ, or if a trajectory is
        missing.
    """
    [[replay]] = [case.episodes for case in replayed.cases]
    if recorded.episode.result.actions_sha256 == replay.result.actions_sha256:
        return None

    recorded_file = _trajectory_file(recorded.results, recorded.episode)
    replayed_file = _trajectory_file(replayed, replay)
    if recorded_file is None or replayed_file is None:
        return None

    recorded_actions = Trajectory.load(recorded_file).actions.astype(np.float64)
    replayed_actions = Trajectory.load(replayed_file).actions.astype(np.float64)
    if recorded_actions.shape != replayed_actions.shape:
        return None

    absolute = np.abs(recorded_actions - replayed_actions)
    by_step = np.max(absolute / np.maximum(1.0, np.abs(recorded_actions)), axis=1)
    step = int(np.argmax(by_step > 0))
    return ActionsDifference(step, float(by_step[step]), float(by_step.max()))


def _trajectory_file(results: Results, episode: Episode) -> Path | None:
    """Return the file of an episode's trajectory; None if the trajectory was not recorded or is
    missing.
    """
    if episode.trajectory is None:
        return None
    file = results.file(episode.trajectory)
    return file if file.is_file() else None


def _describe_actions(recorded: Recorded, replayed: Path) -> str:
    """Return a sentence about the difference between the actions of the recorded and the replayed
    trajectory.
    """
    path = recorded.episode.trajectory
    if path is None:
        return (
            "actions: they differ, but without a recorded trajectory (eval --record all, or "
            "`record: all` in its file) neither the first step nor the size of the difference is "
            "known; another batch size changes the last digits of an action, by about 1e-7"
        )

    file = recorded.results.file(path)
    if not file.is_file():
        return (
            f"actions: they differ; the first step is not known, as {file}, the recorded "
            "trajectory, is missing"
        )

    recorded_actions = Trajectory.load(file).actions
    replayed_actions = Trajectory.load(replayed).actions
    pairs = zip(recorded_actions, replayed_actions, strict=False)
    for step, (recorded_action, replayed_action) in enumerate(pairs):
        if recorded_action.tobytes() != replayed_action.tobytes():
            return (
                f"actions: they differ from step {step}: expected {_row(recorded_action)}, as "
                f"recorded, got {_row(replayed_action)}"
            )

    same = min(len(recorded_actions), len(replayed_actions))
    return (
        f"actions: expected {len(recorded_actions)}, as recorded, got {len(replayed_actions)}; the "
        f"first {same} are the same"
    )


def _row(action: np.ndarray) -> str:
    return f"[{', '.join(f'{value:.9g}' for value in action)}]"
