"""The comparison of a policy's actions with the recorded actions of datasets.

Several sessions run at the same time, so that the policy answers in batches.
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
from vlagents_ray.overrides import Override
from vlagents_ray.recorded_dataset import (
    Names,
    RecordedDataset,
    RecordedEpisode,
    RecordedSession,
    RecordedStep,
)
from vlagents_ray.serve.config.deployment import ServerArgs
from vlagents_ray.serve.launch.deployment_file import own_settings, policy_application
from vlagents_ray.serve.local_agent import LocalPolicy
from vlagents_ray.serve.weights import OPTION

OpenSession = Callable[[], Agent]  # the caller closes the session

FILE = "open_loop.json"
_WORST_FRAMES = 10  # number of worst frames that the result lists
# Number of concurrent sessions, which share batches. Every policy has memory for eight rows, and
# larger batches are hardly faster.
_SESSIONS = 8


@contextmanager
def candidate(
    source: str, overrides: Sequence[Override] = (), rows: int | None = None
) -> Iterator[OpenSession]:
    """Load a policy for the duration of the context.

    Args:
        source: The name of a policy, a deployment file, or the URL of a server.
        overrides: Changes of the policy's args. They are not allowed for the policy of a server.
        rows: The number of rows of each forward pass, as in the recording, if the policy supports
            `batch.invariant`. The overrides and the settings of the file precede it.

    Yields:
        A function that opens sessions, which share the policy's batches.
    """
    if "://" in source:
        if overrides:
            raise overrides[0].error(
                f"expected no settings for {source}, a server that has its own; leave them out"
            )
        yield partial(RemoteAgent, source, priority="simulation", codec="exact")
        return
    application = policy_application(source, overrides=overrides)
    args = ServerArgs(**application.args)
    if rows is not None and not args.batch.model_fields_set & {"invariant", "sizes"}:
        batch = args.batch.model_copy(update={"max_size": rows, "invariant": "auto"})
        args = args.model_copy(update={"batch": batch})
    with LocalPolicy(args, own_settings(application), threaded=True) as policy:
        policy.initialize()
        yield lambda: policy.sessions(1)[0]


@dataclass
class ErrorTable:
    """The errors over the frames so far, by step of the horizon (H) and by value of an action
    (D).
    """

    joints: list[str]  # names of the values of an action, D
    absolute: np.ndarray = field(init=False)  # (H, D), sums of the absolute errors
    square: np.ndarray = field(init=False)  # (H, D), sums of the squared errors
    largest: np.ndarray = field(init=False)  # (H, D), largest absolute errors
    frames: np.ndarray = field(init=False)  # (H,), number of frames

    def __post_init__(self) -> None:
        empty = np.zeros((0, len(self.joints)))
        self.absolute, self.square, self.largest = empty, empty, empty
        self.frames = np.zeros(0, np.int64)

    def add(self, expected: np.ndarray, actions: np.ndarray) -> float:
        """Add the recorded chunk and the policy's chunk of a frame.

        Args:
            expected: The recorded actions, (H, D).
            actions: The policy's actions, (H, D).

        Returns:
            The mean absolute error of the chunk.
        """
        rows = len(expected)
        self._extend(rows)
        error = np.abs(actions.astype(np.float64) - expected.astype(np.float64))
        self.absolute[:rows] += error
        self.square[:rows] += error**2
        self.largest[:rows] = np.maximum(self.largest[:rows], error)
        self.frames[:rows] += 1
        return float(error.mean())

    def _extend(self, rows: int) -> None:
        """Add steps of the horizon, up to `rows` of them."""
        missing = rows - len(self.frames)
        if missing <= 0:
            return
        padding = ((0, missing), (0, 0))
        self.absolute = np.pad(self.absolute, padding)
        self.square = np.pad(self.square, padding)
        self.largest = np.pad(self.largest, padding)
        self.frames = np.pad(self.frames, (0, missing))

    def to_json(self) -> dict[str, Any]:
        """Return the errors overall, by joint, by step, and by both, in the units of actions."""
        total = max(1, int(self.frames.sum()))
        mae = self.absolute.sum(0) / total
        rmse = np.sqrt(self.square.sum(0) / total)
        largest = self.largest.max(0, initial=0)
        by_joint = []
        for i, name in enumerate(self.joints):
            errors = {"mae": float(mae[i]), "rmse": float(rmse[i]), "max": float(largest[i])}
            by_joint.append({"joint": name, **errors})

        frames = self.frames[:, np.newaxis]
        means = self.absolute / frames
        step_rmse = np.sqrt((self.square / frames).mean(1))
        by_step = []
        for step, count in enumerate(self.frames):
            errors = {"mae": float(means[step].mean()), "rmse": float(step_rmse[step])}
            by_step.append({"step": step, "frames": int(count), **errors})

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

    episodes: Sequence[int] | None = None  # indices in each dataset; None selects all
    # The largest number of compared rows of a chunk. None compares all rows that both chunks have.
    horizon: int | None = None
    # The distance from one compared frame to the next, in a dataset without recorded answers.
    stride: int = 1
    names: Names = field(default_factory=Names)


@dataclass
class OpenLoopResult:
    """The errors of one policy on some datasets."""

    datasets: list[str]
    against: str  # "answers" recorded by a server, or "actions" of the dataset
    table: ErrorTable
    sessions: int = 0
    # The number of frames with recorded answers whose actions are equal to the bit.
    equal: int = 0
    # The number of calls that are missing in the recording. A policy with a history has therefore
    # received fewer observations than in the recording.
    missing: int = 0
    # For each frame: "dataset", "episode", "frame", and "mae", the mean absolute error of its
    # chunk.
    frames: list[dict[str, Any]] = field(default_factory=list)

    def to_json(self) -> dict[str, Any]:
        """Return the errors of `ErrorTable`, the errors of each episode, and the worst frames."""
        errors_of: dict[tuple[str, int], list[float]] = {}
        for frame in self.frames:
            errors_of.setdefault((frame["dataset"], frame["episode"]), []).append(frame["mae"])
        by_episode = []
        for (dataset, episode), errors in sorted(errors_of.items()):
            by_episode.append(
                {
                    "dataset": dataset,
                    "episode": episode,
                    "frames": len(errors),
                    "mae": float(np.mean(errors)),
                }
            )

        worst = sorted(self.frames, key=lambda frame: -frame["mae"])[:_WORST_FRAMES]
        return {
            "datasets": self.datasets,
            "against": self.against,
            "sessions": self.sessions,
            "frames": len(self.frames),
            "equal": self.equal if self.against == "answers" else None,
            "missing_acts": self.missing,
            **self.table.to_json(),
            "by_episode": by_episode,
            "worst": worst,
        }


def open_datasets(folder: Path) -> list[RecordedDataset]:
    """Open a LeRobotDataset, or all datasets in a folder.

    Raises:
        ConfigError: There is no dataset, or the actions of the datasets differ.
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
    for dataset in datasets[1:]:
        if len(dataset.joints) != len(first.joints) or dataset.traced != first.traced:
            raise ConfigError(
                f"{dataset.root}: has other actions than {first.root}; compare them one by one"
            )
    return datasets


