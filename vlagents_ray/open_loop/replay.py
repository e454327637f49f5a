"""Replays datasets to a policy, with several sessions at once, so that it computes them in batches."""

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
from vlagents_ray.open_loop.recorded import (
    Names,
    RecordedDataset,
    RecordedEpisode,
    RecordedSession,
    RecordedStep,
    find_datasets,
)
from vlagents_ray.serve.config.deployment import ServerArgs
from vlagents_ray.serve.launch.deployment_file import own_settings, policy_application
from vlagents_ray.serve.local_agent import LocalPolicy
from vlagents_ray.serve.models.checkpoints import CHOICE, STEP
from vlagents_ray.serve.weights import OPTION

Sessions = Callable[[], Agent]  # opens a session; the caller closes it

FILE = "open_loop.json"
_WORST = 10


@contextmanager
def candidate(source: str) -> Iterator[Sessions]:
    """Load a policy for the duration of the context.

    Yields:
        A function that opens sessions, which share the policy's batches.
    """
    if "://" in source:
        yield partial(RemoteAgent, source, rank="simulation", codec="exact")
        return
    application = policy_application(source)
    with LocalPolicy(ServerArgs(**application.args), own_settings(application), threaded=True) as policy:
        policy.initialize()
        yield lambda: policy.sessions(1)[0]


@dataclass
class ErrorTable:
    """Sums over the frames so far, for each step of the horizon (H) and each number of an action (D)."""

    dim: int
    absolute: np.ndarray = field(init=False)  # (H, D), of the absolute errors
    square: np.ndarray = field(init=False)  # (H, D), of the squared errors
    largest: np.ndarray = field(init=False)  # (H, D), largest absolute error
    frames: np.ndarray = field(init=False)  # (H,)

    def __post_init__(self) -> None:
        self.absolute, self.square, self.largest = (np.zeros((0, self.dim)) for _ in range(3))
        self.frames = np.zeros(0, np.int64)

    def add(self, expected: np.ndarray, got: np.ndarray) -> float:
        """Add a frame's chunks, (H, D) each, and return their mean absolute error."""
        rows = len(expected)
        if rows > len(self.frames):
            more = ((0, rows - len(self.frames)), (0, 0))
            self.absolute, self.square, self.largest = (
                np.pad(one, more) for one in (self.absolute, self.square, self.largest)
            )
            self.frames = np.pad(self.frames, more[0])
        error = np.abs(got.astype(np.float64) - expected.astype(np.float64))
        self.absolute[:rows] += error
        self.square[:rows] += error**2
        self.largest[:rows] = np.maximum(self.largest[:rows], error)
        self.frames[:rows] += 1
        return float(error.mean())

    def to_json(self, joints: list[str]) -> dict[str, Any]:
        """Return the errors overall, by joint, by step, and by both, in the units of the actions."""
        total = max(1, int(self.frames.sum()))
        mae, rms = self.absolute.sum(0) / total, np.sqrt(self.square.sum(0) / total)
        largest = self.largest.max(0, initial=0)
        means, squares = (sums / self.frames[:, np.newaxis] for sums in (self.absolute, self.square))
        by_step = zip(self.frames, means.mean(1), np.sqrt(squares.mean(1)), strict=True)
        return {
            "mae": float(mae.mean()),
            "rmse": float(np.sqrt((rms**2).mean())),
            "max": float(largest.max(initial=0)),
            "by_joint": [
                {"joint": name, "mae": float(mae[i]), "rmse": float(rms[i]), "max": float(largest[i])}
                for i, name in enumerate(joints)
            ],
            "by_step": [
                {"step": step, "frames": int(frames), "mae": float(mean), "rmse": float(root)}
                for step, (frames, mean, root) in enumerate(by_step)
            ],
            "mae_by_step_and_joint": means.tolist(),
        }


@dataclass(frozen=True, slots=True)
class ReplayPlan:
    """The settings of a replay."""

    episodes: Sequence[int] | None = None  # of each dataset; None: all
    horizon: int | None = None  # largest number of compared rows of a chunk; None: all rows that both have
    every: int = 1  # stride of the queried frames in a dataset without recorded answers
    at_once: int = 8  # number of concurrent sessions
    names: Names = field(default_factory=Names)


