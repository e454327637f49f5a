"""Episodes as keyed jobs, and the common queue of all workers."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

from vlagents_ray.evaluate.plan.cases import EvalCase


@dataclass(frozen=True, slots=True)
class EpisodeKey:
    """Everything that determines an episode: two runs of one key give the same episode on any
    machine.
    """

    env: str  # full name, suite and task
    episode: int  # its number within the env, from 0
    seed: int  # of the resets of env and policy
    settings: str  # fingerprint of everything else that changes the outcome
    # The seed of the policy's reset, where it differs from the env's; None: `seed`.
    policy_seed: int | None = None

    def __str__(self) -> str:
        policy = "" if self.policy_seed is None else f"/{self.policy_seed}"
        return f"{self.env}#{self.episode}@{self.seed}{policy}:{self.settings}"


@dataclass(frozen=True, slots=True)
class Job:
    """One attempt at an episode."""

    key: EpisodeKey
    case: EvalCase
    attempt: int = 1
    # Whether it runs without others in its simulator, so that an error names this episode.
    alone: bool = False

    def again(self, *, alone: bool = False) -> Job:
        """Return the next attempt at the same episode, which stays `alone`."""
        return replace(self, attempt=self.attempt + 1, alone=self.alone or alone)


def plan_jobs(cases: Iterable[EvalCase]) -> list[Job]:
    """Return every episode of `cases`, case by case and seed by seed."""
    jobs = []
    for case in cases:
        for seed in case.suite.seeds:
            for number in range(case.suite.episodes):
                key = EpisodeKey(case.env, number, seed + number, case.fingerprint)
                jobs.append(Job(key, case))
    return jobs


class JobQueue:
    """Waiting jobs by environment, so that a worker can keep its environment."""

    def __init__(self, jobs: Iterable[Job]) -> None:
        self._waiting: dict[str, deque[Job]] = {}  # by place
        self._kinds: dict[str, str] = {}  # place -> kind
        for job in jobs:
            self.put(job)

    def __len__(self) -> int:
        return sum(map(len, self._waiting.values()))

    def put(self, job: Job) -> None:
        """Queue a job behind the others."""
        self._of(job).append(job)

    def put_back(self, job: Job) -> None:
        """Queue a further attempt, ahead of the episodes that have not been tried."""
        self._of(job).appendleft(job)

    def take(self, kind: str, made: str | None, working: Mapping[str, int]) -> tuple[Job, ...]:
        """Return the next jobs for a worker of `kind` with the env at place `made`; none if no job
        of its kind waits.

        They are of one case, as many as run at once. A worker keeps its env while that has
        episodes; then it takes the place with the most waiting jobs for each worker, by `working`,
        the number of busy workers at each place.
        """
        if made is not None and self._waiting.get(made):
            return self._first(made)

        places = self._places_of(kind)
        if not places:
            return ()

        def jobs_per_worker(place: str) -> float:
            return len(self._waiting[place]) / (1 + working.get(place, 0))

        return self._first(max(places, key=jobs_per_worker))

    def needs_worker(
        self, workers: Mapping[str, int], unoccupied: Mapping[str, int]
    ) -> EvalCase | None:
        """Return a case for one more worker; None if the `unoccupied` ones suffice.

        Both arguments count workers by kind. The case is of the kind with the most waiting jobs for
        each of the `workers`.
        """
        batches: Counter[str] = Counter()  # waiting ones, by kind
        for place, jobs in self._waiting.items():
            if jobs:
                batches[self._kinds[place]] += math.ceil(len(jobs) / jobs[0].case.suite.num_envs)
        short = [kind for kind, number in batches.items() if number > unoccupied.get(kind, 0)]
        if not short:
            return None

        def batches_per_worker(kind: str) -> float:
            return batches[kind] / (1 + workers.get(kind, 0))

        kind = max(short, key=batches_per_worker)
        place = self._places_of(kind)[0]
        return self._waiting[place][0].case

    def drop(self, settings: str) -> int:
        """Remove the waiting jobs of the case with this fingerprint; returns their number."""
        before = len(self)
        for place, jobs in self._waiting.items():
            self._waiting[place] = deque(job for job in jobs if job.key.settings != settings)
        return before - len(self)

    def _places_of(self, kind: str) -> list[str]:
        """Return the places with waiting jobs for workers of this kind."""
        return [
            place for place, jobs in self._waiting.items() if jobs and self._kinds[place] == kind
        ]

    def _first(self, place: str) -> tuple[Job, ...]:
        """Take the first job at a place, and those that may run together with it."""
        jobs = self._waiting[place]
        first = jobs.popleft()
        taken = [first]
        number = 1 if first.alone else first.case.suite.num_envs
        while jobs and len(taken) < number:
            is_same_case = jobs[0].case.fingerprint == first.case.fingerprint
            if not is_same_case or jobs[0].alone:
                break
            taken.append(jobs.popleft())
        return tuple(taken)

    def _of(self, job: Job) -> deque[Job]:
        self._kinds[job.case.place] = job.case.kind
        return self._waiting.setdefault(job.case.place, deque())
