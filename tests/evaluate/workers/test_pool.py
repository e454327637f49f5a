"""The pool of workers: lost nodes, fewer workers than wanted, and reports that arrive together."""

from __future__ import annotations

import math
from collections.abc import Callable
from time import monotonic
from typing import Any

import pytest
import ray
from eval_fakes import LINE, Clock, ToZero, wait_for
from ray.exceptions import RaySystemError

from vlagents_ray.errors import ConfigError, EnvFailed
from vlagents_ray.evaluate import EvalConfig, WorkerConfig
from vlagents_ray.evaluate.episode.failures import Failure
from vlagents_ray.evaluate.plan.cases import plan_cases
from vlagents_ray.evaluate.plan.jobs import EpisodeKey, Job, plan_jobs
from vlagents_ray.evaluate.plan.resolved import resolve
from vlagents_ray.evaluate.workers import pool
from vlagents_ray.evaluate.workers.base import WorkerHandle
from vlagents_ray.evaluate.workers.cluster import CapacityMonitor
from vlagents_ray.evaluate.workers.pool import QUERIES_PER_S, WATCH_S, WorkerPool, watch_s
from vlagents_ray.evaluate.workers.rollout import Report

pytestmark = pytest.mark.usefixtures("shared_ray")

Config = Callable[..., EvalConfig]


@ray.remote
def lost() -> None:
    raise RuntimeError("its node died")


@ray.remote(num_cpus=0)
class Process:
    """The process of a worker, whatever it runs."""


def worker(config: EvalConfig, starting: Any = None, **known: Any) -> WorkerHandle:
    return WorkerHandle(
        config.worker, "kind", Process.remote(), starting=starting, started_at=monotonic(), **known
    )


def test_workers_that_are_lost_together_while_they_start_are_no_row_of_failures(
    config: Config,
) -> None:
    settings = config(workers=5)

    def lose(workers: int) -> None:
        started._workers = [worker(settings, lost.remote()) for _ in range(workers)]
        while started.kinds():
            assert list(started.wait(1)) == []

    with WorkerPool(resolve(settings), ToZero) as started:
        lose(5)
        lose(5)
        with pytest.raises(EnvFailed, match="workers do not start, 3 in a row"):
            lose(1)


def test_workers_play_on_while_there_is_no_room_for_all(
    config: Config, caplog: pytest.LogCaptureFixture
) -> None:
    settings = config(workers=2, place_timeout_s=0.2)
    job = Job(EpisodeKey(LINE, 0, 0, "settings"), None)  # type: ignore[arg-type]
    waiting = worker(settings, Process.options(num_cpus=64).remote().__ray_ready__.remote())
    # The pool does not query this worker's progress.
    playing = worker(settings, jobs=(job,), heartbeat_at=math.inf, queried_at=math.inf)
    reports: list[tuple[Job, Report]] = []
    with WorkerPool(resolve(settings), ToZero) as short:
        short._workers = [waiting, playing]
        wait_for(
            lambda: (
                reports.extend(short.wait(0.1))
                or "continuing with 1 of 2 workers: expected" in caplog.text
            )
        )
        assert short._workers == [waiting, playing]
    assert reports == []


def test_a_host_that_does_not_answer_is_waited_for_once(
    config: Config, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []

    def silent(host: str, paths: object) -> str:
        asked.append(host)
        raise TimeoutError

    monkeypatch.setattr(pool, "tail_at", silent)
    failure = Failure("worker", EnvFailed.code, "the worker died")
    with WorkerPool(resolve(config()), ToZero) as watched:
        for host in ("host1", "host1", "host2"):
            process = {"host": host, "logs": ["/log"]}
            assert watched._with_log(failure, worker(config(), process=process)) == failure
    assert asked == ["host1", "host2"]


def test_no_log_is_looked_for_once_the_head_is_gone_too(
    config: Config, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ray's calls would block, and Slurm would kill a cancelled job before its evaluation has
    written a summary.
    """
    monkeypatch.setattr(pool, "tail_at", lambda *_: pytest.fail("called a cluster that has ended"))
    monkeypatch.setattr(pool, "head_is_gone", lambda: True)
    failure = Failure("worker", EnvFailed.code, "the worker died")
    with WorkerPool(resolve(config()), ToZero) as watched:
        assert (
            watched._with_log(
                failure, worker(config(), process={"host": "host1", "logs": ["/log"]})
            )
            == failure
        )


def test_a_worker_that_cannot_be_killed_saves_no_other_one(monkeypatch: pytest.MonkeyPatch) -> None:
    killed = []

    def kill(actor: str) -> None:
        killed.append(actor)
        raise RaySystemError("no answer")

    monkeypatch.setattr(ray, "kill", kill)
    pool._kill(["one", "other"])
    assert killed == ["one", "other"]


def test_who_kills_workers_of_a_ray_that_was_left_meanwhile_starts_no_other_ray(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[str] = []  # any call, which would make Ray start
    monkeypatch.setattr(ray, "is_initialized", lambda: False)
    monkeypatch.setattr(ray, "kill", asked.append)
    pool._kill(["one"])
    assert asked == []


WANTED = WorkerConfig(cpus=64)


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def capacity(config: Config, clock: Clock) -> CapacityMonitor:
    return CapacityMonitor(3, 100.0, clock)


def test_a_worker_may_wait_for_as_long_as_the_settings_say(
    capacity: CapacityMonitor, clock: Clock
) -> None:
    clock.now = 110.0
    assert not capacity.timed_out(since=10.0)
    assert capacity.timed_out(since=9.0)


def test_that_it_goes_on_with_fewer_is_said_once_until_another_comes_up(
    capacity: CapacityMonitor, clock: Clock, caplog: pytest.LogCaptureFixture
) -> None:
    clock.now = 1000.0
    capacity.note_playing()
    for _ in range(3):
        capacity.report_shortage(WANTED, running=2)
    assert caplog.text.count("continuing with 2 of 3 workers: expected {") == 1
    capacity.note_started()
    capacity.report_shortage(WANTED, running=2)
    assert caplog.text.count("continuing with") == 2


def test_between_two_episodes_nobody_gives_up_but_where_nothing_is_played_for_as_long(
    capacity: CapacityMonitor, clock: Clock
) -> None:
    clock.now = 1000.0
    capacity.note_playing()
    clock.now = 1100.0
    capacity.report_shortage(WANTED, running=1)
    clock.now = 1101.0
    with pytest.raises(
        ConfigError, match=r"expected .*64.* for each worker within 100 s, .* lower `workers`"
    ):
        capacity.report_shortage(WANTED, running=1)


def test_reports_that_have_come_are_taken_in_one_turn(config: Config) -> None:
    settings = config(workers=2)
    jobs = plan_jobs(plan_cases(settings))
    with WorkerPool(resolve(settings), lambda _: ToZero()) as pool:
        for job in jobs[:2]:
            pool.start(job.case)
        wait_for(lambda: not list(pool.wait(0.1)) and len(pool.idle()) == 2)
        busy = pool.idle()
        for worker, job in zip(busy, jobs, strict=False):
            pool.dispatch(worker, (job,))
        done, _ = ray.wait([worker.running for worker in busy], num_returns=2, timeout=60)
        assert len(done) == 2
        assert {job.key for job, _ in pool.wait(10)} == {job.key for job in jobs[:2]}


def test_many_workers_are_queried_less_often_so_that_one_driver_is_enough() -> None:
    assert watch_s(1) == watch_s(100) == WATCH_S
    assert all(workers / watch_s(workers) <= QUERIES_PER_S for workers in (300, 1000, 10_000))
