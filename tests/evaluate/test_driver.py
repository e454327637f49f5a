"""The driver of evaluations and rollouts, and its handling of each report."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import pytest

from vlagents_ray.errors import ConfigError, EnvFailed, PolicyFailed, VLAgentsError
from vlagents_ray.evaluate import EvalConfig
from vlagents_ray.evaluate.artifacts.recorder import Artifacts
from vlagents_ray.evaluate.driver import Consumer, Driver
from vlagents_ray.evaluate.episode.failures import Failure
from vlagents_ray.evaluate.episode.records import EpisodeResult
from vlagents_ray.evaluate.plan.cases import EvalCase
from vlagents_ray.evaluate.plan.config import PolicyConfig
from vlagents_ray.evaluate.plan.jobs import Job, plan_jobs
from vlagents_ray.evaluate.plan.resolved import ResolvedPlan, resolve
from vlagents_ray.evaluate.workers.base import WorkerHandle, Workers
from vlagents_ray.evaluate.workers.rollout import Report

Config = Callable[..., EvalConfig]
BROKEN = Failure("worker", EnvFailed.code, "the simulator exploded")


class Collected(Consumer):
    """A consumer that stores the results of episodes, and whether each failed attempt was
    repeated.
    """

    policy_cure, loss_cure = "mend the policy", "mend the simulator"

    def __init__(self, *, needed: bool = True) -> None:
        self.results: list[EpisodeResult] = []
        self.repeated: list[bool] = []
        self._needed = needed

    def began(self, jobs: tuple[Job, ...]) -> None:
        pass

    def described(self, job: Job, report: Report) -> None:
        pass

    def is_needed(self, job: Job) -> bool:
        return self._needed

    def attempt_failed(self, job: Job, failure: Failure, *, repeated: bool) -> None:
        self.repeated.append(repeated)

    def finished(self, job: Job, result: EpisodeResult, artifacts: Artifacts) -> None:
        self.results.append(result)

    @property
    def statuses(self) -> list[str]:
        return [result.status for result in self.results]


def driver_of(config: EvalConfig, consumer: Consumer) -> tuple[Driver, list[Job]]:
    """Return a driver whose queue is empty, as if all its jobs were running, and the jobs."""
    plan = resolve(config)
    return Driver(plan, [], consumer), plan_jobs(plan.cases)


def next_job(driver: Driver, job: Job) -> Job:
    [taken] = driver.queue.take(job.case.kind, None, {})
    return taken


def test_a_failed_attempt_is_repeated_until_its_episode_is_lost(config: Config) -> None:
    consumer = Collected()
    driver, [job, *_] = driver_of(config(retries=1), consumer)
    driver.take(job, Report(failure=BROKEN))
    again = next_job(driver, job)
    assert (again.key, again.attempt, again.alone) == (job.key, 2, True)
    driver.take(again, Report(failure=BROKEN))
    assert consumer.repeated == [True, False]
    assert consumer.statuses == ["infra_failed"]
    assert consumer.results[0].error == "env_failed: the simulator exploded"
    assert not len(driver.queue)


@pytest.mark.parametrize(
    ("retries", "alone"), [(1, [True]), (2, [False, True]), (3, [False, True, True])]
)
def test_an_episode_whose_simulator_breaks_again_is_played_alone(
    config: Config, retries: int, alone: list[bool]
) -> None:
    """Another episode in the same simulator may be the cause of the failure."""
    driver, [job, *_] = driver_of(config(retries=retries), Collected())
    attempts = []
    for _ in range(retries):
        driver.take(job, Report(failure=BROKEN))
        job = next_job(driver, job)
        attempts.append(job.alone)
    assert attempts == alone


def test_an_episode_is_repeated_beside_others_if_the_policy_was_lost(config: Config) -> None:
    driver, [job, *_] = driver_of(config(retries=3), Collected())
    for _ in range(3):
        driver.take(job, Report(failure=replace(BROKEN, cause="policy")))
        job = next_job(driver, job)
        assert not job.alone


def test_an_episode_that_may_have_broken_others_is_played_alone(config: Config) -> None:
    driver, [job, *_] = driver_of(config(), Collected())
    driver.take(job, Report(failure=replace(BROKEN, names_no_episode=True)))
    assert next_job(driver, job).alone


def test_an_attempt_that_is_no_longer_needed_is_neither_repeated_nor_lost(config: Config) -> None:
    consumer = Collected(needed=False)
    driver, [job, *_] = driver_of(config(), consumer)
    driver.take(job, Report(failure=BROKEN))
    assert (consumer.repeated, consumer.results, len(driver.queue)) == ([False], [], 0)


@pytest.mark.parametrize(
    ("digests", "statuses"), [(["a", "a"], ["policy_error"]), (["a", "b"], []), (["a"], [])]
)
def test_a_simulation_that_diverges_twice_under_the_same_actions_is_an_error_of_the_policy(
    config: Config, digests: list[str], statuses: list[str]
) -> None:
    consumer = Collected()
    driver, [job, *_] = driver_of(config(), consumer)
    for digest in digests:
        result = EpisodeResult(job.key, "policy_error", steps=3, actions_sha256=digest)
        driver.take(job, Report(failure=replace(BROKEN, diverged=result)))
    assert consumer.statuses == statuses


@pytest.mark.parametrize("retries", [0, 1, 3])
@pytest.mark.parametrize("first_diverges", [True, False])
def test_an_episode_that_only_diverges_counts_as_a_failure_after_its_retries(
    config: Config, retries: int, first_diverges: bool
) -> None:
    """Whatever its actions: a policy that samples without the seed never repeats them."""
    consumer = Collected()
    driver, [job, *_] = driver_of(config(retries=retries, abort_after=0), consumer)
    for attempt in range(1, retries + 2):
        diverged = EpisodeResult(job.key, "policy_error", steps=3, actions_sha256=str(attempt))
        has_diverged = (attempt == 1) == first_diverges or retries == 0
        failure = replace(BROKEN, diverged=diverged) if has_diverged else BROKEN
        driver.take(replace(job, attempt=attempt), Report(failure=failure))
    assert consumer.statuses == ["policy_error"], "one attempt in which it diverged suffices"


def test_a_mistake_of_the_user_ends_it_at_once(config: Config) -> None:
    consumer = Collected()
    driver, [job, *_] = driver_of(config(), consumer)
    with pytest.raises(ConfigError, match="no such option"):
        driver.take(job, Report(failure=Failure("user", ConfigError.code, "no such option")))
    assert consumer.repeated == [False]


def test_losses_in_a_row_end_it_and_a_played_episode_between_them_does_not_count(
    config: Config,
) -> None:
    driver, [job, *_] = driver_of(config(retries=0, abort_after=2), Collected())
    driver.take(job, Report(failure=BROKEN))
    driver.take(job, Report(result=EpisodeResult(job.key, "done", False, False)))
    driver.take(job, Report(failure=BROKEN))
    with pytest.raises(EnvFailed, match=r"2 episodes in a row lost to .*; mend the simulator: the"):
        driver.take(job, Report(failure=BROKEN))


def test_errors_of_the_policy_in_a_row_end_it_with_their_cure(config: Config) -> None:
    consumer = Collected()
    driver, [job, *_] = driver_of(config(abort_after=2), consumer)
    failed = Report(result=EpisodeResult(job.key, "policy_error", error="got NaN"))
    driver.take(job, failed)
    with pytest.raises(PolicyFailed, match=r"2 episodes in a row .*got NaN; mend the policy"):
        driver.take(job, failed)
    assert consumer.statuses == ["policy_error"] * 2


# A sweep over checkpoints: a server has one of them at a time.


class Server:
    """A server whose swaps of checkpoints the test ends."""

    def __init__(self) -> None:
        self.begun: list[tuple[str, int]] = []
        self.loaded: set[str] = set()  # policies whose last swap has ended
        self.error: VLAgentsError | None = None

    def begin(self, policy: str, step: int) -> None:
        self.begun.append((policy, step))
        self.loaded.discard(policy)

    def is_done(self, policy: str) -> bool:
        if self.error is not None:
            raise self.error
        return policy in self.loaded


class Pool(Workers):
    """A worker of a policy's episodes, which the test ends."""

    def __init__(self, plan: ResolvedPlan) -> None:
        super().__init__(plan, lambda _: pytest.fail("made"))
        self.played: list[str] = []

    def __exit__(self, *_: object) -> None:
        pass

    def free_slot(self) -> bool:
        return not self._workers

    def start(self, case: EvalCase) -> None:
        self._workers.append(
            WorkerHandle(case.worker, case.kind, actor=None, starting=None, started_at=0.0)
        )

    def dispatch(self, worker: WorkerHandle, jobs: tuple[Job, ...]) -> None:
        worker.jobs = jobs
        self.played += [f"{job.case.policy_id}#{job.key.episode}" for job in jobs]

    def end(self) -> Job:
        """End the running episode, and return its job."""
        [worker] = self._workers
        [job] = worker.jobs
        worker.jobs = ()
        return job

    def wait(self, timeout_s: float) -> Iterator[tuple[Job, Report]]:
        yield from ()

    def close(self) -> None:
        pass


