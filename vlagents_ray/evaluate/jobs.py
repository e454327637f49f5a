"""Episodes as keyed jobs, and the one queue that all workers draw from."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from vlagents_ray.evaluate.config import EvalConfig, fingerprint, outcome_settings


@dataclass(frozen=True, slots=True)
class EpisodeKey:
    """All that decides an episode: two runs of one key give the same episode, wherever they run."""

    env: str  # full name, suite and task
    episode: int  # its number within the env, from 0
    seed: int  # of the env's reset, and handed to the policy's
    settings: str  # fingerprint of everything else that changes the outcome

    def __str__(self) -> str:
        return f"{self.env}#{self.episode}@{self.seed}:{self.settings}"


@dataclass(frozen=True, slots=True)
class Job:
    """One attempt at an episode."""

    key: EpisodeKey
    attempt: int = 1

    def again(self) -> Job:
        """The next attempt at the same episode."""
        return Job(self.key, self.attempt + 1)


def plan(config: EvalConfig) -> list[EpisodeKey]:
    """Every episode that `config` asks for, env by env."""
    keys = []
    for env in config.envs:
        settings = fingerprint(outcome_settings(config, env))
        keys += [EpisodeKey(env, i, config.seed + i, settings) for i in range(config.episodes)]
    return keys


class JobQueue:
    """Jobs that wait, by env, so that a worker can go on with the env it has already made."""

    def __init__(self, keys: Iterable[EpisodeKey]) -> None:
        self._waiting: dict[str, deque[Job]] = {}
        for key in keys:
            self._waiting.setdefault(key.env, deque()).append(Job(key))

    def __len__(self) -> int:
        return sum(map(len, self._waiting.values()))

    def put_back(self, job: Job) -> None:
        """Queue a further attempt, ahead of the episodes that have not been tried."""
        self._waiting.setdefault(job.key.env, deque()).appendleft(job)

    def take(self, made: str | None, working: Mapping[str, int]) -> Job | None:
        """The next job for a worker that has made env `made`; None if none waits.

        A worker stays with its env while that has episodes; then it goes where most wait for each
        worker, counting `working`: how many workers are busy with which env.
        """
        if made is not None and self._waiting.get(made):
            return self._waiting[made].popleft()
        open_envs = [env for env, jobs in self._waiting.items() if jobs]
        if not open_envs:
            return None
        env = max(open_envs, key=lambda name: len(self._waiting[name]) / (1 + working.get(name, 0)))
        return self._waiting[env].popleft()
