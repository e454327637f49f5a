"""Playing datasets to a policy, several sessions at once, so that it computes them in batches."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from vlagents_ray.errors import ConfigError, PolicyFailed, VLAgentsError
from vlagents_ray.interface import Agent
from vlagents_ray.open_loop.candidates import Sessions
from vlagents_ray.open_loop.comparison import ErrorTable, FrameError, worst
from vlagents_ray.open_loop.recorded import Names, RecordedDataset, RecordedEpisode, RecordedSession, find_datasets
from vlagents_ray.serve.models.checkpoints import CHOICE, STEP
from vlagents_ray.serve.weights.updates import OPTION

_SHOWN = 500  # most frames of the episode that is drawn


@dataclass(frozen=True, slots=True)
class ReplayPlan:
    """What is replayed, and how."""

    episodes: Sequence[int] | None = None  # of each dataset; None: all
    horizon: int | None = None  # most rows of a chunk that are compared; None: all that both have
    every: int = 1  # of the frames of a dataset without recorded answers, each so many-th is asked
    at_once: int = 8  # sessions
    names: Names = field(default_factory=Names)


@dataclass
class OpenLoopResult:
    """The errors of one policy on some datasets."""

    datasets: list[str]
    joints: list[str]
    against: str  # "answers" that a server recorded, or "actions" of the dataset
    table: ErrorTable
    sessions: int = 0
    missing: int = 0  # acts that the recording lacks, so that a policy with a history saw less
    frames: list[FrameError] = field(default_factory=list)
    drawn: list[tuple[np.ndarray, np.ndarray]] = field(default_factory=list)  # (D,) expected and got, first rows

    def to_json(self) -> dict[str, Any]:
        """Return the result as plain JSON values."""
        by_episode: dict[tuple[str, int], list[float]] = {}
        for one in self.frames:
            by_episode.setdefault((one.dataset, one.episode), []).append(one.mae)
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
            "worst": [asdict(one) for one in worst(self.frames)],
        }


def replay(
    folder: Path, sessions: Sessions, plan: ReplayPlan, progress: Callable[[int, int], None] = lambda *_: None
) -> OpenLoopResult:
    """Ask a policy what it would do at each frame, and compare that with what the dataset has.

    A session is reset with its first recorded observation, its instruction and its options, and then gets each of its
    observations in order, whatever it answers.

    Args:
        folder: A LeRobotDataset, or a folder of those that a server recorded.
        sessions: Opens sessions of the policy.
        plan: What is replayed.
        progress: Gets the number of sessions that are done, and of all.

    Raises:
        ConfigError: There is no dataset, its actions are not the policy's, or a name is unknown.
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
    run = _Replaying(result, plan, threading.Lock())

    def one(play: RecordedSession) -> None:
        agent = sessions()
        try:
            run.play(play, agent)
        finally:
            agent.close()
        with run.lock:
            result.sessions += 1
            progress(result.sessions, len(plays))

    with ThreadPoolExecutor(plan.at_once, "open-loop") as threads:
        futures = [threads.submit(one, play) for play in plays]
        try:
            for future in futures:
                future.result()
        except BaseException:
            threads.shutdown(wait=False, cancel_futures=True)
            raise
    return result


@dataclass
class _Replaying:
    result: OpenLoopResult
    plan: ReplayPlan
    lock: threading.Lock

    def play(self, play: RecordedSession, agent: Agent) -> None:
        begun = False
        for part in play.parts:
            for step in self._steps(part, agent):
                try:
                    if not begun:
                        agent.reset(step.obs, part.instruction, **_options(play))
                        begun = True
                    got = agent.act(step.obs).rows()
                except VLAgentsError as error:
                    where = f"{part.dataset.root}, episode {part.index}, frame {step.frame}"
                    raise PolicyFailed(f"{where}: {error}") from error
                self._compare(part, step.frame, step.expected, got)

    def _steps(self, part: RecordedEpisode, agent: Agent) -> Any:
        every = 1 if part.dataset.traced else self.plan.every
        return islice(part.dataset.steps(part, self.plan.names, agent.contract), 0, None, every)

    def _compare(self, part: RecordedEpisode, frame: int, expected: np.ndarray, got: np.ndarray) -> None:
        if got.shape[1] != expected.shape[1]:
            raise ConfigError(
                f"{part.dataset.root}: its actions have {expected.shape[1]} numbers, those of the policy "
                f"{got.shape[1]}; want a policy of the same robot and control mode"
            )
        rows = min(len(expected), len(got), self.plan.horizon or len(got))
        expected, got = expected[:rows], got[:rows]
        with self.lock:
            mae = self.result.table.add(expected, got)
            self.result.frames.append(FrameError(part.dataset.root.name, part.index, frame, mae))
            shown = self.result.frames[0]
            if (part.dataset.root.name, part.index) == (shown.dataset, shown.episode) and len(
                self.result.drawn
            ) < _SHOWN:
                self.result.drawn.append((expected[0], got[0]))


def _options(play: RecordedSession) -> dict[str, Any]:
    """Return the options of the reset that are the policy's, not the choice of its weights."""
    return {name: value for name, value in play.options.items() if name not in (CHOICE, STEP, OPTION)}