def sweep(config: Config, **policy: Any) -> ResolvedPlan:
    """Return a plan with the steps 10 and 20 of the policy "a", and the policy "b" of one
    checkpoint.
    """
    base = config(episodes=2)
    swept = {"name": "a", "url": "serve://a", "steps": [10, 20]} | policy
    policies = [PolicyConfig(**swept), PolicyConfig(name="b", url="serve://b")]
    return resolve(base.model_copy(update={"policies": policies}))


def run_all(driver: Driver, pool: Pool, server: Server | None = None) -> None:
    """Run all jobs, with one hand-out for each event."""
    for _ in range(50):
        driver.hand_out(pool)
        driver.hand_out(pool)  # the first one starts the worker
        if pool.busy:
            job = pool.end()
            driver.take(job, Report(result=EpisodeResult(job.key, "done")))
        elif server is not None and server.begun:
            server.loaded.add(server.begun[-1][0])


def test_all_episodes_of_a_checkpoint_end_before_the_next_one_is_loaded(config: Config) -> None:
    plan, server = sweep(config), Server()
    driver, pool = Driver(plan, plan_jobs(plan.cases), Collected(), server), Pool(plan)
    assert driver.waiting == 6
    run_all(driver, pool, server)
    assert server.begun == [("a", 10), ("a", 20)]
    of_a = [name for name in pool.played if name.startswith("a")]
    assert of_a == ["a@10#0", "a@10#1", "a@20#0", "a@20#1"]
    assert sorted(pool.played) == sorted([*of_a, "b#0", "b#1"])
    assert driver.waiting == 0


