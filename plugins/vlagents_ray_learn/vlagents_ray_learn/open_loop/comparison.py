"""A policy's answers to the observations of datasets, with several sessions at once, which it
answers in batches.
"""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from vlagents_ray.client.agent import RemoteAgent
from vlagents_ray.errors import ConfigError, PolicyFailed, VLAgentsError
from vlagents_ray.evaluate.artifacts.storage import storing, whole
from vlagents_ray.interface import Agent
from vlagents_ray.serve.config.deployment import ServerArgs
from vlagents_ray.serve.launch.deployment_file import own_settings, policy_application
from vlagents_ray.serve.local_agent import LocalPolicy
from vlagents_ray.serve.models.checkpoints import CHOICE, STEP
from vlagents_ray.serve.weights import OPTION
from vlagents_ray_learn.open_loop.recorded_dataset import (
    Names,
    RecordedDataset,
    RecordedEpisode,
    RecordedSession,
    RecordedStep,
)

OpenSession = Callable[[], Agent]  # the caller closes the session

FILE = "open_loop.json"
_WORST_FRAMES = 10  # number of frames that the result lists
# Options of a reset, which another policy does not have.
_CHOICES_OF_WEIGHTS = (CHOICE, STEP, OPTION)


@contextmanager
def candidate(source: str) -> Iterator[OpenSession]:
    """Load a policy for the duration of the context.

    Args:
        source: The name of a policy, a deployment file, or the URL of a server.

    Yields:
        A function that opens sessions, which share the policy's batches.
    """
    if "://" in source:
        yield partial(RemoteAgent, source, priority="simulation", codec="exact")
        return
    application = policy_application(source)
    with LocalPolicy(
        ServerArgs(**application.args), own_settings(application), threaded=True
    ) as policy:
        policy.initialize()
        yield lambda: policy.sessions(1)[0]


@dataclass
class ErrorTable:
    """Sums over the frames so far, for each step of the horizon (H) and each number of an action
    (D).
    """

    joints: list[str]  # the names of these numbers
    absolute: np.ndarray = field(init=False)  # (H, D), of the absolute errors
    square: np.ndarray = field(init=False)  # (H, D), of the squared errors
    largest: np.ndarray = field(init=False)  # (H, D), largest absolute error
    frames: np.ndarray = field(init=False)  # (H,)

    def __post_init__(self) -> None:
        empty = np.zeros((0, len(self.joints)))
        self.absolute, self.square, self.largest = empty, empty, empty
        self.frames = np.zeros(0, np.int64)

    def add(self, expected: np.ndarray, got: np.ndarray) -> float:
        """Add a frame's chunks, (H, D) each, and return their mean absolute error."""
        rows = len(expected)
        self._extend(rows)
        error = np.abs(got.astype(np.float64) - expected.astype(np.float64))
        self.absolute[:rows] += error
        self.square[:rows] += error**2
        self.largest[:rows] = np.maximum(self.largest[:rows], error)
        self.frames[:rows] += 1
        return float(error.mean())

    def _extend(self, rows: int) -> None:
        """Add steps of the horizon up to that number of rows."""
        missing = rows - len(self.frames)
        if missing <= 0:
            return
        padding = ((0, missing), (0, 0))
        self.absolute = np.pad(self.absolute, padding)
        self.square = np.pad(self.square, padding)
        self.largest = np.pad(self.largest, padding)
        self.frames = np.pad(self.frames, (0, missing))

    def to_json(self) -> dict[str, Any]:
        """Return the errors overall, by joint, by step, and by both, in the units of the
        actions.
        """
        total = max(1, int(self.frames.sum()))
        mae = self.absolute.sum(0) / total
        rmse = np.sqrt(self.square.sum(0) / total)
        largest = self.largest.max(0, initial=0)
        by_joint = [
            {"joint": name, "mae": float(mae[i]), "rmse": float(rmse[i]), "max": float(largest[i])}
            for i, name in enumerate(self.joints)
        ]
        frames = self.frames[:, np.newaxis]
        means = self.absolute / frames
        step_rmse = np.sqrt((self.square / frames).mean(1))
        by_step = [
            {
                "step": step,
                "frames": int(count),
                "mae": float(means[step].mean()),
                "rmse": float(step_rmse[step]),
            }
            for step, count in enumerate(self.frames)
        ]
        return {
            "mae": float(mae.mean()),
            "rmse": float(np.sqrt((rmse**2).mean())),
            "max": float(largest.max(initial=0)),
            "by_joint": by_joint,
            "by_step": by_step,
            "mae_by_step_and_joint": means.tolist(),
        }


@dataclass(frozen=True, slots=True)
class OpenLoopPlan:
    """The settings of a comparison."""

    episodes: Sequence[int] | None = None  # of each dataset; None: all
    # Largest number of compared rows of a chunk; None: all rows that both have.
    horizon: int | None = None
    every: int = 1  # stride of the queried frames in a dataset without recorded answers
    at_once: int = 8  # number of concurrent sessions
    names: Names = field(default_factory=Names)