@dataclass
class OpenLoopResult:
    """The errors of one policy on some datasets."""

    datasets: list[str]
    joints: list[str]
    against: str  # "answers" recorded by a server, or "actions" of the dataset
    table: ErrorTable
    sessions: int = 0
    missing: int = 0  # acts that the recording lacks, so that a policy with a history received less
    frames: list[dict[str, Any]] = field(default_factory=list)  # dataset, episode, frame, and its chunk's "mae"

    def to_json(self) -> dict[str, Any]:
        by_episode: dict[tuple[str, int], list[float]] = {}
        for one in self.frames:
            by_episode.setdefault((one["dataset"], one["episode"]), []).append(one["mae"])
        return {
            "datasets": self.datasets,
            "against": self.against,
            "sessions": self.sessions,
            "frames": len(self.frames),
            "missing_acts": self.missing,
            **self.table.to_json(self.joints),
            "by_episode": [
                {"dataset": dataset, "episode": episode, "frames": len(errors), "mae": float(np.mean(errors))}
                for (dataset, episode), errors in sorted(by_episode.items())
            ],
            "worst": sorted(self.frames, key=lambda one: -one["mae"])[:_WORST],
        }


def replay(folder: Path, sessions: Sessions, plan: ReplayPlan) -> OpenLoopResult:
    """Query a policy at each frame, and compare its actions with the dataset's.

    A session is reset with its first recorded observation, its instruction and its options, and then receives each of
    its observations in order, whatever its answers are.

    Raises:
        ConfigError: There is no dataset, its actions do not fit the policy's, or a name is unknown.
        PolicyFailed: The policy raised an error, or refused an observation.
    """
    datasets = [RecordedDataset(root) for root in find_datasets(folder)]
    if not datasets:
        raise ConfigError(f"{folder}: is no LeRobotDataset, and has none in it (meta/info.json)")
    first = datasets[0]
    for other in datasets[1:]:
        if len(other.joints) != len(first.joints) or other.traced != first.traced:
            raise ConfigError(f"{other.root}: has other actions than {first.root}; replay them one by one")
    plays = [play for dataset in datasets for play in dataset.plays(plan.episodes)]
    result = OpenLoopResult(
        [str(one.root) for one in datasets],
        first.joints,
        "answers" if first.traced else "actions",
        ErrorTable(len(first.joints)),
    )
    result.missing = sum(part.dataset.gaps(part) for play in plays for part in play.parts)
    lock = threading.Lock()

    def one(play: RecordedSession) -> None:
        agent = sessions()
        try:
            for part, step, got in _answers(play, agent, plan):
                expected = step.expected
                if got.shape[1] != expected.shape[1]:
                    raise ConfigError(
                        f"{part.dataset.root}: its actions have {expected.shape[1]} numbers, those of the policy "
                        f"{got.shape[1]}; want a policy of the same robot and control mode"
                    )
                rows = min(len(expected), len(got), plan.horizon or len(got))
                with lock:
                    mae = result.table.add(expected[:rows], got[:rows])
                    place = {"dataset": part.dataset.root.name, "episode": part.index, "frame": step.frame}
                    result.frames.append({**place, "mae": mae})
        finally:
            agent.close()
        with lock:
            result.sessions += 1

    with ThreadPoolExecutor(plan.at_once, "open-loop") as threads:
        futures = [threads.submit(one, play) for play in plays]
        try:
            for future in futures:
                future.result()
        except BaseException:
            threads.shutdown(wait=False, cancel_futures=True)
            raise
    return result


def _answers(
    play: RecordedSession, agent: Agent, plan: ReplayPlan
) -> Iterator[tuple[RecordedEpisode, RecordedStep, np.ndarray]]:
    """Yield the frames of a session, each with the policy's action, (H, D)."""
    begun = False
    for part in play.parts:
        every = 1 if part.dataset.traced else plan.every
        for step in islice(part.dataset.steps(part, plan.names, agent.contract), 0, None, every):
            try:
                if not begun:
                    chosen = CHOICE, STEP, OPTION  # options that choose its weights
                    options = {name: one for name, one in play.options.items() if name not in chosen}
                    agent.reset(step.obs, part.instruction, **options)
                    begun = True
                got = agent.act(step.obs).rows()
            except VLAgentsError as error:
                where = f"{part.dataset.root}, episode {part.index}, frame {step.frame}"
                raise PolicyFailed(f"{where}: {error}") from error
            yield part, step, got


def write_result(result: OpenLoopResult, policy: str, folder: Path) -> Path:
    """Write `open_loop.json` into a folder, which is created if needed; return its path."""
    with storing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        with whole(folder / FILE) as part:
            part.write_text(json.dumps({"policy": policy, **result.to_json()}, indent=2, ensure_ascii=False), "utf-8")
    return folder / FILE
