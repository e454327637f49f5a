"""Jobs, which are attempts at episodes identified by keys, and the common queue of all workers."""

from __future__ import annotations

import itertools
import math
from collections import Counter, deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

from vlagents_ray.evaluate.plan.cases import EvalCase


@dataclass(frozen=True, slots=True)
class EpisodeKey:
    """Everything that determines an episode: two runs with the same key give the same episode on
    any machine.
    """

    env: str  # full name of the env, with simulator and task
    episode: int  # number of the episode within the env, from 0
    seed: int  # seed of the resets of env and policy
    settings: str  # fingerprint of everything else that changes the outcome
    # The seed of the policy's reset, if it differs from the env's; None: `seed`.
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
    # Whether the job runs without other episodes in its simulator, so that an error belongs to this
    # episode.
    alone: bool = False

    def again(self, *, alone: bool = False) -> Job:
        """Return the next attempt at the same episode; once set, `alone` stays set."""
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
    """A queue of waiting jobs by environment, so that a worker can keep its environment."""

    def __init__(self, jobs: Iterable[Job] = ()) -> None:
        self._waiting: dict[str, deque[Job]] = {}  # waiting jobs by place
        self._kinds: dict[str, str] = {}  # place -> kind
        for job in jobs:
            self.put(job)

    def __len__(self) -> int:
        return sum(map(len, self._waiting.values()))

    def put(self, job: Job) -> None:
        """Queue a job behind all others of its environment."""
        self._of(job).append(job)

    def put_back(self, job: Job) -> None:
        """Queue a repeated attempt, ahead of episodes without an attempt."""
        self._of(job).appendleft(job)

    def take(self, kind: str, made: str | None, working: Mapping[str, int]) -> tuple[Job, ...]:
        """Return the next jobs for a worker of kind `kind` whose env is at place `made`; empty if
        no job of this kind waits.

        The jobs belong to one case, and run at the same time. A worker keeps its env while the env
        has waiting episodes. Then it changes to the place with the most waiting jobs per busy
        worker; `working` contains the number of busy workers at each place.
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
        """Return a case for one more worker; None if the `unoccupied` workers suffice.

        Both arguments count workers by kind. The case belongs to the kind with the most waiting
        batches per worker.
        """
        batches: Counter[str] = Counter()  # number of waiting batches by kind
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

    def has_jobs_of(self, policy: str) -> bool:
        """Return whether a job of this policy waits."""
        waiting = itertools.chain.from_iterable(self._waiting.values())
        return any(job.case.policy.name == policy for job in waiting)

    def drop(self, settings: str) -> int:
        """Remove the waiting jobs of the case with this fingerprint, and return their number."""
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
        """Remove and return the first job at a place and the jobs that may run together with it."""
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