@dataclass
class OpenLoopResult:
    """The errors of one policy on some datasets."""

    datasets: list[str]
    against: str  # "answers" recorded by a server, or "actions" of the dataset
    table: ErrorTable
    sessions: int = 0
    # Calls that the recording lacks, so that a policy with a history received less.
    missing: int = 0
    # dataset, episode, frame, and its chunk's "mae".
    frames: list[dict[str, Any]] = field(default_factory=list)

    def to_json(self) -> dict[str, Any]:
        errors_of: dict[tuple[str, int], list[float]] = {}
        for frame in self.frames:
            errors_of.setdefault((frame["dataset"], frame["episode"]), []).append(frame["mae"])
        by_episode = [
            {
                "dataset": dataset,
                "episode": episode,
                "frames": len(errors),
                "mae": float(np.mean(errors)),
            }
            for (dataset, episode), errors in sorted(errors_of.items())
        ]
        worst = sorted(self.frames, key=lambda frame: -frame["mae"])[:_WORST_FRAMES]
        return {
            "datasets": self.datasets,
            "against": self.against,
            "sessions": self.sessions,
            "frames": len(self.frames),
            "missing_acts": self.missing,
            **self.table.to_json(),
            "by_episode": by_episode,
            "worst": worst,
        }


def open_datasets(folder: Path) -> list[RecordedDataset]:
    """Open a LeRobotDataset, or all in a folder.

    Raises:
        ConfigError: There is none, or their actions differ.
    """
    own_file = sorted(folder.glob("meta/info.json"))
    files_below = sorted(folder.glob("*/meta/info.json"))
    files = [*own_file, *files_below]
    if not files:
        raise ConfigError(
            f"{folder}: expected a LeRobotDataset, or a folder of them, got no meta/info.json"
        )
    datasets = [RecordedDataset(path.parents[1]) for path in files]
    first = datasets[0]
    for other in datasets[1:]:
        if len(other.joints) != len(first.joints) or other.traced != first.traced:
            raise ConfigError(
                f"{other.root}: has other actions than {first.root}; compare them one by one"
            )
    return datasets


def compare(
    datasets: Sequence[RecordedDataset], open_session: OpenSession, plan: OpenLoopPlan
) -> OpenLoopResult:
    """Query a policy at each frame, and compare its actions with those of the dataset.

    A session is reset with its first recorded observation, its instruction and its options, and
    then receives each of its observations in order, whatever its answers are.

    Args:
        datasets: The result of `open_datasets`.
        open_session: Opens a session of the policy.
        plan: The settings.

    Raises:
        ConfigError: The actions of a dataset do not fit the policy's, or a name is unknown.
        PolicyFailed: The policy raised an error, or refused an observation.
    """
    first = datasets[0]
    sessions = [session for dataset in datasets for session in dataset.sessions(plan.episodes)]
    against = "answers" if first.traced else "actions"
    result = OpenLoopResult(
        [str(dataset.root) for dataset in datasets], against, ErrorTable(first.joints)
    )
    for session in sessions:
        result.missing += sum(episode.dataset.gaps(episode) for episode in session.episodes)
    lock = threading.Lock()

    def query(session: RecordedSession) -> None:
        agent = open_session()
        try:
            for episode, step, actions in _answers(session, agent, plan):
                expected = _fitting(step.expected, actions, episode)
                rows = min(len(expected), len(actions), plan.horizon or len(actions))
                frame = {
                    "dataset": episode.dataset.root.name,
                    "episode": episode.index,
                    "frame": step.frame,
                }
                with lock:
                    mae = result.table.add(expected[:rows], actions[:rows])
                    result.frames.append({**frame, "mae": mae})
        finally:
            agent.close()
        with lock:
            result.sessions += 1

    with ThreadPoolExecutor(plan.at_once, "open-loop") as threads:
        futures = [threads.submit(query, session) for session in sessions]
        try:
            for future in futures:
                future.result()
        except BaseException:
            threads.shutdown(wait=False, cancel_futures=True)
            raise
    return result


def _fitting(expected: np.ndarray, actions: np.ndarray, episode: RecordedEpisode) -> np.ndarray:
    """Return the recorded actions; raises `ConfigError` if the policy's have another number of
    values.
    """
    if actions.shape[1] != expected.shape[1]:
        raise ConfigError(
            f"{episode.dataset.root}: its actions have {expected.shape[1]} numbers, those of the "
            "policy "
            f"{actions.shape[1]}; use a policy of the same robot and control mode"
        )
    return expected


def _answers(
    session: RecordedSession, agent: Agent, plan: OpenLoopPlan
) -> Iterator[tuple[RecordedEpisode, RecordedStep, np.ndarray]]:
    """Yield the frames of a session, each with the policy's action, (H, D)."""
    options = {
        name: value for name, value in session.options.items() if name not in _CHOICES_OF_WEIGHTS
    }
    is_reset = False
    for episode in session.episodes:
        every = 1 if episode.dataset.traced else plan.every
        steps = episode.dataset.steps(episode, plan.names, agent.contract)
        for step in islice(steps, 0, None, every):
            try:
                if not is_reset:
                    agent.reset(step.obs, episode.instruction, **options)
                    is_reset = True
                actions = agent.act(step.obs).rows()
            except VLAgentsError as error:
                where = f"{episode.dataset.root}, episode {episode.index}, frame {step.frame}"
                raise PolicyFailed(f"{where}: {error}") from error
            yield episode, step, actions


def write_result(result: OpenLoopResult, policy: str, folder: Path) -> Path:
    """Write `open_loop.json` into a folder, which is created if needed; return its path."""
    with storing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        with whole(folder / FILE) as path:
            path.write_text(
                json.dumps({"policy": policy, **result.to_json()}, indent=2, ensure_ascii=False),
                "utf-8",
            )
    return folder / FILE