def recorded_rows(datasets: Sequence[RecordedDataset]) -> int | None:
    """Return the number of rows of each forward pass that all datasets record; None if there is
    none.
    """
    sizes = {dataset.rows for dataset in datasets}
    return sizes.pop() if len(sizes) == 1 else None


def compare(
    datasets: Sequence[RecordedDataset], open_session: OpenSession, plan: OpenLoopPlan
) -> OpenLoopResult:
    """Query a policy at each frame, and compare its actions with the actions of the dataset.

    A session is reset with its first recorded observation, its instruction and its options. It then
    receives its recorded observations in order, regardless of its answers.

    Args:
        datasets: The result of `open_datasets`.
        open_session: Opens a session of the policy.
        plan: The settings.

    Returns:
        The errors.

    Raises:
        ConfigError: The actions of a dataset and of the policy have different sizes, or a name is
            unknown.
        PolicyFailed: The policy raised an error, or rejected an observation.
    """
    first = datasets[0]
    sessions: list[RecordedSession] = []
    for dataset in datasets:
        sessions += dataset.sessions(plan.episodes)
    result = OpenLoopResult(
        datasets=[str(dataset.root) for dataset in datasets],
        against="answers" if first.traced else "actions",
        table=ErrorTable(first.joints),
    )
    for session in sessions:
        result.missing += sum(episode.dataset.gaps(episode) for episode in session.episodes)
    lock = threading.Lock()  # guards the result

    def query(session: RecordedSession) -> None:
        agent = open_session()
        try:
            for episode, step, actions in _answers(session, agent, plan):
                _require_same_size(step.expected, actions, episode)
                expected = step.expected
                rows = min(len(expected), len(actions), plan.horizon or len(actions))
                frame = {
                    "dataset": episode.dataset.root.name,
                    "episode": episode.index,
                    "frame": step.frame,
                }
                is_equal = expected.tobytes() == actions.astype(np.float32).tobytes()
                with lock:
                    result.equal += is_equal
                    mae = result.table.add(expected[:rows], actions[:rows])
                    result.frames.append({**frame, "mae": mae})
        finally:
            agent.close()
        with lock:
            result.sessions += 1

    with ThreadPoolExecutor(_SESSIONS, "open-loop") as threads:
        futures = [threads.submit(query, session) for session in sessions]
        try:
            for future in futures:
                future.result()
        except BaseException:
            threads.shutdown(wait=False, cancel_futures=True)
            raise
    return result


def _require_same_size(expected: np.ndarray, actions: np.ndarray, episode: RecordedEpisode) -> None:
    """Raise `ConfigError` unless the recorded actions and the policy's actions have the same
    number of values.
    """
    if actions.shape[1] != expected.shape[1]:
        raise ConfigError(
            f"{episode.dataset.root}: its actions have {expected.shape[1]} numbers, those of the "
            f"policy {actions.shape[1]}; use a policy of the same robot and control mode"
        )


def _answers(
    session: RecordedSession, agent: Agent, plan: OpenLoopPlan
) -> Iterator[tuple[RecordedEpisode, RecordedStep, np.ndarray]]:
    """Yield the frames of a session, each with the policy's actions, (H, D)."""
    # The recorded option selects weights that were pushed to the recorded policy. Other policies do
    # not have these weights.
    options = {name: value for name, value in session.options.items() if name != OPTION}
    is_reset = False
    for episode in session.episodes:
        stride = 1 if episode.dataset.traced else plan.stride
        steps = episode.dataset.steps(episode, plan.names, agent.contract)
        for step in islice(steps, 0, None, stride):
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
    """Write `open_loop.json` into a folder, which is created if needed, and return the path of
    the file.
    """
    with storing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        with whole(folder / FILE) as path:
            document = {"policy": policy, **result.to_json()}
            path.write_text(json.dumps(document, indent=2, ensure_ascii=False), "utf-8")
    return folder / FILE