def test_other_policies_play_while_a_checkpoint_is_loaded(config: Config) -> None:
    plan, server = sweep(config), Server()
    driver, pool = Driver(plan, plan_jobs(plan.cases), Collected(), server), Pool(plan)
    run_all(driver, pool)
    assert pool.played == ["b#0", "b#1"]
    assert server.begun == [("a", 10)]
    assert driver.waiting == 4


def test_a_failed_attempt_is_repeated_before_the_next_checkpoint_is_loaded(config: Config) -> None:
    plan, server = sweep(config), Server()
    jobs = [job for job in plan_jobs(plan.cases) if job.case.policy.name == "a"]
    driver, pool = Driver(plan, jobs, Collected(), server), Pool(plan)
    server.loaded.add("a")
    driver.hand_out(pool)
    server.loaded.add("a")
    driver.hand_out(pool)
    driver.hand_out(pool)
    driver.take(pool.end(), Report(failure=BROKEN))
    run_all(driver, pool, server)
    assert pool.played == ["a@10#0", "a@10#0", "a@10#1", "a@20#0", "a@20#1"]


def test_a_running_episode_delays_the_next_checkpoint(config: Config) -> None:
    plan, server = sweep(config), Server()
    jobs = [job for job in plan_jobs(plan.cases) if job.case.policy.name == "a"]
    driver, pool = Driver(plan, [jobs[0], jobs[2]], Collected(), server), Pool(plan)
    for _ in range(3):
        driver.hand_out(pool)
        server.loaded.add("a")
    driver.hand_out(pool)
    assert pool.busy
    assert server.begun == [("a", 10)]
    pool.end()
    driver.hand_out(pool)
    assert server.begun == [("a", 10), ("a", 20)]


def test_a_checkpoint_that_does_not_load_ends_the_run_with_its_cause(config: Config) -> None:
    plan, server = sweep(config), Server()
    driver, pool = Driver(plan, plan_jobs(plan.cases), Collected(), server), Pool(plan)
    driver.hand_out(pool)
    server.error = ConfigError("policy 'a': checkpoint_step 10: no such file")
    with pytest.raises(ConfigError, match="no such file"):
        driver.hand_out(pool)


def test_agents_of_the_workers_need_no_server_for_a_sweep(config: Config) -> None:
    plan, server = sweep(config, url=None), Server()
    driver, pool = Driver(plan, plan_jobs(plan.cases), Collected(), server), Pool(plan)
    run_all(driver, pool)
    assert server.begun == []
    of_a = [name for name in pool.played if name.startswith("a")]
    assert of_a == ["a@10#0", "a@10#1", "a@20#0", "a@20#1"]
